"""A capture's bands as grey pictures, before and after: the source of the picture and the preview."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.errors import UnreadableFileError
from agalign.pixels.raster import read_preview
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid, reduced_size_px

Grey = NDArray[np.uint8]
"""(height, width)"""
_MAX_SIDE_PX = 2048
"""More than a screen shows."""


@dataclass(frozen=True)
class ReducedBands:
    """The bands of a capture on the grid of its aligned files, reduced where that is larger than a screen."""

    before: Mapping[str, Grey]
    """By band that can be read: the raw file, resized to the reference's."""
    after: Mapping[str, Grey]
    """By band that was written: what was written."""
    size_px: tuple[int, int]
    """(width, height) of all of them."""


def read_reduced_bands(capture: Capture, places: Mapping[str, tuple[Path, int]], grid: OutputGrid) -> ReducedBands:
    """Views of a capture with bands written to `places` on a grid. Raises UnreadableFileError."""
    size_px = _reduced(grid.width, grid.height)
    whole = 0, 0, grid.width, grid.height
    before = {}
    for band in capture.bands:
        with suppress(UnreadableFileError):  # its pair has failed with a reason
            before[band.name] = _grey(_before(band, capture.reference, grid, size_px))
    after = {name: _grey(read_preview(*place, whole, size_px)) for name, place in places.items()}
    return ReducedBands(before, after, size_px)


def _before(band: Band, reference: Band, grid: OutputGrid, size_px: tuple[int, int]) -> NDArray[np.float32]:
    sx, sy = (n / (s * m) for n, s, m in zip(band.size_px, grid.scale, reference.size_px, strict=True))
    window = (
        round(grid.x0 * sx), round(grid.y0 * sy), max(1, round(grid.width * sx)), max(1, round(grid.height * sy)),
    )  # fmt: skip
    return read_preview(band.path, band.band_index, window, size_px)


def _reduced(width: int, height: int) -> tuple[int, int]:
    reduction = max(1.0, max(width, height) / _MAX_SIDE_PX)
    return reduced_size_px((width, height), reduction)


def _grey(plane: NDArray[np.float32]) -> Grey:
    """Each by its own limits: what is written may be reflectance of what the files have as numbers."""
    low, high = _limits(plane)
    scaled = np.subtract(plane, np.float32(low))
    scaled *= np.float32(255.0 / (high - low))
    cv2.patchNaNs(scaled, 0.0)
    return np.asarray(np.clip(scaled, 0, 255, out=scaled).astype(np.uint8))


_SAMPLE_PIXELS = 20_000
"""Pixels that the limits of the grey values are taken from: percentiles are right to a tenth of a percent."""


def _limits(plane: NDArray[np.float32]) -> tuple[float, float]:
    sample = plane.ravel()[:: max(1, plane.size // _SAMPLE_PIXELS)]
    sample = sample[np.isfinite(sample) & (sample != 0)]
    if sample.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(sample, (1.5, 98.5))
    return float(low), max(float(high), float(low) + 1e-9)
