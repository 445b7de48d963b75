"""What the workers of test_process_pool.py do: it loads no library that takes time."""

import logging
import os
import pickle
import time
from multiprocessing.connection import Connection
from pathlib import Path


def start_first_only(folder: Path) -> None:
    """The first worker starts, the others do not."""
    try:
        (folder / "first").mkdir()
    except FileExistsError:
        raise ValueError("no room") from None


def log_level(logger: str) -> str:
    return logging.getLevelName(logging.getLogger(logger).level)


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def signal_self(mark: Path, number: int, times: int) -> None:
    """Send this process a signal, up to a total that `mark` counts."""
    with mark.open("a+b") as counter:
        before = counter.tell() or mark.stat().st_size
        counter.write(b"x")
    if before < times:
        os.kill(os.getpid(), number)


def signalled(task: tuple[Path, int, int]) -> None:
    """A task that sends itself a signal."""
    signal_self(*task)


def sent_in_part(task: tuple[Path, int, int]) -> None:
    """A task that sends its process a signal when part of the result is on its way."""
    send = Connection._send

    def send_in_part(pipe: Connection, data: bytes) -> None:
        send(pipe, data[:5])
        signal_self(*task)
        send(pipe, data[5:])

    Connection._send = send_in_part


class WhenUnpickled:
    """It sends a signal to the process that unpickles it, up to a total."""

    def __init__(self, mark: Path, number: int, times: int) -> None:
        self.what = mark, number, times

    def __setstate__(self, state: dict[str, tuple[Path, int, int]]) -> None:
        self.__dict__ = state
        signal_self(*self.what)


def received(_: object) -> None:
    pass


class TwoArgumentsError(Exception):
    def __init__(self, one: str, _two: str) -> None:
        super().__init__(one)


class NotUnpicklable:
    def __reduce__(self) -> tuple[object, ...]:
        return pickle.loads, (b"nonsense",)


def unusual_outcome(kind: str) -> object:
    """An error, or a result that cannot be sent."""
    match kind:
        case "error that cannot be unpickled":
            raise TwoArgumentsError("a", "b")
        case "result that cannot be unpickled":
            return NotUnpicklable()
        case "result that cannot be pickled":
            return lambda: None
    raise KeyError(kind)


def without_memory(_: int) -> None:
    raise MemoryError
