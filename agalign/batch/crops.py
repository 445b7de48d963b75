"""Crops of flights: the grids that the captures of a camera share, by the rigs of flights and earlier results."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from agalign.config import WriteSettings
from agalign.errors import InputError
from agalign.flight.groups import camera_key
from agalign.flight.rig import MIN_CAPTURES, Rig
from agalign.flight.rig_file import read_rig
from agalign.rasters.output_grid import FlightLimits, at_finest_scale, common_grid, flight_limits
from agalign.rasters.pan_sharpen import PanSharpened, scale_of_earlier
from agalign.rasters.product import CapturePaths
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid

Flight = tuple[list[Capture], Path | None]
"""Captures of a flight, and the file of its model."""


def grids_of_captures(
    flights: Sequence[Flight], kept: Mapping[str, OutputGrid], settings: WriteSettings, out: Path
) -> dict[str, tuple[OutputGrid | None, OutputGrid | None]]:
    """Return the grids that a capture shares with those of its camera, by label: that of the stacks, and that of the
    pan-sharpened files; None if it has its own. `kept` has the grids of earlier results by label.
    """
    limits, sharing = limits_of_cameras(flights), dict[tuple[str, bool], list[Capture]]()
    for capture in (c for captures, _ in flights for c in captures):
        # Captures without a lens model are not undistorted.
        sharing.setdefault((camera_key(capture), capture.reference.lens is None), []).append(capture)
    result: dict[str, tuple[OutputGrid | None, OutputGrid | None]] = {}
    for (camera, _), captures in sharing.items():
        common = _common_grid(captures, kept, settings, limits[camera])
        fine = common
        if common is not None and settings.resolution != "finest":
            fine = _fine_grid(captures, kept, common, limits[camera], out)
        result |= dict.fromkeys((c.label for c in captures), (common, fine))
    return result


def limits_of_cameras(flights: Sequence[Flight]) -> dict[str, FlightLimits]:
    """Return the limits of the flights of each camera, by `camera_key`."""
    by_camera: dict[str, list[tuple[Sequence[Capture], Rig | None]]] = {}
    for captures, path in flights:
        rig = None
        with suppress(InputError):  # of an earlier run
            rig = None if path is None else read_rig(path)[1]
        by_camera.setdefault(camera_key(captures[0]), []).append((captures, rig))
    return {camera: flight_limits(of_camera) for camera, of_camera in by_camera.items()}


def _common_grid(
    captures: Sequence[Capture], kept: Mapping[str, OutputGrid], settings: WriteSettings, limits: FlightLimits
) -> OutputGrid | None:
    """The common grid of a camera: that of most of its earlier results if they are enough for a rig, else that of the
    rigs of its flights.
    """
    grid = common_grid(captures[-1].reference, settings, limits)
    earlier = Counter(kept[c.label] for c in captures if c.label in kept)
    most, count = next(iter(earlier.most_common(1)), (None, 0))
    # Without rigs, each capture has its own grid.
    is_decided = settings.crop == "flight" and count >= MIN_CAPTURES and (grid is not None or len(earlier) == 1)
    return most if is_decided else grid


def _fine_grid(
    captures: Sequence[Capture], kept: Mapping[str, OutputGrid], common: OutputGrid, limits: FlightLimits, out: Path
) -> OutputGrid | None:
    """The grid of pan-sharpened files, of the scale that those of earlier results have: other rigs have others."""
    on_grid = (CapturePaths.of(c, out) for c in captures if kept.get(c.label) == common)
    paths = (paths.file(PanSharpened.suffix) for paths in on_grid)
    scales = (scale_of_earlier(path, common) for path in paths if path.is_file())
    scale = next((one for one in scales if one is not None), None)
    return at_finest_scale(common, captures[-1].reference, limits, scale)
