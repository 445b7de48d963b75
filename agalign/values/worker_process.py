"""One worker process and the pipe to it: start, messages, and end.

A message is sent in chunks that fit the buffer of a pipe, so the parent never blocks if the worker stops: the worker
requests each further chunk of a task, and the parent reads a chunk of a result only after all of it has arrived.
"""

import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from typing import Any

from agalign.values.processes import without_interrupt_key

_CHUNK_BYTES = 8000
"""With its header, smaller than the buffer of a pipe on every system (8192 bytes on Windows)."""
_MORE, _LAST, _REQUEST = b"+", b".", b"?"
"""First byte of a chunk: more chunks follow, last chunk, or the worker requests the next one."""
_OUT_OF_MEMORY_EXIT_CODE = 71
LOST_SERVER_EXIT_CODE = 255
"""Exit code of a worker after its fork server was killed; the worker itself may still run."""
ENDS_WITHIN_S = 10.0
"""Timeout for the end of a killed process, which takes milliseconds unless it waits for a disk or file server."""
_START_RETRIES, _RETRY_INTERVAL_S = 20, 0.1
"""Of connections to the fork server."""
_PROCESS_LOCK = threading.Lock()
"""Starting a process polls all others. Two threads that poll one process get a wrong exit code."""


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
        for _ in range(_START_RETRIES):
            try:
                self.process.start()
            except ConnectionError:
                time.sleep(_RETRY_INTERVAL_S)
            else:
                return
        self.process.start()

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
                if chunk[:1] == _REQUEST:
                    self.pipe.send_bytes(next(self._to_send))
                    continue
                self._received += chunk[1:]
                if chunk[:1] == _LAST:
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
            pid = self.process.pid
            if pid is not None and self.exit_code(0) == LOST_SERVER_EXIT_CODE and not self._is_at_end():
                with suppress(OSError):
                    os.kill(pid, signal.SIGKILL)
        self.pipe.close()

    def _is_at_end(self) -> bool:
        """True if no process has the other end of the pipe open."""
        while not self.pipe.closed and self.receive() is not None:
            pass
        return self.pipe.closed or self.at_end

    def exit_code(self, within_s: float = ENDS_WITHIN_S) -> int | None:
        """Return the exit code, -n for signal n; None if the process was not started or does not end in time."""
        if not self._launched or not wait([self.process.sentinel], within_s):
            return None
        if not _PROCESS_LOCK.acquire(timeout=ENDS_WITHIN_S):
            return None
        try:
            code: int | None = self.process.exitcode
            return code
        finally:
            _PROCESS_LOCK.release()


def is_out_of_memory(exit_code: int | None) -> bool:
    """True for the exit code of a worker without memory for its result."""
    return exit_code == _OUT_OF_MEMORY_EXIT_CODE


def _chunks(message: bytes) -> Iterator[bytes]:
    """Yield a message in chunks, each preceded by its kind."""
    starts = range(0, len(message), _CHUNK_BYTES)
    for start in starts:
        kind = _LAST if start == starts[-1] else _MORE
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
        os._exit(_OUT_OF_MEMORY_EXIT_CODE)


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
        if chunk[:1] == _LAST:
            return bytes(message)
        pipe.send_bytes(_REQUEST)
