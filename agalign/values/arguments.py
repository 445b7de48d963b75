"""Arguments of the public functions: their types are checked before anything is done."""

import inspect
import os
from collections.abc import Callable, Sequence
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as shortened_repr
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, get_args, get_origin

import numpy as np

from agalign.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
_NAMES: dict[Any, str] = {str: "a text", bool: "True or False", int: "an integer", float: "a number", Path: "a path"}
_PLURALS = {"a text": "texts", "a path": "paths"}


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that an argument that does not fit its annotation raises InputError with one line.

    Annotations in quotes are those of arrays, which the functions convert themselves.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> R:
        for name, value in signature.bind(*args, **named).arguments.items():
            hint = signature.parameters[name].annotation
            if not _fits(value, hint):
                choices = ", ".join(map(str, get_args(hint)))
                remedy = f"; choose from {choices}" if get_origin(hint) is Literal else f", not {_text(hint)}"
                raise InputError(f"{name} is {shortened_repr(value)}{remedy}")
        return function(*args, **named)

    return call


def _fits(value: object, hint: Any) -> bool:
    """Return True if a value has the type of an annotation, or the annotation is not one of those checked here."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is UnionType:
        return any(_fits(value, one) for one in arguments if not (one is str and Path in arguments))
    if origin is Literal:
        return isinstance(value, str) and value in arguments
    if origin is Sequence:
        if not isinstance(value, Sequence) or isinstance(value, str | bytes):
            return False
        return all(_fits(one, arguments[0]) for one in value)
    if origin is Callable:
        return callable(value)
    if hint is Path:
        return _is_path(value)
    if hint is float:
        return isinstance(value, Real) and _is_finite_in_float(value)
    if not isinstance(hint, type) or hint is inspect.Parameter.empty:
        return True
    types: dict[Any, tuple[type, ...]] = {bool: (bool, np.bool_), int: (Integral,)}
    return isinstance(value, types.get(hint, (hint,)))


def _is_path(value: object) -> bool:
    """True for a text or path that the system can have."""
    if not isinstance(value, str | os.PathLike) or not isinstance(os.fspath(value), str):
        return False
    try:
        return b"\0" not in os.fsencode(value)
    except UnicodeEncodeError:
        return False


def _is_finite_in_float(value: Real) -> bool:
    """False for integers beyond the range of floats; nan and infinity are floats."""
    try:
        float(value)
    except OverflowError:
        return False
    return True


def _text(hint: Any) -> str:
    """The types of an annotation in words."""
    if get_origin(hint) is UnionType:
        return next(_text(one) for one in reversed(get_args(hint)) if one is not NoneType)
    if get_origin(hint) is Sequence:
        name = _text(get_args(hint)[0])
        return f"a sequence of {_PLURALS.get(name, name)}"
    if get_origin(hint) is Callable:
        return "a function"
    return _NAMES.get(hint, f"{getattr(hint, '__name__', hint)}")
