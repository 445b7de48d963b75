"""The captures of a run on the ground plane: their footprints in OUT/flight.geojson, with the lens of the reference."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agalign.errors import AgalignError, InputError
from agalign.pixels.raster import transformed
from agalign.products.flight_map import FLIGHT_MAP_FILE, features_in
from agalign.products.footprint import pose_errors, utm_wkt
from agalign.products.index_bands import IndexBand, bands_of
from agalign.products.sidecar import Sidecar
from agalign.products.sidecar_file import read_sidecar, run_sidecars
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.image import OutputGrid
from agalign.values.lens import Lens
from agalign.values.pixel_units import PixelScale, Size

_WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class Placement:
    """A capture on a horizontal plane. Pixels are those of its aligned rasters; (0, 0) is the centre of a pixel."""

    label: str
    bands: Sequence[IndexBand]
    reference: IndexBand
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
    left_out: list[tuple[str, str]]
    """(label of a capture, reason)."""

    def add(self, out: Path, feature: dict[str, Any]) -> None:
        """Place the capture of a feature of the flight map, or leave it out."""
        try:
            one = _placed(out, feature, self.origin_m, self.crs_wkt)
            if [b.name for b in one.bands] != [b.name for b in (self.captures or [one])[0].bands]:
                raise InputError(f"it has other bands than {self.captures[0].label}")
            self.captures.append(one)
        except (AgalignError, KeyError, TypeError, ValueError) as error:
            self.left_out.append((feature["capture"], str(error)))


def place_captures(out: Path) -> PlacedFlight:
    """Place the captures with status `ok` of the output folder of a run by their footprints in flight.geojson.

    Raises InputError if `out` has no sidecars, or if no capture can be placed.
    """
    run_sidecars(out)
    features = [f["properties"] | {"geometry": f.get("geometry")} for f in features_in(out)]
    shown = [f for f in features if f.get("sidecar") and (f["geometry"] or {}).get("type") == "Polygon"]
    if not shown:
        raise InputError(
            f"{out}: no capture can be placed, because {FLIGHT_MAP_FILE} has no footprints; they need position, "
            "altitude, yaw and focal length in the tags: align the files as the camera wrote them"
        )
    corner = np.array(shown[0]["geometry"]["coordinates"][0][:1], np.float64)
    crs = utm_wkt(*corner[0].tolist())
    origin_m = transformed(corner, _WGS84, crs)[0]
    left_out = [(f["capture"], "it has no footprint") for f in features if f.get("sidecar") and f not in shown]
    flight = PlacedFlight([], origin_m, crs, left_out)
    for feature in shown:
        flight.add(out, feature)
    if not flight.captures:
        raise InputError(f"{out}: no capture can be used; {left_out[0][0]}: {left_out[0][1]}")
    return flight


def _placed(out: Path, feature: dict[str, Any], origin_m: Points, crs: str) -> Placement:
    """The placement by a feature's properties. Raises AgalignError, and KeyError or others for a damaged map."""
    path = out / feature["sidecar"]
    sidecar = read_sidecar(path)
    bands = bands_of(sidecar, path.parent)
    problems = [b.problem for b in bands if b.problem]
    if sidecar.output is None or problems:
        raise InputError("; ".join(problems) or "it has no aligned bands")
    grid = OutputGrid(*sidecar.output.crop, PixelScale(*sidecar.output.scale), sidecar.output.undistorted)
    # From counter-clockwise to the order of `geometry.corners`.
    ring = np.array(feature["geometry"]["coordinates"][0], np.float64)[[0, 3, 2, 1]]
    corners_m = transformed(ring, _WGS84, crs) - origin_m
    edge_px = geometry.corners(grid.width + 1, grid.height + 1) - 0.5
    height_m, accuracy_m = feature["height_m"], feature["accuracy_m"]
    camera_m = corners_m.mean(axis=0)
    if height_m is not None:
        camera_m = transformed(np.array([[feature["longitude"], feature["latitude"]]]), _WGS84, crs)[0] - origin_m
    position_m, height, heading, tilt = pose_errors(height_m, feature["height_from"])
    reference = next(b for b in bands if b.name == sidecar.reference.band)
    return Placement(
        feature["capture"],
        bands,
        reference,
        (grid.width, grid.height),
        _lens_of_output(sidecar, grid),
        geometry.fit_homography(edge_px, corners_m),
        camera_m,
        height_m,
        feature["height_from"] == "assumed",
        position_m if accuracy_m is None else float(accuracy_m),
        (position_m, position_m, height, heading, tilt, tilt),
    )


def _lens_of_output(sidecar: Sidecar, grid: OutputGrid) -> Lens | None:
    """The lens of the reference in the pixels of the output; None if the output is undistorted."""
    part = next((b.lenses[0] for b in sidecar.bands if b.lenses is not None), None)
    scaled = None if part is None or grid.undistorted else lens.rescaled(Lens(**dict(part)), grid.scale)
    return scaled and replace(scaled, cx_px=scaled.cx_px - grid.x0, cy_px=scaled.cy_px - grid.y0)
