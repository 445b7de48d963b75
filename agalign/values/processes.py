"""Worker processes: start method, environment, SIGINT, and end with their parent."""

import logging
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from enum import IntEnum
from multiprocessing import current_process, get_all_start_methods, get_context, parent_process, resource_tracker
from multiprocessing.context import BaseContext
from pathlib import Path

from agalign.values.cores import THREAD_VARIABLES


def silence_libraries() -> None:
    """Drop what libraries log about damaged files: it is raised as an error too, or the file can be used."""
    for name in ("rasterio", "tifffile"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def follow_parent() -> None:
    """In a worker process: ignore SIGINT, and end when the parent process ends."""
    silence_libraries()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

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
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except ProcessLookupError:
        return False
    except FileNotFoundError:
        return not Path("/proc/self").exists()
    except OSError:  # another user's process
        return True
    return state.rpartition(")")[2].split()[0] not in "ZX"


class ExitCode(IntEnum):
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
        os._exit(ExitCode.REIMPORTED)


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


WORKER_MODULE = "agalign.batch.preload"
"""Module that imports all that the workers of a run need."""


def worker_context(preload: str) -> BaseContext:
    """Return the start method of worker processes: forked from a fork server, which is started and imports the module
    `preload`, or spawned. Call it within `environment_of_children`.

    Processes are spawned on macOS, where a fork of a process with Apple's libraries may crash or hang, and without a
    temporary folder, in which the fork server needs a socket.
    """
    temporary_folder = ""
    with suppress(OSError):
        temporary_folder = tempfile.gettempdir()
    if sys.platform == "darwin" or "forkserver" not in get_all_start_methods() or not temporary_folder:
        return get_context("spawn")
    from multiprocessing import forkserver

    context = get_context("forkserver")
    context.set_forkserver_preload([preload])
    # The server imports from where this process does: until Python 3.12.9, `multiprocessing` sends the path to workers
    # only. If the server cannot be started, the workers report the reason.
    search_path = {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    with suppress(OSError, RuntimeError), _environment(search_path), without_interrupt_key():
        forkserver.ensure_running()
    return context


CAPTURES_WORTH_A_PROCESS = 2
"""Minimum number of captures per process: starting one takes the time of one capture, while a flight is learned."""


def start_server_ahead(captures: int, cores: int) -> None:
    """Start the fork server early if a run of this many captures will use workers: it imports WORKER_MODULE while this
    process imports the same.
    """
    processes = min(cores, captures // CAPTURES_WORTH_A_PROCESS)
    if processes > 1:
        with environment_of_children(cores // processes):
            worker_context(WORKER_MODULE)


def environment_of_children(threads: int) -> AbstractContextManager[None]:
    """Set the number of threads that libraries in child processes start, and where these search for modules.

    More threads than cores, over all processes, double the time. Without PYTHONSAFEPATH, child processes of
    `multiprocessing` search the working folder first, and run a `rasterio.py` that is there.
    """
    return _environment({**dict.fromkeys(THREAD_VARIABLES, str(threads)), "PYTHONSAFEPATH": "1"})


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables inside the block."""
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name, None)
        os.environ.update(before)
