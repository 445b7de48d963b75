"""Captures of georeferenced mosaics: one for each pair of a reference mosaic and a moving one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agalign.cameras.base import reference_index
from agalign.cameras.generic import Generic
from agalign.cameras.metadata import read_tags
from agalign.cameras.naming import with_unique_band_names, with_unique_capture_names
from agalign.errors import InputError
from agalign.pixels.raster import probe
from agalign.values.capture import Band, Capture
from agalign.values.choices import MAX_MOSAIC_PIXELS


def captures_onto(
    reference: Path, moving: Sequence[Path], band: str | None = None, max_pixels: int = MAX_MOSAIC_PIXELS
) -> list[Capture]:
    """One capture for each moving mosaic, to be aligned to the grid of the reference mosaic: the reference's `band`
    (None for the default, the green one) and all bands of the moving mosaic, which share one mapping.

    Raises UnreadableFileError, InputError where a mosaic is not georeferenced, NoSuchBandError.
    """
    reference_bands = _georeferenced_bands(reference, max_pixels)
    fixed = reference_bands[reference_index(reference_bands, band, reference)]
    fixed = replace(fixed, name=f"{reference.stem} {fixed.name}")
    captures = []
    for path in moving:
        if path.resolve() == reference.resolve():
            raise InputError(f"{path}: is the reference itself; name the mosaics that are to be aligned to it")
        bands = [fixed, *(replace(b, one_lens=True, companion=False) for b in _georeferenced_bands(path, max_pixels))]
        captured_at = read_tags(path).captured_at
        captures.append(Capture(path.stem, Path(), tuple(with_unique_band_names(bands)), 0, captured_at=captured_at))
    return with_unique_capture_names(captures)


def _georeferenced_bands(path: Path, max_pixels: int) -> tuple[Band, ...]:
    info = probe(path, max_pixels)
    if info.georeference is None:
        raise InputError(f"{path}: has no coordinates; align images without by 'agalign FOLDER'")
    return Generic().bands(path, read_tags(path), info)
