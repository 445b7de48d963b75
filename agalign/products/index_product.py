"""The spectral indices that `agalign align --index` writes with the other files of a capture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, InputError
from agalign.products.index_bands import IndexBand
from agalign.products.index_rasters import write_rasters
from agalign.products.indices import bands_for, index_named
from agalign.products.product import GEOTIFF, CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.sidecar import is_delivered
from agalign.values.capture import Band, Capture
from agalign.values.files import file_checksum


class IndexRasters(Product):
    """A raster and a picture of each requested index whose bands are aligned."""

    kind = "index"
    is_required = False
    option = "indices"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return <capture>_<index>.tif and .png."""
        names = [name.strip().lower() for name in settings.indices]
        return [paths.file(f"_{name}{suffix}") for name in names for suffix in (".tif", ".png")]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write the indices whose bands the capture has and that are delivered.

        Raises InputError if bands are in the wrong unit, OutputError.
        """
        bands = _bands(context)
        indices = [index_named(name) for name in context.write_settings.indices]
        result = []
        problems = []
        for report in write_rasters(bands, indices, context.paths.file(""), context.capture.label):
            if report.path is not None:
                asset = StacAsset(report.index, GEOTIFF, ("data",))
                result.append(WrittenFile(self.kind, report.path, asset))
                result.append(WrittenFile(self.kind, report.path.with_suffix(".png")))
            elif all(not b.problem for b in bands) and _has_bands(context.capture.bands, report.index):
                problems.append(report.problem)
        if problems:
            # The sidecar lists the complete files, so that they are removed before the capture is processed again.
            context.written.extend(result)
            raise InputError("; ".join(problems))
        return result


def check_indices(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError for an unknown index, and for an index that no capture has the bands or unit for."""
    for name in settings.indices:
        index = index_named(name)
        suitable = [c for c in captures if _has_bands(c.bands, name)]
        if captures and not suitable:
            names = ", ".join(dict.fromkeys(b.name for c in captures for b in c.bands))
            raise ConfigurationError(
                f"--index {name}: needs bands {', '.join(index.roles)}, and no capture has them all; there are {names}"
            )
        raw = settings.radiometry == "off" and all(np.dtype(b.dtype).kind in "ui" for c in suitable for b in c.bands)
        if suitable and raw and not index.any_unit:
            raise ConfigurationError(f"--index {name}: needs reflectance; add --radiometry")


def _has_bands(bands: Sequence[Band], name: str) -> bool:
    narrow = [b for b in bands if not b.companion]
    try:
        return bool(bands_for(index_named(name), [b.name for b in narrow], [b.wavelength_nm for b in narrow]))
    except InputError:
        return False


def _bands(context: ProductContext) -> list[IndexBand]:
    limit_px, places = context.settings.check.accept_predicted_px, context.places
    checksums: dict[Path, str] = {}
    result = []
    for band in context.capture.bands:
        alignment = context.alignments.get(band.name)
        status, prediction = ("reference", None) if alignment is None else (alignment.status, alignment.prediction)
        file, index = places.get(band.name, (Path(), 1))
        delivered = band.name in places and is_delivered(status, prediction, limit_px)
        if delivered and file not in checksums:
            checksums[file] = file_checksum(file)
        problem = "" if delivered else f"{band.name} is {status}"
        result.append(IndexBand(band.name, band.wavelength_nm, file, index, checksums.get(file, ""), problem))
    return result
