"""What agalign asks of a camera. A new camera is one module with one class of this shape, and one test."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from agalign.geometry import Matrix
from agalign.metadata import Tags
from agalign.raster import RasterInfo
from agalign.records import Band

_PREFERRED_REFERENCES = ("green", "gre", "g")


class Camera(Protocol):
    """How one family of cameras names, groups and relates its bands."""

    name: str

    def recognises(self, tags: Tags) -> bool:
        """True for files of this camera."""
        ...

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        """The bands in one of its files."""
        ...

    def capture_key(self, path: Path, tags: Tags) -> str:
        """Files with the same key (and the same camera) are one capture."""
        ...

    def capture_name(self, path: Path) -> str:
        """The part of a file's name that the bands of its capture share."""
        ...

    def rig_seed(self, reference: Band, moving: Band) -> Matrix | None:
        """fixed_to_moving between undistorted pixels from metadata alone; None where it does not tell."""
        ...


def default_reference(bands: Sequence[Band]) -> int:
    """Index of the green band; else of the one nearest to 550 nm; else the first. Never a thermal one."""
    for index, band in enumerate(bands):
        if re.split(r"[-_ ]", band.name.lower())[0] in _PREFERRED_REFERENCES:
            return index
    known = [(abs(b.wavelength_nm - 550), i) for i, b in enumerate(bands) if b.wavelength_nm is not None]
    return min(known)[1] if known else 0


def largest_value(dtype: str) -> float | None:
    """The value at which an integer type saturates; None for floats."""
    return {"uint8": 255.0, "uint16": 65535.0, "int16": 32767.0}.get(dtype)
