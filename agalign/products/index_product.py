"""The spectral indices that a run writes in the same pass, with `--index`."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, InputError, OutputError
from agalign.products.index_rasters import IndexBand, write_rasters
from agalign.products.indices import bands_for, index_named
from agalign.products.product import CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import GEOTIFF
from agalign.values.capture import Band, Capture


class IndexRasters(Product):
    """A raster and a picture of each index that was asked for, where its bands are aligned."""

    kind = "index"
    is_required = False

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True with `--index`."""
        return bool(settings.indices)

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """<capture>_<index>.tif and .png."""
        names = [name.strip().lower() for name in settings.indices]
        return [paths.file(f"_{name}{suffix}") for name in names for suffix in (".tif", ".png")]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write the indices of bands that the capture has and that are delivered.

        Raises InputError for one with bands in the wrong unit, OutputError.
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
            # What is written is still removed before the capture is done again.
            context.written.extend(result)
            raise InputError("; ".join(problems))
        return result


def check_indices(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError for an unknown index, and for one that no capture can have."""
    for name in settings.indices:
        index = index_named(name)
        able = [c for c in captures if _has_bands(c.bands, name)]
        if captures and not able:
            known = ", ".join(dict.fromkeys(b.name for c in captures for b in c.bands))
            raise ConfigurationError(
                f"--index {name}: needs bands {', '.join(index.roles)}, and no capture has them all; there are {known}"
            )
        raw = settings.radiometry == "off" and all(np.dtype(b.dtype).kind in "ui" for c in able for b in c.bands)
        if able and raw and not index.any_unit:
            raise ConfigurationError(f"--index {name}: needs reflectance; add --radiometry")


def _has_bands(bands: Sequence[Band], name: str) -> bool:
    own = [b for b in bands if not b.companion]
    try:
        return bool(bands_for(index_named(name), [b.name for b in own], [b.wavelength_nm for b in own]))
    except InputError:
        return False


def _bands(context: ProductContext) -> list[IndexBand]:
    limit_px, sums, result = context.settings.check.accept_predicted_px, dict[Path, str](), []
    for band in context.capture.bands:
        alignment = context.alignments.get(band.name)  # none of the reference
        status = "reference" if alignment is None else alignment.status
        prediction = None if alignment is None else alignment.prediction
        delivered = status in ("reference", "aligned") or (
            status == "predicted" and (prediction is None or prediction.std_px <= limit_px)
        )
        file, number = context.places.get(band.name, (Path(), 1))
        problem = "" if delivered and band.name in context.places else f"{band.name} is {status}"
        if not problem and file not in sums:
            sums[file] = _sha256(file)
        result.append(IndexBand(band.name, band.wavelength_nm, file, number, sums.get(file, ""), problem))
    return result


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read back ({error.strerror or error})") from None
