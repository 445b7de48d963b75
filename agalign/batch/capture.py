"""Align one capture and write its products and its sidecar."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from agalign.capture.align import PairProgress, align_capture_bands
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, ConfigurationError, InputError, SidecarError
from agalign.flight.model import FlightModel
from agalign.flight.rig import Rig
from agalign.products.fill_sidecar import sidecar_of
from agalign.products.index_rasters import outdated_rasters
from agalign.products.layout import output_layers
from agalign.products.preview import preview_bytes
from agalign.products.product import CapturePaths, ProductContext
from agalign.products.registry import PRODUCTS
from agalign.products.sidecar import Sidecar
from agalign.products.sidecar_file import read_result, write_sidecar
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.choices import RadiometryChoice
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import FixedFilePx


def quiet(*_: object) -> None:
    """A progress callback that reports nothing."""


@dataclass(frozen=True)
class CaptureOutcome:
    """A capture's sidecar and where it was written."""

    sidecar: Sidecar
    path: Path
    shortcomings: tuple[str, ...] = ()
    """Messages about optional products that could not be written."""


def process_capture(
    capture: Capture, out: Path, settings: Settings, progress: PairProgress = quiet,
    model: FlightModel | None = None, max_preview_bytes: int = preview_bytes(1),
) -> CaptureOutcome:  # fmt: skip
    """Align a capture, write its products and its sidecar, and return the sidecar with its path.

    The other bands are aligned where one cannot be. The bands already have the chosen radiometry (`with_radiometry`).
    With the `model` of the flight, a network is learned from scratch only for bands that the model cannot align. The
    preview has at most about `max_preview_bytes`.
    Raises UnreadableFileError if the reference cannot be read, InputError or ConfigurationError if the capture or the
    installation lacks what a product needs, and OutputError.
    """
    paths = CapturePaths.of(capture, out)
    _refuse_to_overwrite(capture, out, settings.write)
    if settings.write.radiometry != "off":
        _require_radiometry(capture, settings.write.radiometry)
    for product in PRODUCTS:
        if product.is_enabled(settings.write):
            product.check(capture)
    alignments = align_capture_bands(capture, settings, model, progress)
    progress(capture.reference.name, "writing", 0.0)
    context = _context(capture, paths, settings, alignments, None if model is None else model.rig, max_preview_bytes)
    discard_outputs(capture, out, settings.write)
    failures = _write_products(context)
    sidecar = write_sidecar(paths.sidecar, sidecar_of(context, list(failures)))
    # Products that need the same file fail with the same message.
    return CaptureOutcome(sidecar, paths.sidecar, tuple(dict.fromkeys(failures.values())))


def _context(
    capture: Capture, paths: CapturePaths, settings: Settings, alignments: Mapping[str, Alignment[FixedFilePx]],
    rig: Rig | None, max_preview_bytes: int,
) -> ProductContext:  # fmt: skip
    whole = OutputGrid(0, 0, *capture.reference.size_px)
    context = ProductContext(capture, paths, settings, alignments, (), whole, rig, max_preview_bytes)
    if not context.usable:
        return context
    layers, grid = output_layers(capture, context.usable, settings.write, rig)
    return replace(context, layers=layers, grid=grid)


def _write_products(context: ProductContext) -> dict[str, str]:
    """Write the enabled products; return {kind: message} of optional ones that failed. Raises like `Product.write`."""
    failures: dict[str, str] = {}
    for product in PRODUCTS:
        if not product.is_enabled(context.write_settings) or (product.needs_layers and not context.layers):
            continue
        try:
            context.written.extend(product.write(context))
        except AgalignError as error:
            if product.is_required:
                raise
            failures[product.kind] = str(error)
    return failures


def paths_written(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Return the paths of all files that a run with these settings may write or remove for a capture."""
    paths = CapturePaths.of(capture, out)
    return [paths.sidecar, *(p for product in PRODUCTS for p in product.paths(capture, paths, settings))]


def _refuse_to_overwrite(capture: Capture, out: Path, settings: WriteSettings) -> None:
    """Raise ConfigurationError where an output would replace an image of the capture itself."""
    sources = {band.path.resolve() for band in capture.bands}
    for path in paths_written(capture, out, settings):
        if path.resolve() in sources:
            raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder")


def discard_outputs(capture: Capture, out: Path, settings: WriteSettings) -> None:
    """Remove the outputs of an earlier run for a capture, and the indices calculated from them.

    Otherwise a sidecar could describe rasters of another run, and bands on an old grid could remain among new ones.
    Files that cannot be removed are overwritten later, or their writer reports the error.
    """
    paths = CapturePaths.of(capture, out)
    old = paths_written(capture, out, settings)
    with suppress(SidecarError):
        old += [paths.folder / name for name in read_result(paths.sidecar).files]
        old += outdated_rasters(paths.file(""))
    for path in old:
        with suppress(OSError):
            path.unlink(missing_ok=True)


_REMEDIES: Mapping[RadiometryChoice, str] = {
    "auto": "no tags that agalign can turn into radiance or reflectance in {bands}; leave --radiometry out",
    "camera": "no tags that agalign can turn into radiance in {bands}; leave --radiometry out",
    "sun": "no tags of a light sensor in {bands}; choose --radiometry camera or panel",
    "panel": "no calibration panel of the same hours says how bright {bands} is, or its reflectance is not known "
    "(--panel-albedo); choose --radiometry camera or sun",
}


def _require_radiometry(capture: Capture, choice: RadiometryChoice) -> None:
    without = [b.name for b in capture.bands if b.radiometry is None and not b.companion]
    if without:
        raise InputError(f"{capture.reference.path}: {_REMEDIES[choice].format(bands=', '.join(without))}")
