"""One capture, start to end: its pairs aligned, its stack and sidecar written."""

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agalign import geometry
from agalign.config import Settings, WriteSettings
from agalign.describe import describe_capture
from agalign.errors import AgalignError, InputError, SidecarError
from agalign.flight import FlightModel
from agalign.mapping import Mapping as PixelMapping
from agalign.pair import PairProgress, align_capture_bands, mapping_of
from agalign.picture import write_picture
from agalign.records import Alignment, Band, Capture, Grid, Tile
from agalign.sidecar import Sidecar, read_sidecar, write_sidecar
from agalign.stac import write_item
from agalign.warp import common_area
from agalign.write import Layer, write_capture


def quiet(*_: object) -> None:
    """A progress callback that reports nothing."""


@dataclass(frozen=True)
class CaptureOutcome:
    """A capture's sidecar and where it was written."""

    sidecar: Sidecar
    path: Path


def output_paths(capture: Capture, out: Path) -> tuple[Path, Path]:
    """(stack, sidecar) of a capture below the output folder."""
    folder = out / capture.folder
    return folder / f"{capture.name}.tif", folder / f"{capture.name}.json"


def process_capture(
    capture: Capture, out: Path, settings: Settings, progress: PairProgress = quiet,
    model: FlightModel | None = None,
) -> CaptureOutcome:  # fmt: skip
    """Align a capture and write its stack and sidecar; a band that cannot be aligned does not stop the others.

    With the flight's `model` only what it cannot align is learnt anew.
    Raises UnreadableFileError where the reference itself cannot be read, and OutputError.
    """
    reference = capture.reference
    if settings.write.radiometry:
        _need_radiometry(capture)
    alignments = align_capture_bands(capture, settings, model, progress)
    progress(reference.name, "writing", 0.0)
    stack_path, sidecar_path = output_paths(capture, out)
    usable = [b for b in capture.moving if alignments[b.name].status != "failed"]
    picture = stack_path.with_suffix(".png")
    discard_outputs(stack_path, sidecar_path)
    written = None
    if usable:
        layers, grid = lay_out(capture, {b.name: alignments[b.name] for b in usable}, settings.write)
        written = write_capture(capture, layers, grid, stack_path, settings.write)
        # The picture is a convenience: a full disk must not cost the sidecar.
        with suppress(AgalignError):
            write_picture(capture, written.places, grid, usable, picture)
        if settings.write.stac:
            write_item(capture, written, sidecar_path, picture)
    sidecar = describe_capture(capture, alignments, written, settings)
    write_sidecar(sidecar_path, sidecar)
    return CaptureOutcome(sidecar, sidecar_path)


def discard_outputs(stack: Path, sidecar: Path) -> None:
    """What an earlier run wrote of a capture goes before something else takes its place: a sidecar never stands beside
    rasters that it does not describe, nor a band on an old grid beside new ones.
    """
    with suppress(SidecarError):
        output = read_sidecar(sidecar).output
        for part in output.band_files if output else []:
            (sidecar.parent / part.file).unlink(missing_ok=True)
    for path in (sidecar, stack, stack.with_suffix(".png"), stack.with_suffix(".stac.json")):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def lay_out(capture: Capture, alignments: Mapping[str, Alignment], settings: WriteSettings) -> tuple[list[Layer], Grid]:
    """The layers of a capture, whose usable moving bands have these alignments, and the grid they are written on."""
    reference = capture.reference
    mappings = {b.name: mapping_of(reference, b, alignments[b.name]) for b in capture.moving if b.name in alignments}
    scale = _finest_scale(mappings.values(), reference) if settings.resolution == "finest" else 1.0
    own = PixelMapping(geometry.identity())
    undistorted = settings.undistort and reference.lens is not None
    if reference.lens is not None and undistorted:
        own = PixelMapping(geometry.identity(), None, reference.lens)
        mappings = {name: mapping.from_undistorted(reference.lens) for name, mapping in mappings.items()}
    size_px = round(reference.width_px * scale), round(reference.height_px * scale)
    scales = size_px[0] / reference.width_px, size_px[1] / reference.height_px
    if scale != 1.0:
        own = own.rescaled(scales, (1.0, 1.0))
        mappings = {name: mapping.rescaled(scales, (1.0, 1.0)) for name, mapping in mappings.items()}
    copied = scale == 1.0 and not undistorted
    layers = [
        Layer(b, None if copied else own, is_reference=True) if b is reference else Layer(b, mappings.get(b.name))
        for b in capture.bands
    ]
    moved = [(layer.mapping, layer.band) for layer in layers if layer.mapping is not None]
    crop = common_area(moved, *size_px) if settings.crop == "common" else None
    crop = crop or Tile(0, 0, *size_px)
    return layers, Grid(crop.x0, crop.y0, crop.width, crop.height, scales, undistorted)


def _finest_scale(mappings: Iterable[PixelMapping], reference: Band) -> float:
    """How many of the finest band's pixels lie along one of the reference's, in the middle of the image."""
    middle = (np.array(reference.size_px) - 1) / 2
    finest = 1.0
    for mapping in mappings:
        across = np.stack([mapping(middle + d) - mapping(middle - d) for d in 0.5 * np.eye(2)])
        finest = max(finest, math.sqrt(abs(float(np.linalg.det(across)))))
    return round(finest, 2)


def _need_radiometry(capture: Capture) -> None:
    without = [b.name for b in capture.bands if b.radiometry is None]
    if without:
        raise InputError(
            f"{capture.reference.path}: no tags that agalign can turn into reflectance in {', '.join(without)}; leave "
            "--radiometry out"
        )
