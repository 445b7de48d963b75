"""How many processor cores, and how much address space, this process may use."""

import ctypes
import math
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from agalign.errors import ConfigurationError, MemoryLimitError

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables with the number of threads that libraries start; they read them once, at their import."""
MIN_ADDRESS_SPACE_BYTES = 1_800_000_000
"""Below about 1.6 GB the libraries crash, abort or hang, which cannot be caught."""
_MIN_THREADS, _MIN_THREADS_PER_CORE = 16, 4
"""With fewer, GDAL hangs and OpenMP ends the process. A run on two cores needs 24 processes and threads."""


def usable_cores() -> int:
    """Return the number of cores: those of the machine, or fewer where an affinity (taskset, a batch system) or the
    quota of a control group (`docker run --cpus`, a Kubernetes limit) allows fewer. A share of a core counts as one.
    """
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota = cgroup_quota()
    return cores if quota is None else max(1, min(cores, math.ceil(quota)))


def limit_default_threads() -> None:
    """Limit the threads of libraries that are imported later to the quota of the control group, which they do not read.

    Environment variables that the user has set are kept.
    """
    if cgroup_quota() is not None:
        for name in THREAD_VARIABLES:
            os.environ.setdefault(name, str(usable_cores()))


def cgroup_quota(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> float | None:
    """Return the smallest quota of this process's control group and those above it, in cores; None for no limit.

    Version 2 has the file `cpu.max` ("200000 100000": quota and period in microseconds), version 1 one file for each.
    """
    folders = [root, root / "cpu"]  # a container sees its own group as the root
    for line in _text(own).splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or "cpu" in controllers.split(","):
            group = (root / "cpu" if controllers else root) / path.lstrip("/")
            folders += [group, *group.parents]
    return min((q for folder in folders if (q := _quota_in(folder)) is not None), default=None)


def _quota_in(folder: Path) -> float | None:
    quota, _, period = _text(folder / "cpu.max").strip().partition(" ")
    if not quota:
        quota, period = (_text(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period"))
    try:
        cores = float(quota) / float(period)
    except (ValueError, ZeroDivisionError):  # "max", or no such file
        return None
    return cores if cores > 0 else None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def check_threads() -> None:
    """Raise ConfigurationError if the system allows too few processes (`ulimit -u`, or a container's limit).

    It starts threads, because the limits do not show how many can be started: that of a user includes the processes of
    other containers. Not checked with a limit of the address space: each thread reserves 8 MB of it for its stack.
    """
    if _address_space_bytes() < math.inf:
        return
    end, started, needed = threading.Event(), 0, _MIN_THREADS + _MIN_THREADS_PER_CORE * usable_cores()
    with ThreadPoolExecutor(needed) as threads:
        try:
            while started < needed:
                threads.submit(end.wait)
                started += 1
        except RuntimeError:
            raise ConfigurationError(
                f"only {started} more processes and threads can be started, and agalign needs {needed}; raise the "
                "limit of processes (ulimit -u, or that of the container), or end other programs"
            ) from None
        finally:
            end.set()


def _address_space_bytes() -> float:
    """Return the limit of the address space (`ulimit -v`); inf without one."""
    if sys.platform == "win32":
        return math.inf
    import resource

    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)
    return math.inf if limit_bytes == resource.RLIM_INFINITY else limit_bytes


def check_address_space() -> None:
    """Raise MemoryLimitError if the address space (`ulimit -v`) is too small for the libraries.

    If it is limited, threads of this process and its children share one heap: glibc reserves 64 MB for each thread.
    """
    limit_bytes = _address_space_bytes()
    if limit_bytes < MIN_ADDRESS_SPACE_BYTES:
        raise MemoryLimitError(
            f"the address space of this process is limited to {limit_bytes / 1e9:.2f} GB (ulimit -v); agalign needs "
            f"{MIN_ADDRESS_SPACE_BYTES / 1e9:g} GB or more; raise that limit"
        )
    if limit_bytes < math.inf:
        os.environ.setdefault("MALLOC_ARENA_MAX", "1")
        m_arena_max = -8  # of mallopt(3)
        with suppress(OSError, AttributeError):  # other allocators lack it
            ctypes.CDLL(None).mallopt(m_arena_max, 1)
