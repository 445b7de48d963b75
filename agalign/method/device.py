"""Where the tensors live, with how many threads, and what to make of it when they do not fit."""

import ctypes
import platform
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache

import cv2
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from agalign.errors import ConfigurationError, is_want_of_memory


def choose_device(name: str) -> torch.device:
    """`auto` is CUDA where it is available, else the CPU. Raises ConfigurationError where a device cannot be used."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigurationError(f"unknown device '{name}'; use auto, cpu, cuda, cuda:1 or mps") from None
    for kind, is_available in (("cuda", torch.cuda.is_available), ("mps", torch.backends.mps.is_available)):
        if device.type == kind and not is_available():
            no = f"no {kind.upper()} device, or PyTorch without {kind.upper()}"
            raise ConfigurationError(f"device '{name}' cannot be used: {no}; 'agalign doctor' lists devices")
    try:
        if device.type != "cpu":
            _try_out(device)
    except (RuntimeError, AssertionError, ImportError) as error:
        raise ConfigurationError(f"device '{name}' cannot be used here: {str(error).splitlines()[0]}") from None
    return device


@cache
def _try_out(device: torch.device) -> None:
    """Sample an image and multiply matrices. Raises RuntimeError where the device cannot; before 2.13 PyTorch may lack
    this padding on Apple's GPUs.
    """
    ones = torch.ones(1, 1, 64, 64, device=device)
    sampled = functional.grid_sample(ones, ones.expand(2, 1, 64, 64).permute(1, 2, 3, 0), "bilinear", "border", True)
    if float((sampled @ ones).sum()) != 64**3:
        raise RuntimeError("it computes wrong values")


@dataclass(frozen=True)
class Device:
    """Where tensors may live."""

    name: str
    what: str
    threads: int
    """That torch would use; 0 where that means nothing."""
    problem: str
    """Why it cannot be used, or empty."""


def devices() -> list[Device]:
    """The CPU and every GPU, each tried."""
    result = [Device("cpu", platform.machine(), torch.get_num_threads(), _problem("cpu"))]
    for i in range(torch.cuda.device_count()):
        facts = torch.cuda.get_device_properties(i)
        what = f"{facts.name}, {facts.total_memory / 1e9:.0f} GB"
        result.append(Device(f"cuda:{i}", what, 0, _problem(f"cuda:{i}")))
    if torch.backends.mps.is_available():
        result.append(Device("mps", "Apple GPU", 0, _problem("mps")))
    return result


def _problem(name: str) -> str:
    try:
        _try_out(torch.device(name))
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return ""


def exact(tensor: Tensor) -> Tensor:
    """The same in float64, in which psi is solved for; on the CPU where the device (Apple's MPS) has none."""
    return tensor.double() if _has_float64(tensor.device) else tensor.cpu().double()


def _has_float64(device: torch.device) -> bool:
    return device.type != "mps"


def limit_threads(count: int) -> None:
    """Let torch and OpenCV use this many threads from now on."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


_LARGEST_KEPT_BYTES, _MAX_KEPT_BYTES = 32 << 20, 256 << 20
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


@cache
def keep_freed_memory() -> None:
    """Let this process keep what arrays leave: glibc gives large ones back to the system at once, and a new one costs
    a page fault every 4 KB, which takes longer than to fill it. Other systems' allocators are left as they are.
    """
    with suppress(OSError, AttributeError, TypeError):
        allocator = ctypes.CDLL(None)
        allocator.mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT_BYTES)
        allocator.mallopt(_M_TRIM_THRESHOLD, _MAX_KEPT_BYTES)


_lock = threading.Lock()
_inside, _before = 0, 1
"""How many are in `one_thread` at the moment, and the number of torch threads before the first came."""
_blas: threadpool_limits | None = None
"""What holds numpy's and scipy's threads while somebody is inside."""


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread inside, of torch and of BLAS: the networks and matrices are too small to gain from more, sums do not
    depend on how many processes share the machine, and other programs keep their cores.

    Callers in several threads share one setting: the last to leave gives back what the first one found.
    """
    global _inside, _before, _blas
    with _lock:
        if _inside == 0:
            _before, _blas = torch.get_num_threads(), threadpool_limits(1, user_api="blas")
            torch.set_num_threads(1)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                torch.set_num_threads(_before)
                if _blas is not None:
                    _blas.restore_original_limits()


@contextmanager
def one_memory_error() -> Iterator[None]:
    """Raises MemoryError where memory is short, whichever library says it."""
    try:
        yield
    except (cv2.error, RuntimeError) as error:
        if not _is_want_of_memory(error):
            raise
        raise MemoryError(str(error)) from None


def _is_want_of_memory(error: cv2.error | RuntimeError) -> bool:
    if isinstance(error, cv2.error):
        return error.code == cv2.Error.STS_NO_MEM
    # torch's allocator on the CPU has no class of its own for it.
    return isinstance(error, torch.cuda.OutOfMemoryError) or is_want_of_memory(error)
