"""The type of functions that apply a function to arguments, in this process or on workers."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

A = TypeVar("A")
R = TypeVar("R")


class Apply(Protocol):
    """Applies a function to each argument and yields the results in order, as `map` does in this process.

    Function, arguments and results can be pickled. Raises the errors of the function, and WorkerError for lost workers.
    """

    def __call__(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]: ...
