"""Captures of georeferenced mosaics: one for each moving mosaic, together with a band of the reference mosaic."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agalign.cameras.base import reference_index
from agalign.cameras.generic import Generic
from agalign.cameras.grouping import with_unique_band_names, with_unique_capture_names
from agalign.cameras.metadata import read_tags
from agalign.errors import InputError
from agalign.pixels.raster import probe, transformed
from agalign.values import geometry
from agalign.values.capture import Band, Capture
from agalign.values.choices import MAX_MOSAIC_PIXELS


def captures_onto(
    reference: Path, moving: Sequence[Path], band: str | None = None, max_pixels: int = MAX_MOSAIC_PIXELS
) -> list[Capture]:
    """Return a capture for each moving mosaic: the reference's `band` (None for the default, green) and all bands of
    the moving mosaic, which share one mapping.

    Raises UnreadableFileError, InputError if a mosaic is not georeferenced, NoSuchBandError.
    """
    reference_bands = _georeferenced_bands(reference, max_pixels)
    fixed = reference_bands[reference_index(reference_bands, band, reference)]
    # By its wavelength, it would be displayed, and taken for indices, with the bands of another date.
    fixed = replace(fixed, name=f"{reference.stem} {fixed.name}", wavelength_nm=None, bandwidth_nm=None)
    captures = []
    for path in moving:
        if path.resolve() == reference.resolve():
            raise InputError(f"{path}: is the reference itself; give the mosaics to be aligned to it")
        bands = [fixed, *(replace(b, one_lens=True, companion=False) for b in _georeferenced_bands(path, max_pixels))]
        captured_at = read_tags(path).captured_at
        captures.append(Capture(path.stem, Path(), tuple(with_unique_band_names(bands)), 0, captured_at=captured_at))
    return with_unique_capture_names(captures)


def distance_km(fixed: Band, moving: Band) -> float:
    """Return the distance between the centres of two georeferenced rasters on the ground; 0 if they may overlap.

    Raises GeometryError if their coordinates cannot be transformed.
    """
    centres_and_corners = []
    for band in (fixed, moving):
        assert band.georeference is not None
        width, height = band.size_px
        on_map = geometry.apply(band.georeference.transform, np.array([[width / 2, height / 2], [0.0, 0.0]]))
        centres_and_corners.append(np.radians(transformed(on_map, band.georeference.crs_wkt, "EPSG:4326")))
    half_diagonals_km = sum(_great_circle_km(centre, corner) for centre, corner in centres_and_corners)
    result_km = _great_circle_km(centres_and_corners[0][0], centres_and_corners[1][0])
    return result_km if result_km > half_diagonals_km else 0.0


def _great_circle_km(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Distance of two points (longitude, latitude), radians, by the haversine formula with the mean radius: accurate to
    0.5 %, which is sufficient for comparing the extents of maps.
    """
    haversine = np.sin((other - one) / 2) ** 2
    result = haversine[1] + np.cos(one[1]) * np.cos(other[1]) * haversine[0]
    return float(2 * 6371.0 * np.arcsin(np.sqrt(min(1.0, result))))


def _georeferenced_bands(path: Path, max_pixels: int) -> tuple[Band, ...]:
    stored = probe(path, max_pixels)
    if stored[0].georeference is None:
        raise InputError(f"{path}: has no coordinates; align images without by 'agalign FOLDER'")
    return Generic().bands(path, read_tags(path), stored)
