"""What the workers of test_process_pool.py do: it loads no library that takes time."""

import logging
import os
import pickle
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path


def nothing() -> None:
    pass


def refuse() -> None:
    raise ValueError("no room")


def refuse_after_first(folder: Path) -> None:
    """The first worker starts, the others do not."""
    try:
        (folder / "first").mkdir()
    except FileExistsError:
        raise ValueError("no room") from None


def stop_forever() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def log_level(logger: str) -> str:
    return logging.getLevelName(logging.getLogger(logger).level)


def process_id(_: int) -> int:
    return os.getpid()


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def unpicklable(_: int) -> object:
    return lambda: None


def raise_unpicklable(_: int) -> None:
    raise TwoArgumentsError("a", "b")


def raise_key_error(_: int) -> None:
    raise KeyError("what")


def leave(code: int) -> int:
    if code:
        os._exit(code)
    return code


def signal_self(mark: Path, number: int, times: int) -> None:
    """Send this process a signal, up to a total that `mark` counts."""
    with mark.open("a+b") as counter:
        before = counter.tell() or mark.stat().st_size
        counter.write(b"x")
    if before < times:
        os.kill(os.getpid(), number)


def signalled(task: tuple[Path, int, int] | int) -> str:
    """A task that sends itself a signal, or a plain one."""
    if not isinstance(task, int):
        signal_self(*task)
    return "done"


def sent_in_part(task: tuple[Path, int, int]) -> str:
    """A task that sends its process a signal when part of the result is on its way."""
    send = Connection._send

    def send_in_part(pipe: Connection, data: bytes) -> None:
        send(pipe, data[:5])
        signal_self(*task)
        send(pipe, data[5:])

    Connection._send = send_in_part
    return "done"


class TwoArgumentsError(Exception):
    def __init__(self, one: str, _two: str) -> None:
        super().__init__(one)


class WhenUnpickled:
    """It sends a signal to the process that unpickles it, up to a total."""

    def __init__(self, mark: Path, number: int, times: int) -> None:
        self.what = mark, number, times

    def __setstate__(self, state: dict[str, tuple[Path, int, int]]) -> None:
        self.__dict__ = state
        signal_self(*self.what)


def received(_: object) -> str:
    return "done"


class NotUnpicklable:
    def __reduce__(self) -> tuple[object, ...]:
        return pickle.loads, (b"nonsense",)


def result_that_cannot_be_read(_: int) -> NotUnpicklable:
    return NotUnpicklable()


def without_memory(_: int) -> None:
    raise MemoryError
