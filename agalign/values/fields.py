"""Types of the fields of records that are written to JSON: numbers and arrays with their precision in a file, and
their equality.

A record is a frozen dataclass of pydantic with `RECORD`. The program makes it of any floats and arrays; JSON is
validated when it is read: numbers are finite and limited, arrays have their shape, and null is a number that could
not be measured.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from itertools import chain
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from agalign.host.files import is_inside
from agalign.host.text import shortened

RECORD = ConfigDict(extra="forbid", use_attribute_docstrings=True, arbitrary_types_allowed=True, validate_by_name=True)
_MAX = 1e30
"""Largest number in a file: sums and squares of such numbers are finite."""
_LIMITED = core_schema.float_schema(ge=-_MAX, le=_MAX)


def in_file_schema(
    in_file: CoreSchema, to_json: Callable[[Any], Any], read: CoreSchema | None = None, python: CoreSchema | None = None
) -> CoreSchema:
    """Return the schema of a value that is as `in_file` in JSON, where `read` parses it, and any in the program."""
    serialization = core_schema.plain_serializer_function_ser_schema(to_json, return_schema=in_file, when_used="json")
    python = python or core_schema.any_schema()
    return core_schema.json_or_python_schema(read or in_file, python, serialization=serialization)


@dataclass(frozen=True)
class _Limited:
    """A float that is finite and limited in JSON. The program may have any, as those of damaged tags."""

    is_positive: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return in_file_schema(core_schema.float_schema(le=_MAX, gt=0) if self.is_positive else _LIMITED, float)


@dataclass(frozen=True)
class Measured:
    """A float with these decimals in JSON, where null is `missing`."""

    decimals: int | None = None
    missing: float = math.nan

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        in_file = core_schema.nullable_schema(_LIMITED)
        read = core_schema.no_info_after_validator_function(lambda v: self.missing if v is None else v, in_file)
        return in_file_schema(in_file, self._to_json, read)

    def _to_json(self, value: float) -> float | None:
        if not math.isfinite(value):
            return None
        return float(value) if self.decimals is None else round(float(value), self.decimals)


@dataclass(frozen=True)
class Array:
    """An array of a shape, None for any length, as nested lists with these decimals in JSON."""

    shape: tuple[int | None, ...]
    decimals: int | None = None
    integers: bool = False
    nullable: bool = False
    """In JSON, null is nan."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        number = core_schema.int_schema(ge=0, le=1 << 31) if self.integers else _LIMITED
        in_file: CoreSchema = core_schema.nullable_schema(number) if self.nullable else number
        for length in reversed(self.shape):
            in_file = core_schema.list_schema(in_file, min_length=length, max_length=length)
        read = in_file
        if self._is_table:
            row = core_schema.tuple_positional_schema([core_schema.float_schema()] * (self.shape[1] or 0))
            read = core_schema.list_schema(row, min_length=self.shape[0], max_length=self.shape[0])
        read = core_schema.no_info_after_validator_function(self._from_json, read)
        return in_file_schema(in_file, self._to_json, read)

    @property
    def _is_table(self) -> bool:
        """True for rows of one length, which are read in half the time of other lists, and then checked together."""
        return len(self.shape) == 2 and bool(self.shape[1]) and not self.integers and not self.nullable

    def _from_json(self, values: Sequence[Any]) -> NDArray[Any]:
        if not values:
            return np.zeros([length or 0 for length in self.shape], np.int64 if self.integers else np.float64)
        if not self._is_table:
            return np.array(values, np.int64 if self.integers else np.float64)
        table = np.fromiter(chain.from_iterable(values), np.float64).reshape(len(values), -1)
        if not (np.abs(table) <= _MAX).all():  # also for nan
            raise ValueError("Input should be finite numbers")
        return table

    def _to_json(self, values: NDArray[Any]) -> Any:
        if self.integers:
            return np.asarray(values).tolist()
        array = np.asarray(values, np.float64)
        rounded = array if self.decimals is None else np.round(array, self.decimals)
        if np.isfinite(rounded).all():
            return rounded.tolist()
        with_null = rounded.astype(object)
        with_null[~np.isfinite(rounded)] = None
        return with_null.tolist()


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


Name = Annotated[str, AfterValidator(partial(shortened, max_length=250))]
"""A name, or another short text, of which a file may have any length: bands with a number have longer names than tags,
which `shortened` cuts.
"""
Message = Annotated[str, AfterValidator(partial(shortened, max_length=1000))]
"""A sentence, of which a file may have any length. It may name a file with its folders."""
Number = Annotated[float, _Limited()]
Count = Annotated[int, Field(gt=0)]
Positive = Annotated[float, _Limited(is_positive=True)]
Number3 = Annotated[float, Measured(3)]
Number4 = Annotated[float, Measured(4)]
Number6 = Annotated[float, Measured(6)]
"""Digits beyond the sixth depend on the order in which threads add up."""
UpToInfinity = Annotated[float, Measured(6, math.inf)]
"""A standard error; null if it is infinite."""
Matrix3x3 = Annotated[NDArray[np.float64], Array((3, 3))]
POSITION_DECIMALS = 4
"""Of positions and displacements, px: a hundredth of the error of an alignment."""
PointsPx = Annotated[NDArray[np.float64], Array((None, 2), POSITION_DECIMALS)]


def _inside_folder(name: str) -> str:
    if not is_inside(name):
        raise ValueError("names a file outside its folder, or has too long a name")
    return name


SourceFile = Annotated[str, Field(max_length=4096)]
"""Path of an input file, of the length that Linux allows. It is not opened."""
RelativeFile = Annotated[str, AfterValidator(_inside_folder)]
"""A file in the sidecar's folder or below. A sidecar may come from anyone, and agalign reads and removes the files that
it lists.
"""
