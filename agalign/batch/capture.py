"""One capture, start to end: its pairs aligned, its stack and sidecar written."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from agalign.capture.align import PairProgress, align_capture_bands
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, InputError, SidecarError
from agalign.flight.model import FlightModel
from agalign.flight.rig import Rig
from agalign.products.error_map import error_lattice_px, write_error_map
from agalign.products.fill_sidecar import sidecar_of
from agalign.products.indices import INDICES
from agalign.products.layout import output_layers
from agalign.products.pan_sharpen import need_panchromatic, write_pan_sharpened
from agalign.products.picture import choose_bands, write_picture
from agalign.products.preview import preview_bytes, write_preview
from agalign.products.reduced_bands import read_reduced_bands
from agalign.products.sidecar import PreviewPart, Sidecar, read_sidecar, write_sidecar
from agalign.products.stac import write_item
from agalign.products.write import Written, band_file_names, write_capture
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.choices import Layout, RadiometryChoice
from agalign.values.image import OutputGrid


def quiet(*_: object) -> None:
    """A progress callback that reports nothing."""


@dataclass(frozen=True)
class CaptureOutcome:
    """A capture's sidecar and where it was written."""

    sidecar: Sidecar
    path: Path
    shortcomings: tuple[str, ...] = ()
    """What was not written though the capture is done, and why."""


def output_paths(capture: Capture, out: Path) -> tuple[Path, Path]:
    """(stack, sidecar) of a capture below the output folder."""
    folder = out / capture.folder
    return folder / f"{capture.name}.tif", folder / f"{capture.name}.json"


def picture_path(stack: Path) -> Path:
    """The before/after picture beside a stack."""
    return stack.with_suffix(".png")


def preview_path(stack: Path) -> Path:
    """The sheet of small pictures beside a stack."""
    return stack.with_suffix(".preview.jpg")


def error_map_path(stack: Path) -> Path:
    """The raster of expected errors beside a stack."""
    return stack.with_suffix(".error.tif")


def pan_sharpened_path(stack: Path) -> Path:
    """The sharpened bands beside a stack."""
    return stack.with_suffix(".pan.tif")


def process_capture(
    capture: Capture, out: Path, settings: Settings, progress: PairProgress = quiet,
    model: FlightModel | None = None, max_preview_bytes: int = preview_bytes(1),
) -> CaptureOutcome:  # fmt: skip
    """Align a capture and write its stack and sidecar; a band that cannot be aligned does not stop the others.

    Its bands' radiometry is what was chosen for them (`with_radiometry`). With the flight's `model` only what it cannot
    align is learnt anew. Its preview has about as many bytes as it may have.
    Raises UnreadableFileError where the reference itself cannot be read, and OutputError.
    """
    reference, rig = capture.reference, None if model is None else model.rig
    if settings.write.radiometry != "off":
        _need_radiometry(capture, settings.write.radiometry)
    if settings.write.pan_sharpen:
        need_panchromatic(capture)
    alignments = align_capture_bands(capture, settings, model, progress)
    progress(reference.name, "writing", 0.0)
    stack_path, sidecar_path = output_paths(capture, out)
    usable = {b.name: alignments[b.name] for b in capture.moving if alignments[b.name].status != "failed"}
    discard_outputs(stack_path, sidecar_path)
    written = _write_rasters(capture, usable, stack_path, settings.write, rig) if usable else None
    preview: PreviewPart | None = None
    shortcomings: tuple[str, ...] = ()
    try:
        preview = _write_pictures(capture, usable, written, stack_path, settings.write, max_preview_bytes)
    except AgalignError as error:
        # Pictures are a convenience: they must not cost the sidecar.
        shortcomings = (str(error),)
    if written is not None and settings.write.stac:
        more = (picture_path(stack_path), "thumbnail"), (error_map_path(stack_path), "metadata")
        beside = [*more, (pan_sharpened_path(stack_path), "data")]
        write_item(capture, written, sidecar_path, settings.write, beside)
    sidecar = sidecar_of(capture, alignments, written, settings, preview)
    write_sidecar(sidecar_path, sidecar)
    return CaptureOutcome(sidecar, sidecar_path, shortcomings)


def _write_rasters(
    capture: Capture, usable: Mapping[str, Alignment], stack: Path, settings: WriteSettings, rig: Rig | None
) -> Written:
    layers, grid = output_layers(capture, usable, settings, rig)
    written = write_capture(capture, layers, grid, stack, settings)
    if settings.pan_sharpen:
        write_pan_sharpened(capture, usable, pan_sharpened_path(stack), settings, rig)
    if settings.error_map:
        write_error_map(capture, usable, grid, error_map_path(stack))
    return written


def _write_pictures(
    capture: Capture, usable: Mapping[str, Alignment], written: Written | None, stack: Path, settings: WriteSettings,
    max_bytes: int,
) -> PreviewPart:  # fmt: skip
    """The picture, where something was written, and the preview: that of a capture which came to nothing shows why."""
    reference = capture.reference
    grid = OutputGrid(0, 0, *reference.size_px) if written is None else written.grid
    views = read_reduced_bands(capture, {} if written is None else written.places, grid)
    if written is not None:
        chosen = choose_bands([b for b in capture.moving if b.name in usable], reference)
        write_picture(views, [b.name for b in chosen], picture_path(stack))
    errors_px = {n: error_lattice_px(a, reference.size_px, grid) for n, a in usable.items()}
    return write_preview(
        views, [b.name for b in capture.bands], errors_px if settings.error_map else {}, preview_path(stack), max_bytes
    )


def paths_written(capture: Capture, out: Path, layout: Layout) -> list[Path]:
    """Everything that may be written of a capture."""
    stack, sidecar = output_paths(capture, out)
    bands = () if layout == "stack" else dict.fromkeys(band_file_names(capture).values())
    return [*_beside(stack, sidecar), *(stack.parent / name for name in bands)]


def _beside(stack: Path, sidecar: Path) -> list[Path]:
    """Every file of a capture but those of single bands."""
    of_stack = (picture_path, preview_path, error_map_path, pan_sharpened_path)
    return [sidecar, stack, stack.with_suffix(".stac.json"), *(path(stack) for path in of_stack)]


def discard_outputs(stack: Path, sidecar: Path) -> None:
    """What an earlier run wrote of a capture, and what indices were made of it, goes before something else takes its
    place: a sidecar never stands beside rasters that it does not describe, nor a band on an old grid beside new ones.

    What cannot be removed is written over, or told by the writing that fails.
    """
    old = _beside(stack, sidecar)
    with suppress(SidecarError):
        output = read_sidecar(sidecar).output
        old += [sidecar.parent / part.file for part in output.band_files] if output else []
    for name in INDICES:
        # Unless a capture has that name.
        if not stack.with_name(f"{stack.stem}_{name}.json").exists():
            old += [stack.with_name(f"{stack.stem}_{name}{suffix}") for suffix in (".tif", ".png")]
    for path in old:
        with suppress(OSError):
            path.unlink(missing_ok=True)


_WHY_NOT: Mapping[RadiometryChoice, str] = {
    "auto": "no tags that agalign can turn into radiance or reflectance in {bands}; leave --radiometry out",
    "camera": "no tags that agalign can turn into radiance in {bands}; leave --radiometry out",
    "sun": "no tags of a light sensor in {bands}; choose --radiometry camera or panel",
    "panel": "no calibration panel of the same hours says how bright {bands} is, or its reflectance is not known "
    "(--panel-albedo); choose --radiometry camera or sun",
}


def _need_radiometry(capture: Capture, choice: RadiometryChoice) -> None:
    without = [b.name for b in capture.bands if b.radiometry is None and not b.companion]
    if without:
        raise InputError(f"{capture.reference.path}: {_WHY_NOT[choice].format(bands=', '.join(without))}")
