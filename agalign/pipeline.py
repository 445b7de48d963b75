"""One capture, start to end: its pairs aligned, its stack and sidecar written."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from agalign import geometry
from agalign.config import Settings
from agalign.describe import describe_capture
from agalign.errors import AgalignError
from agalign.flight import FlightModel
from agalign.mapping import Mapping
from agalign.pair import PairProgress, align_capture_bands, mapping_of
from agalign.picture import write_picture
from agalign.records import Alignment, Capture, Tile
from agalign.seed import RigSeed
from agalign.sidecar import Sidecar, write_sidecar
from agalign.warp import common_area
from agalign.write import Layer, Stack, write_stack


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
    capture: Capture, out: Path, rig_seed: RigSeed, settings: Settings, progress: PairProgress = quiet,
    model: FlightModel | None = None,
) -> CaptureOutcome:  # fmt: skip
    """Align a capture and write its stack and sidecar; a band that cannot be aligned does not stop the others.

    With the flight's `model` only what it cannot align is learnt anew.
    Raises UnreadableFileError where the reference itself cannot be read, and OutputError.
    """
    reference = capture.reference
    alignments = align_capture_bands(capture, rig_seed, settings, model, progress)
    progress(reference.name, "writing", 0.0)
    stack_path, sidecar_path = output_paths(capture, out)
    stack = _write(capture, alignments, stack_path, settings)
    if stack is not None:
        usable = [b for b in capture.moving if alignments[b.name].status != "failed"]
        crop = stack.crop.x0, stack.crop.y0, stack.crop.width, stack.crop.height
        # The picture is a convenience: a full disk must not cost the sidecar.
        with suppress(AgalignError):
            write_picture(capture, stack.path, crop, usable, stack_path.with_suffix(".png"))
    sidecar = describe_capture(capture, alignments, stack, settings)
    write_sidecar(sidecar_path, sidecar)
    return CaptureOutcome(sidecar, sidecar_path)


def _write(capture: Capture, alignments: dict[str, Alignment], path: Path, settings: Settings) -> Stack | None:
    """The stack, or None where no moving band is of use: then an earlier run's stack does not stay either."""
    reference = capture.reference
    mappings = {
        b.name: mapping_of(reference, b, alignments[b.name])
        for b in capture.moving
        if alignments[b.name].status != "failed"
    }
    if not mappings:
        for stale in (path, path.with_suffix(".png")):
            stale.unlink(missing_ok=True)
        return None
    own: Mapping | None = None
    if settings.write.undistort and reference.lens is not None:
        own = Mapping(geometry.identity(), None, reference.lens)
        mappings = {name: mapping.from_undistorted(reference.lens) for name, mapping in mappings.items()}
    layers = [
        Layer(b, own, is_reference=True) if b is reference else Layer(b, mappings.get(b.name)) for b in capture.bands
    ]
    usable = [(layer.mapping, layer.band) for layer in layers if layer.mapping is not None]
    crop = common_area(usable, *reference.size_px) if settings.write.crop == "common" else None
    return write_stack(capture, layers, crop or Tile(0, 0, *reference.size_px), path, settings.write)
