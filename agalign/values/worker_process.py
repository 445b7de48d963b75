"""One worker process and the pipe to it: how it starts, how tasks and results travel, and how it ends.

A message travels in chunks that fit the buffer of a pipe, so the parent never blocks, whatever becomes of the worker:
the worker asks for each further chunk of a task, and the parent reads a chunk of a result only once it is there whole.
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
"""With its header, less than the buffer of a pipe on every system (8192 bytes on Windows), and written at once."""
_MORE, _LAST, _ASKS = b"+", b".", b"?"
"""The first byte of a chunk: others follow, it is the last one, or the worker asks for the next one."""
_OUT_OF_MEMORY_EXIT_CODE = 71
LOST_SERVER_EXIT_CODE = 255
"""Of a worker after its fork server was killed; the worker itself may be alive."""
ENDS_WITHIN_S = 5.0
"""A process that was killed ends in milliseconds, unless it waits for a disk or a file server that does not answer."""
_ONE_AT_A_TIME = threading.Lock()
"""To start a process polls all others. Two threads that poll one process read its exit code twice, and wrong."""


class Worker:
    """A process that does one task at a time, seen from its parent."""

    def __init__(self, context: BaseContext, initializer: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        """Start it in the background. Raises OSError or RuntimeError where a pipe or thread cannot be had."""
        self.created_s = time.monotonic()
        self.ready = False
        """It has said that it is initialised."""
        self.problem = ""
        """Why it could not be started."""
        self.at_end = False
        """Nothing more comes from it."""
        self.heard_s = 0.0
        """When something came from it last since it was given a task."""
        self._received = bytearray()
        self._to_send: Iterator[bytes] = iter(())
        self._launched = self._abandoned = False
        self.pipe, theirs = context.Pipe()
        # BaseContext has no Process in typeshed.
        self.process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=(theirs, initializer, arguments), daemon=True
        )
        # Signal handlers run in the main thread: none of them interrupts a start half-way.
        self._launching = threading.Thread(target=self._launch, args=(theirs,), daemon=True)
        try:
            self._launching.start()
        except RuntimeError:
            self.pipe.close()
            theirs.close()
            raise

    def _launch(self, theirs: Connection) -> None:
        try:
            with _ONE_AT_A_TIME, without_interrupt_key():
                if not self._abandoned:
                    self.process.start()
                    self._launched = True
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            theirs.close()  # the pipe ends with the process now, or at once

    def waits_for(self) -> list[Any]:
        """What `multiprocessing.connection.wait` waits for: the pipe, and the end of the process."""
        return [self.pipe, self.process.sentinel] if self._launched else [self.pipe]

    def send(self, message: bytes) -> None:
        """Begin to send a message; `receive` sends the rest of it. Raises OSError where the process has ended."""
        self._to_send, self.heard_s = _chunks(message), 0.0
        self.pipe.send_bytes(next(self._to_send))

    def receive(self) -> bytes | None:
        """The next whole message; None where there is none yet, or where there will be none: then `at_end` is set."""
        try:
            while self.pipe.poll():
                chunk = self.pipe.recv_bytes()
                self.heard_s = time.monotonic()
                if chunk[:1] == _ASKS:
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
        """True where the process has ended or cannot be reached, and all that it sent is received."""
        return self.at_end or (self._launched and bool(wait([self.process.sentinel], 0)) and not self.pipe.poll())

    def let_end(self) -> None:
        """Tell an idle process that nothing more comes; one that has not been launched yet is not launched."""
        self._abandoned = True
        self.pipe.close()

    def kill(self, within_s: float = ENDS_WITHIN_S) -> None:
        """End the process whatever it does. One that is still being launched then ends by itself."""
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
        """True where nothing holds the other end of the pipe."""
        while not self.pipe.closed and self.receive() is not None:
            pass
        return self.pipe.closed or self.at_end

    def exit_code(self, within_s: float = ENDS_WITHIN_S) -> int | None:
        """The exit code, -n for signal n; None where it never started or does not end."""
        if not self._launched or not wait([self.process.sentinel], within_s):
            return None
        if not _ONE_AT_A_TIME.acquire(timeout=ENDS_WITHIN_S):
            return None
        try:
            code: int | None = self.process.exitcode
            return code
        finally:
            _ONE_AT_A_TIME.release()


def is_out_of_memory(exit_code: int | None) -> bool:
    """True where a worker ended because it had no memory to send its result."""
    return exit_code == _OUT_OF_MEMORY_EXIT_CODE


def _chunks(message: bytes) -> Iterator[bytes]:
    """The message in chunks, each with its first byte."""
    starts = range(0, len(message), _CHUNK_BYTES)
    for start in starts:
        kind = _LAST if start == starts[-1] else _MORE
        yield kind + message[start : start + _CHUNK_BYTES]


def _work(pipe: Connection, initializer: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    """What a worker process does: initialise, then one task after another until the parent closes the pipe."""
    try:
        try:
            initializer(*arguments)
        except Exception as error:
            _send(pipe, pickle.dumps((False, f"{type(error).__name__}: {error}")))
            return
        _send(pipe, pickle.dumps((True, None)))
        while True:
            _send(pipe, _answer(_receive(pipe)))
    except (EOFError, OSError):
        return
    except MemoryError:
        os._exit(_OUT_OF_MEMORY_EXIT_CODE)


def _answer(message: bytes) -> bytes:
    """The pickled (True, result) or (False, exception) of a task."""
    try:
        function, argument = pickle.loads(message)
        return pickle.dumps((True, function(argument)), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)  # some exceptions can be pickled, but not unpickled
        except Exception:
            answer = pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer


def _send(pipe: Connection, message: bytes) -> None:
    for chunk in _chunks(message):
        pipe.send_bytes(chunk)


def _receive(pipe: Connection) -> bytes:
    """A whole message. Raises EOFError where the parent has closed the pipe or has ended."""
    message = bytearray()
    while True:
        chunk = pipe.recv_bytes()
        message += chunk[1:]
        if chunk[:1] == _LAST:
            return bytes(message)
        pipe.send_bytes(_ASKS)
