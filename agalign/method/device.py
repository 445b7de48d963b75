"""Devices of tensors, numbers of threads, and memory errors."""

import ctypes
import platform
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache

import cv2
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from agalign.errors import ConfigurationError, is_out_of_memory


def choose_device(name: str) -> torch.device:
    """Return the device of a name; `auto` is CUDA if available, else the CPU.

    Raises ConfigurationError for an unknown device or one that cannot be used.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigurationError(f"unknown device '{name}'; use auto, cpu, cuda, cuda:1 or mps") from None
    for kind, is_available in (("cuda", torch.cuda.is_available), ("mps", torch.backends.mps.is_available)):
        if device.type == kind and not is_available():
            reason = f"no {kind.upper()} device, or PyTorch without {kind.upper()}"
            raise ConfigurationError(f"device '{name}' cannot be used: {reason}; 'agalign --version' lists devices")
    problem = _problem(device)
    if problem:
        raise ConfigurationError(f"device '{name}' cannot be used here: {problem}")
    return device


def _problem(device: torch.device) -> str:
    """Return why a device cannot be used; empty if it can."""
    try:
        _test(device)
    except (RuntimeError, AssertionError, ImportError) as error:
        return str(error).splitlines()[0]
    return ""


@cache
def _test(device: torch.device) -> None:
    """Sample an image and multiply matrices. Raises RuntimeError if that fails.

    PyTorch before 2.13 may lack the border padding of `grid_sample` on Apple's GPUs.
    """
    ones = torch.ones(1, 1, 64, 64, device=device)
    sampled = functional.grid_sample(ones, ones.expand(2, 1, 64, 64).permute(1, 2, 3, 0), "bilinear", "border", True)
    if float((sampled @ ones).sum()) != 64**3:
        raise RuntimeError("it returns wrong values")


@dataclass(frozen=True)
class Device:
    """A device for tensors."""

    name: str
    what: str
    """Processor, or model and memory of a GPU."""
    threads: int
    """Threads that torch uses; 0 for a GPU."""
    problem: str
    """Why the device cannot be used; empty if it can."""


def devices() -> list[Device]:
    """List the CPU and every GPU, each tested."""
    known = [("cpu", platform.machine(), torch.get_num_threads())]
    for i in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(i)
        known.append((f"cuda:{i}", f"{properties.name}, {properties.total_memory / 1e9:.0f} GB", 0))
    if torch.backends.mps.is_available():
        known.append(("mps", "Apple GPU", 0))
    return [Device(name, what, threads, _problem(torch.device(name))) for name, what, threads in known]


def to_float64(tensor: Tensor) -> Tensor:
    """Return a tensor of any shape (...,) as float64, on the CPU if its device (Apple's MPS) has no float64."""
    return (tensor if _has_float64(tensor.device) else tensor.cpu()).double()


def _has_float64(device: torch.device) -> bool:
    return device.type != "mps"


def limit_threads(count: int) -> None:
    """Set the number of threads of torch and OpenCV in this process."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


@cache
def keep_freed_memory() -> None:
    """Let glibc reuse the memory of freed arrays in this process; no effect with other allocators.

    By default glibc returns large arrays to the system at once. A new array then costs one page fault per 4 KB, which
    takes longer than filling it.
    """
    m_trim_threshold, m_mmap_threshold = -1, -3  # of mallopt(3)
    with suppress(OSError, AttributeError, TypeError):
        allocator = ctypes.CDLL(None)
        # Arrays below 32 MiB are allocated on the heap, which keeps up to 256 MiB of free memory.
        allocator.mallopt(m_mmap_threshold, 32 << 20)
        allocator.mallopt(m_trim_threshold, 256 << 20)


_lock = threading.Lock()
_active = 0
"""Number of `one_thread` contexts that are open in all threads."""
_outside = ExitStack()
"""Restores the settings that were in force when the first of these contexts was opened."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and BLAS to one thread each.

    The networks and matrices are too small to gain from more, and sums do not depend on the number of processes. The
    limit applies to the whole process; when contexts are open in several threads, the last one to close restores the
    original settings.
    """
    global _active
    with _lock:
        if _active == 0:
            _outside.callback(torch.set_num_threads, torch.get_num_threads())
            _outside.enter_context(threadpool_limits(1, user_api="blas"))
            torch.set_num_threads(1)
        _active += 1
    try:
        yield
    finally:
        with _lock:
            _active -= 1
            if _active == 0:
                _outside.close()


@contextmanager
def one_memory_error() -> Iterator[None]:
    """Convert the out-of-memory errors of OpenCV and torch to MemoryError."""
    try:
        yield
    except (cv2.error, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise MemoryError(str(error)) from None
