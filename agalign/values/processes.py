"""Worker processes: start method, number of threads, SIGINT, and end with their parent."""

import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import current_process, get_all_start_methods, get_context, parent_process, resource_tracker
from multiprocessing.context import BaseContext


def follow_parent() -> None:
    """In a worker process: ignore SIGINT, and end when the parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


REIMPORTED_EXIT_CODE = 72
"""Exit code of a worker that imports the calling script again."""


def end_if_reimported() -> None:
    """End a worker process that imports the calling script again: without `if __name__ == "__main__":` around the
    calls of the script, each worker would start workers.
    """
    if getattr(current_process(), "_inheriting", False):  # the test that `multiprocessing` itself uses
        os._exit(REIMPORTED_EXIT_CODE)


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
    """Return the start method of worker processes: forked from a fork server that has imported the module `preload`, or
    spawned.

    Processes are spawned on macOS, where a fork of a process with Apple's libraries may crash or hang, and without a
    temporary folder, in which the fork server needs a socket.
    """
    if sys.platform == "darwin" or "forkserver" not in get_all_start_methods() or not _has_temporary_folder():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload([preload])
    return context


CAPTURES_WORTH_A_PROCESS = 2
"""Minimum number of captures per process: starting one takes the time of one capture, while a flight is learned."""


def start_server_ahead(captures: int, cores: int) -> None:
    """Start the fork server early if a run of this many captures will use workers: it imports WORKER_MODULE while this
    process imports the same.
    """
    processes = min(cores, captures // CAPTURES_WORTH_A_PROCESS)
    if processes < 2 or worker_context(WORKER_MODULE).get_start_method() != "forkserver":
        return
    from multiprocessing import forkserver

    # If it cannot be started, the workers report the reason.
    with suppress(OSError, RuntimeError), threads_of_children(max(1, cores // processes)), without_interrupt_key():
        forkserver.ensure_running()


def _has_temporary_folder() -> bool:
    try:
        tempfile.gettempdir()
    except OSError:
        return False
    return True


@contextmanager
def threads_of_children(count: int) -> Iterator[None]:
    """Set the number of threads that libraries in child processes start. Libraries read it once, at their import.

    More threads than cores, over all processes, double the time.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
