"""Equality of records with arrays, whose `==` would be an array."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel


def equal(one: Any, other: Any) -> bool:
    """Return True for equal values: records field by field, arrays element by element, and nan equals nan.

    It is the `__eq__` of records, so that a copy, such as one that was pickled, equals its original.
    """
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return False
    if is_dataclass(one) or isinstance(one, BaseModel):
        return type(one) is type(other) and all(equal(getattr(one, k), getattr(other, k)) for k in _compared(one))
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return type(one) is type(other) and len(one) == len(other) and all(map(equal, one, other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    return bool(one == other) or (one != one and other != other)


def _compared(record: Any) -> list[str]:
    if isinstance(record, BaseModel):
        return [*type(record).model_fields]
    return [field.name for field in fields(record) if field.compare]
