"""Processes of our own: they end with the one that started them, and leave the interrupt key to it."""

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
    """In a new process: it ends with the process that started it, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


REIMPORTED_EXIT_CODE = 72
"""Of a worker in which the calling script began to run again."""


def end_if_reimported() -> None:
    """End a worker process in which the calling script runs again: without `if __name__ == "__main__":` around its
    calls, each worker that imports it would start workers of its own.
    """
    if getattr(current_process(), "_inheriting", False):  # the test that `multiprocessing` itself uses
        os._exit(REIMPORTED_EXIT_CODE)


@contextmanager
def without_interrupt_key() -> Iterator[None]:
    """Processes started inside, and theirs, inherit not to hear it, from their first moment on."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        resource_tracker.ensure_running()  # which, when it starts, lets the thread that starts it hear the key again
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def worker_context(preload: str) -> BaseContext:
    """How processes are started: forked from one that has loaded the module `preload`, where the system allows, else as
    new interpreters.

    On macOS a copy of a process that has loaded Apple's libraries may crash or hang. The fork server needs a socket in
    a temporary folder, which a service account may not have.
    """
    if sys.platform == "darwin" or "forkserver" not in get_all_start_methods() or not _has_temporary_folder():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload([preload])
    return context


CAPTURES_WORTH_A_PROCESS = 2
"""A process takes as long to start as to align one capture; its start overlaps with the learning of the flight."""


def start_server_ahead(preload: str, captures: int, cores: int) -> None:
    """Start the process that workers will be forked from, if a run of so many captures will have any: it loads what
    they need while this process loads the same.
    """
    processes = min(cores, captures // CAPTURES_WORTH_A_PROCESS)
    if processes < 2 or worker_context(preload).get_start_method() != "forkserver":
        return
    from multiprocessing import forkserver

    # Where it cannot be started now, the workers report why.
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
    """Libraries read these once, when they are loaded: threads of several processes that wait for each other's cores
    take twice the time.
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
