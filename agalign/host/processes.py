"""Cores and memory that this process may use, and its workers: start method, environment, SIGINT, and end with their
parent.
"""

import logging
import math
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from multiprocessing import current_process, get_all_start_methods, get_context, parent_process, resource_tracker
from multiprocessing.context import BaseContext
from pathlib import Path

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables with the number of threads that libraries start; they read them once, at their import."""
_CGROUPS, _OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def usable_cores() -> int:
    """Return the number of cores: those of the machine, or fewer where an affinity (taskset, a batch system) or the
    quota of a control group (`docker run --cpus`, a Kubernetes limit) allows fewer. A share of a core counts as one.
    """
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota = cgroup_quota()
    return cores if quota is None else max(1, min(cores, math.ceil(quota)))


def cores_for(jobs: int) -> int:
    """Return the number of cores of so many jobs; 0 jobs are one per core."""
    return jobs or usable_cores()


def limit_default_threads() -> None:
    """Limit the threads of libraries that are imported later to the quota of the control group, which they do not read.

    Environment variables that the user has set are kept.
    """
    if cgroup_quota() is not None:
        for name in THREAD_VARIABLES:
            os.environ.setdefault(name, str(usable_cores()))


def cgroup_quota() -> float | None:
    """Return the smallest quota of this process's control group and those above it, in cores; None for no limit.

    Version 2 has the file `cpu.max` ("200000 100000": quota and period in microseconds), version 1 one file for each.
    """
    quotas = map(_quota_in, _cgroup_folders("cpu"))
    return min((quota for quota in quotas if quota is not None), default=None)


def _cgroup_folders(controller: str) -> list[Path]:
    """The folders of this process's control group and those above it, of both versions."""
    folders = [_CGROUPS, _CGROUPS / controller]  # a container sees its own group as the root
    for line in _text(_OWN_CGROUP).splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            group = (_CGROUPS / controller if controllers else _CGROUPS) / path.lstrip("/")
            folders += [group, *group.parents]
    return folders


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


def total_memory_bytes() -> float:
    """Return the size of the memory of this machine; inf where it is unknown, as on Windows."""
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return math.inf


def memory_limit_bytes() -> float:
    """Return the smallest limit of the memory of this process's control groups; inf without one. Version 1 has a limit
    above the memory of any machine instead.
    """
    files = ("memory.max", "memory.limit_in_bytes")
    texts = (_text(folder / name).strip() for folder in _cgroup_folders("memory") for name in files)
    return min((float(text) for text in texts if text.isdecimal()), default=math.inf)


_MIN_ADDRESS_SPACE = 2_000_000_000
"""Bytes that the libraries of a run need for their code, threads and arrays. With less, some of them end the process
or wait for ever."""


def address_space_problem() -> str:
    """Return why a run cannot start if its address space is limited too much, and the remedy; empty if it can."""
    try:
        import resource
    except ImportError:  # other systems have no such limit
        return ""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY or limit >= _MIN_ADDRESS_SPACE:
        return ""
    needed = _MIN_ADDRESS_SPACE / 1e9
    what = f"the address space is limited to {limit / 1e9:.1f} GB, and aligning needs {needed:g} GB"
    return f"out of memory: {what}; raise the limit (ulimit -v unlimited)"


# ---- workers


def leave_out_network_clients() -> None:
    """Make rasterio do without the client for buckets, if that is installed: its import opens a socket.

    Call it before rasterio is imported, in processes of the command line only.
    """
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]


def silence_libraries() -> None:
    """Drop what libraries log about damaged files: it is raised as an error too, or the file can be used."""
    for name in ("rasterio", "tifffile"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def follow_parent() -> None:
    """In a worker process: ignore SIGINT, and end when the parent process ends."""
    silence_libraries()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def is_running(process: int) -> bool:
    """True if a process of this machine runs. A zombie does not run: it waits for its parent, which may be slow.

    False on Windows, where open files cannot be removed anyway.
    """
    if os.name == "nt":
        return False
    with suppress(PermissionError):  # another user's process
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
    state = _text(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()
    return not state or state[0] not in "ZX"


class WorkerExit(IntEnum):
    """Exit codes of workers."""

    OUT_OF_MEMORY = 71
    """The worker has no memory for its result."""
    REIMPORTED = 72
    """The worker imports the calling script again."""
    LOST_SERVER = 255
    """The fork server of the worker was killed; the worker itself may still run."""


def end_if_reimported() -> None:
    """End a worker process that imports the calling script again: without `if __name__ == "__main__":` around the
    calls of the script, each worker would start workers.
    """
    if getattr(current_process(), "_inheriting", False):  # the test that `multiprocessing` itself uses
        os._exit(WorkerExit.REIMPORTED)


@contextmanager
def without_interrupt_key() -> Iterator[None]:
    """Block SIGINT; processes started inside the block inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        resource_tracker.ensure_running()  # unblocks SIGINT in this thread
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


WORKER_MODULE = "agalign.batch.fork_server"
"""Module whose import imports all that the workers of a run need."""


def worker_context(preload: str = "") -> BaseContext:
    """Return the start method of worker processes: forked from a fork server, which is started and imports the module
    `preload`, or spawned. Call it within `environment_of_children`.

    Without a module to import, the processes are spawned. They are also spawned on macOS, as Apple's libraries may
    crash or hang after a fork, and without a temporary folder, where the fork server puts its socket.
    """
    temporary_folder = ""
    with suppress(OSError):
        temporary_folder = tempfile.gettempdir()
    has_server = sys.platform != "darwin" and "forkserver" in get_all_start_methods()
    if not preload or not has_server or not temporary_folder:
        return get_context("spawn")
    from multiprocessing import forkserver

    context = get_context("forkserver")
    context.set_forkserver_preload([preload])
    with suppress(OSError, RuntimeError), without_interrupt_key():  # the workers report why it cannot be started
        forkserver.ensure_running()
    return context


@contextmanager
def environment_of_children(threads: int) -> Iterator[None]:
    """Set the number of threads that libraries in child processes start, and where these search for modules.

    More threads than cores, over all processes, double the time. Child processes search where this process does: until
    Python 3.12.9, `multiprocessing` sends the path to workers, but not to the fork server. Without PYTHONSAFEPATH, they
    search the working folder first, and run a `rasterio.py` that is there.
    """
    values = dict.fromkeys(THREAD_VARIABLES, str(threads))
    values |= {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name, None)
        os.environ.update(before)
