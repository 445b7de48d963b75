"""The captures of a run on the ground plane: their footprints in OUT/flight.geojson, with the lens of the reference."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agalign.errors import AgalignError, InputError
from agalign.pixels.raster import transformed
from agalign.products.run.captures import AlignedBand, LeftOut, RunCapture, captures_of_run, like_most
from agalign.products.run.flight_map import FLIGHT_MAP_FILE, features_in, pose_errors, utm_wkt
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import Sidecar
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.image import OutputGrid
from agalign.values.lens import Lens
from agalign.values.pixel_units import Size

_WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class Placement:
    """A capture on a horizontal plane. Pixels are those of its aligned rasters; (0, 0) is the centre of a pixel."""

    label: str
    bands: Sequence[AlignedBand]
    reference: AlignedBand
    size_px: Size
    lens: Lens | None
    """Lens of the aligned rasters; None for rasters without lens distortion."""
    to_ground: Matrix
    """Undistorted px to metres east and north of the origin of the flight."""
    camera_m: Points
    """(2,) position of the camera, metres east and north of the origin."""
    height_m: float | None
    """Height above the ground; None for input files with a georeference."""
    height_is_assumed: bool
    accuracy_m: float
    """Standard error of the farthest corner."""
    pose_std: tuple[float, ...]
    """Standard errors of the pose: east and north (m), scale, heading, and tilt about two axes (radians)."""

    @property
    def outline_m(self) -> Points:
        """(n, 2) points on the ground along the edge of the image."""
        points = geometry.lattice(*self.size_px, 9, 9)
        return self.on_ground(points[((points == 0) | (points == np.subtract(self.size_px, 1))).any(axis=1)])

    @property
    def gsd_m(self) -> float:
        """Ground sample distance at the centre of the image."""
        return float(abs(geometry.local_scale(self.to_ground, *self.size_px)[-1]))

    def on_ground(self, points_px: Points) -> Points:
        """Return pixels (n, 2) on the ground, metres east and north of the origin."""
        return geometry.apply(self.to_ground, lens.undistort(self.lens, points_px))


@dataclass(frozen=True)
class PlacedFlight:
    """The captures of a run on one ground plane."""

    captures: list[Placement]
    origin_m: Points
    """(2,) map coordinates of the origin."""
    crs_wkt: str
    left_out: LeftOut


def place_captures(out: Path) -> PlacedFlight:
    """Place the captures of a run with all bands aligned, and the same contents as most of them, by their footprints in
    flight.geojson.

    Raises InputError if `out` has no sidecars, or if no capture can be placed.
    """
    captures, left_out = captures_of_run(out)
    features = {str(f["properties"].get("sidecar")): f for f in features_in(out)}
    rings = {c.label: ring for c in captures if (ring := _ring(features.get(f"{c.label}.json", {}))) is not None}
    if not rings:
        raise InputError(
            f"{out}: no capture can be placed, because {FLIGHT_MAP_FILE} has no footprints; they need position, "
            "altitude, yaw and focal length in the tags: align the files as the camera wrote them"
        )
    corner = next(iter(rings.values()))[:1]
    crs = utm_wkt(*corner[0].tolist())
    origin_m = transformed(corner, _WGS84, crs)[0]
    problems = {c.label: problem for c in captures if (problem := _problem(c, rings))}
    alike, differing = like_most([c for c in captures if c.label not in problems])
    left_out += [*problems.items(), *differing]
    placed = []
    for capture in alike:
        properties = features[f"{capture.label}.json"]["properties"] | {"ring": rings[capture.label]}
        try:
            placed.append(_placed(capture, properties, origin_m, crs))
        except AgalignError as error:
            left_out.append((capture.label, str(error)))
        except (LookupError, TypeError, ValueError, ArithmeticError):
            problem = f"its entry in {FLIGHT_MAP_FILE} is damaged; run again with --overwrite"
            left_out.append((capture.label, problem))
    if not placed:
        raise InputError(f"{out}: no capture can be used; {': '.join(left_out[0])}")
    return PlacedFlight(placed, origin_m, crs, left_out)


def _problem(capture: RunCapture, rings: Mapping[str, Points]) -> str:
    """The reason why a capture cannot be placed; empty if it can."""
    if capture.label not in rings:
        return f"it has no footprint in {FLIGHT_MAP_FILE}"
    if capture.result.output is None:
        return "it has no aligned bands"
    return "; ".join(band.problem for band in capture.bands if band.problem)


def _ring(feature: dict[str, Any]) -> Points | None:
    """The footprint of a feature: (5, 2) of longitude and latitude, closed, counter-clockwise; None without one."""
    with suppress(LookupError, TypeError, ValueError):
        ring = np.array(feature["geometry"]["coordinates"][0], np.float64)
        return ring if ring.shape == (5, 2) and (abs(ring) <= (180.0, 90.0)).all() else None
    return None


def _placed(capture: RunCapture, feature: dict[str, Any], origin_m: Points, crs: str) -> Placement:
    """The placement by a feature's properties. Raises AgalignError, and KeyError or others for a damaged map."""
    sidecar, bands = read_sidecar(capture.path), capture.bands
    assert sidecar.output is not None  # see `_problem`
    grid = sidecar.output.grid
    # From counter-clockwise to the order of `geometry.corners`.
    corners_m = transformed(feature["ring"][[0, 3, 2, 1]], _WGS84, crs) - origin_m
    edge_px = geometry.corners(grid.width + 1, grid.height + 1) - 0.5
    height_m, accuracy_m = (_positive(feature[name]) for name in ("height_m", "accuracy_m"))
    camera_m = corners_m.mean(axis=0)
    if height_m is not None:
        camera_m = transformed(np.array([[feature["longitude"], feature["latitude"]]]), _WGS84, crs)[0] - origin_m
    position_m, height, heading, tilt = pose_errors(height_m, feature["height_from"])
    result = Placement(
        capture.label,
        bands,
        bands[[b.name for b in bands].index(sidecar.reference.band)],
        size_px=(grid.width, grid.height),
        lens=_lens_of_output(sidecar, grid),
        to_ground=geometry.fit_homography(edge_px, corners_m),
        camera_m=camera_m,
        height_m=height_m,
        height_is_assumed=feature["height_from"] == "assumed",
        accuracy_m=position_m if accuracy_m is None else accuracy_m,
        pose_std=(position_m, position_m, height, heading, tilt, tilt),
    )
    if not np.isfinite([*result.outline_m.ravel(), *camera_m]).all() or not result.gsd_m > 0:
        raise InputError("its place on the ground is not finite; run again with --overwrite")
    return result


def _positive(value: Any) -> float | None:
    """A length, m, or None. Raises ValueError for others than a drone's."""
    max_length_m = 1e5  # of a height above the ground and of its error: no aircraft with a camera is higher
    if value is not None and not 0 < float(value) < max_length_m:
        raise ValueError(value)
    return None if value is None else float(value)


def _lens_of_output(sidecar: Sidecar, grid: OutputGrid) -> Lens | None:
    """The lens of the reference in the pixels of the output; None if the output is undistorted."""
    part = next((b.lenses[0] for b in sidecar.bands if b.lenses is not None), None)
    scaled = None if part is None or grid.undistorted else lens.rescaled(Lens(**dict(part)), grid.scale)
    return scaled and replace(scaled, cx_px=scaled.cx_px - grid.x0, cy_px=scaled.cy_px - grid.y0)
