"""Worker processes: start method, environment, SIGINT, end with their parent, and the pipe to one.

A message is sent in chunks that fit the buffer of a pipe, so the parent never blocks if the worker stops: the worker
requests each further chunk of a task, and the parent reads a chunk of a result only after all of it has arrived.
"""

import logging
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from enum import Enum, IntEnum
from multiprocessing import current_process, get_all_start_methods, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any

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
    if sys.platform == "darwin" or "forkserver" not in get_all_start_methods() or not _has_temporary_folder():
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


def _has_temporary_folder() -> bool:
    try:
        tempfile.gettempdir()
    except OSError:
        return False
    return True


def environment_of_children(threads: int) -> AbstractContextManager[None]:
    """Set the number of threads that libraries in child processes start, and where these search for modules.

    More threads than cores, over all processes, double the time. Without PYTHONSAFEPATH, child processes of
    `multiprocessing` search the working folder first, and run a `rasterio.py` that is there.
    """
    return _environment({**dict.fromkeys(THREAD_VARIABLES, str(threads)), "PYTHONSAFEPATH": "1"})


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables inside the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


_CHUNK_BYTES = 8000
"""With its header, smaller than the buffer of a pipe on every system (8192 bytes on Windows)."""
ENDS_WITHIN_S = 10.0
"""Timeout for the end of a killed process, which takes milliseconds unless it waits for a disk or file server."""
_PROCESS_LOCK = threading.Lock()
"""Starting a process polls all others. Two threads that poll one process get a wrong exit code."""


class _Chunk(bytes, Enum):
    """First byte of a chunk."""

    MORE = b"+"
    """More chunks follow."""
    LAST = b"."
    REQUEST = b"?"
    """The worker requests the next one."""


class Worker:
    """A worker process with one task at a time, controlled by its parent."""

    def __init__(self, context: BaseContext, initializer: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        """Start the process in the background. Raises OSError or RuntimeError if a pipe or thread cannot be created."""
        self.created_s = time.monotonic()
        self.ready = False
        """The process has reported that it is initialised."""
        self.problem = ""
        """Why the process could not be started."""
        self.at_end = False
        """The process has closed the pipe."""
        self.task: Any = None
        """The current task of the pool."""
        self.finished = 0
        """Number of finished tasks."""
        self.deadline_s: float | None = None
        """Of the current task, or of the start; monotonic clock."""
        self.heard_s = 0.0
        """Time of the last chunk received for the current task, monotonic clock; 0 before the first."""
        self._received = bytearray()
        self._to_send: Iterator[bytes] = iter(())
        self._launched = self._abandoned = False
        self.pipe, worker_end = context.Pipe()
        # BaseContext has no Process in typeshed.
        self.process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=(worker_end, initializer, arguments), daemon=True
        )
        # Signal handlers run in the main thread, so none of them interrupts a start in this thread.
        self._launching = threading.Thread(target=self._launch, args=(worker_end,), daemon=True)
        try:
            self._launching.start()
        except RuntimeError:
            self.pipe.close()
            worker_end.close()
            raise

    def _launch(self, worker_end: Connection) -> None:
        try:
            with _PROCESS_LOCK, without_interrupt_key():
                if not self._abandoned:
                    self._start()
                    self._launched = True
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            worker_end.close()  # the process has the only other copy: the pipe closes when it ends

    def _start(self) -> None:
        """Start the process. A fork server that was killed refuses connections shortly before its end is known."""
        for _ in range(20):
            try:
                self.process.start()
            except ConnectionError:
                time.sleep(0.1)
            else:
                return
        self.process.start()

    @property
    def idle(self) -> bool:
        """True if the process is initialised and has no task."""
        return self.ready and self.task is None

    @property
    def kill_time_s(self) -> float:
        """Time at which the worker is killed, monotonic clock.

        The deadline is extended by a second after each chunk of a result: the caller may take time over outcomes while
        a worker sends.
        """
        return float("inf") if self.deadline_s is None else max(self.deadline_s, self.heard_s + 1.0)

    def waits_for(self) -> list[Any]:
        """Return the objects for `multiprocessing.connection.wait`: the pipe and the sentinel of the process."""
        return [self.pipe, self.process.sentinel] if self._launched else [self.pipe]

    def send(self, message: bytes) -> None:
        """Send the first chunk of a message; `receive` sends the others. Raises OSError if the process has ended."""
        self._to_send, self.heard_s = _chunks(message), 0.0
        self.pipe.send_bytes(next(self._to_send))

    def receive(self) -> bytes | None:
        """Return the next complete message; None if there is none yet, or if the pipe is closed (`at_end`)."""
        try:
            while self.pipe.poll():
                chunk = self.pipe.recv_bytes()
                self.heard_s = time.monotonic()
                if chunk[:1] == _Chunk.REQUEST:
                    self.pipe.send_bytes(next(self._to_send))
                    continue
                self._received += chunk[1:]
                if chunk[:1] == _Chunk.LAST:
                    message, self._received = bytes(self._received), bytearray()
                    return message
        except (EOFError, OSError):
            self.at_end = True
        return None

    def has_ended(self) -> bool:
        """True if the process has ended or closed the pipe, and all its messages are received."""
        return self.at_end or (self._launched and bool(wait([self.process.sentinel], 0)) and not self.pipe.poll())

    def let_end(self) -> None:
        """Close the pipe, which ends an idle process; one that is not launched yet is not launched."""
        self._abandoned = True
        self.pipe.close()

    def kill(self, within_s: float = ENDS_WITHIN_S) -> None:
        """Kill the process; one that is still being launched ends because its pipe is closed."""
        self._abandoned = True
        self._launching.join(within_s)
        if self._launched:
            self.process.kill()
            if self._reported_code() == ExitCode.LOST_SERVER:
                self._kill_without_server()
        self.pipe.close()

    def _kill_without_server(self) -> None:
        """Kill the process if its fork server was killed: `multiprocessing` then takes it for ended."""
        if self.process.pid is not None and not self._is_at_end():
            with suppress(OSError):
                os.kill(self.process.pid, signal.SIGKILL)

    def _is_at_end(self) -> bool:
        """True if no process has the other end of the pipe open."""
        while not self.pipe.closed and self.receive() is not None:
            pass
        return self.pipe.closed or self.at_end

    def exit_code(self, within_s: float = ENDS_WITHIN_S) -> int | None:
        """Return the exit code, -n for signal n; None if the process was not started or does not end in time.

        If its fork server was killed, the process is killed first.
        """
        until_s = time.monotonic() + within_s
        if not self._launched or not wait([self.process.sentinel], within_s):
            return None
        code = self._reported_code()
        if code == ExitCode.LOST_SERVER:
            self._kill_without_server()
            while is_running(self.process.pid or 0):
                if time.monotonic() >= until_s:
                    return None
                time.sleep(0.01)
        return code

    def _reported_code(self) -> int | None:
        """Return the exit code that the fork server has reported, if any."""
        if not _PROCESS_LOCK.acquire(timeout=ENDS_WITHIN_S):
            return None
        try:
            code: int | None = self.process.exitcode
            return code
        finally:
            _PROCESS_LOCK.release()


def _chunks(message: bytes) -> Iterator[bytes]:
    """Yield a message in chunks, each preceded by its kind."""
    starts = range(0, len(message), _CHUNK_BYTES)
    for start in starts:
        kind = _Chunk.LAST if start == starts[-1] else _Chunk.MORE
        yield kind + message[start : start + _CHUNK_BYTES]


def _work(pipe: Connection, initializer: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    """Main function of a worker process: initialise, then process tasks until the parent closes the pipe."""
    try:
        try:
            initializer(*arguments)
        except Exception as error:
            _send(pipe, pickle.dumps((False, f"{type(error).__name__}: {error}")))
            return
        _send(pipe, pickle.dumps((True, None)))
        while True:
            _send(pipe, _response(_receive(pipe)))
    except (EOFError, OSError):
        return
    except MemoryError:
        os._exit(ExitCode.OUT_OF_MEMORY)


def _response(message: bytes) -> bytes:
    """Return the pickled (True, result) or (False, exception) of a task."""
    try:
        function, argument = pickle.loads(message)
        return pickle.dumps((True, function(argument)), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        try:
            response = pickle.dumps((False, error))
            pickle.loads(response)  # some exceptions can be pickled, but not unpickled
        except Exception:
            response = pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
        return response


def _send(pipe: Connection, message: bytes) -> None:
    for chunk in _chunks(message):
        pipe.send_bytes(chunk)


def _receive(pipe: Connection) -> bytes:
    """Return a complete message. Raises EOFError if the parent has closed the pipe or ended."""
    message = bytearray()
    while True:
        chunk = pipe.recv_bytes()
        message += chunk[1:]
        if chunk[:1] == _Chunk.LAST:
            return bytes(message)
        pipe.send_bytes(_Chunk.REQUEST)
