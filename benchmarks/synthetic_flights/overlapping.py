"""The output folder of a run over a field: overlapping captures of one ground, with the errors of GPS and attitude."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from agalign.products.flight_map import FlightMap
from agalign.products.footprint import ground_m
from agalign.products.sidecar import LensPart, Sidecar
from agalign.products.sidecar_file import read_result, write_sidecar
from agalign.values import geometry, lens
from agalign.values.capture import Band, Capture, Pose, Position
from agalign.values.lens import Lens

from .aligned import BANDS, sidecar_of

LONGITUDE, LATITUDE = 3.0, 52.0
"""On the central meridian of a UTM zone: grid north is north there."""
_M_PER_DEGREE = 111_320 * np.cos(np.radians(LATITUDE)), 111_270
_FOCAL_PER_WIDTH = 1.13
"""Of a RedEdge: 1450 px for 1280 px."""
_CROP_PX = 60, 40
"""Margin of the reference around the stacks."""


@dataclass(frozen=True)
class Survey:
    """A grid of captures."""

    columns: int = 3
    rows: int = 3
    size_px: tuple[int, int] = (320, 240)
    overlap: float = 0.65
    gsd_m: float = 0.1
    gps_error_m: float = 1.5
    angle_error_deg: float = 2.0
    distortion: float = -0.08
    """k1 of the lens: the corners move by several pixels."""
    rng_seed: int = 0

    @property
    def focal_px(self) -> float:
        return _FOCAL_PER_WIDTH * self.size_px[0]

    @property
    def lens(self) -> Lens:
        """In pixels of the stacks."""
        width, height = self.size_px
        return Lens(self.focal_px, self.focal_px, (width - 1) / 2, (height - 1) / 2, (self.distortion,))


def make_overlapping(folder: Path, survey: Survey) -> dict[str, np.ndarray]:
    """Write stacks, sidecars and flight.geojson; return (3, 3) for each capture: undistorted pixels to metres east and
    north of (LONGITUDE, LATITUDE).
    """
    rng, (width, height) = np.random.default_rng(survey.rng_seed), survey.size_px
    step_m = (1 - survey.overlap) * survey.gsd_m * np.array([width, height])
    extent_px = (step_m * (survey.columns - 1, survey.rows - 1) / survey.gsd_m + 1.6 * np.array([width, width])).astype(
        int
    )
    ground = _ground(*extent_px.tolist(), rng)
    first_m = np.array([-0.5, 0.5]) * extent_px * survey.gsd_m + np.array([0.8, -0.8]) * width * survey.gsd_m
    corner_m = np.array([-0.5, 0.5]) * extent_px * survey.gsd_m
    from_metres = np.linalg.inv(np.array([[survey.gsd_m, 0, corner_m[0]], [0, -survey.gsd_m, corner_m[1]], [0, 0, 1]]))
    flight_map, truth = FlightMap(folder), {}
    whole_px = width + 2 * _CROP_PX[0], height + 2 * _CROP_PX[1]
    (folder / "0000SET").mkdir(parents=True)
    for number in range(survey.columns * survey.rows):
        row, column = divmod(number, survey.columns)
        camera_m = first_m + step_m * (column, -row)
        heading, pitch, roll = (180.0 * (row % 2), *rng.normal(0, 1.5, 2))
        pose = Pose(heading, pitch, roll, height_m=survey.gsd_m * survey.focal_px, focal_length_px=survey.focal_px)
        name = f"IMG_{number + 1:04d}"
        capture = _capture(name, camera_m, pose, survey.size_px)
        points = geometry.lattice(width, height, 5, 5)
        to_ground = geometry.fit_homography(points, ground_m(capture, points) + camera_m)
        _write_stack(folder / "0000SET" / f"{name}.tif", ground, from_metres @ to_ground, survey)
        write_sidecar(folder / "0000SET" / f"{name}.json", _sidecar(name, number, survey))
        noise = rng.normal(0, survey.angle_error_deg, 3)
        noisy = replace(pose, heading_deg=heading + noise[0], pitch_deg=pitch + noise[1], roll_deg=roll + noise[2])
        known = _capture(name, camera_m + rng.normal(0, survey.gps_error_m, 2), noisy, whole_px)
        flight_map.add(known, "ok", read_result(folder / "0000SET" / f"{name}.json"))
        truth[capture.label] = to_ground
    flight_map.write()
    return truth


def _capture(name: str, camera_m: np.ndarray, pose: Pose, size_px: tuple[int, int]) -> Capture:
    longitude, latitude = np.array([LONGITUDE, LATITUDE]) + camera_m / _M_PER_DEGREE
    band = Band("Green", Path(f"{name}_2.tif"), 1, *size_px, "uint16")
    position = Position(float(latitude), float(longitude), 100.0)
    return Capture(name, Path("0000SET"), (band,), 0, position=position, pose=pose)


def _sidecar(name: str, number: int, survey: Survey) -> Sidecar:
    """The sidecar of stacks that are a crop of the reference."""
    (width, height), own = survey.size_px, survey.lens
    x0, y0 = _CROP_PX
    whole = sidecar_of(name, number, (width + 2 * x0, height + 2 * y0), raw=False)
    part = LensPart(
        fx_px=own.fx_px, fy_px=own.fy_px, cx_px=own.cx_px + x0, cy_px=own.cy_px + y0, distortion=list(own.distortion)
    )
    bands = [b.model_copy(update={"lenses": None if b.status == "reference" else (part, part)}) for b in whole.bands]
    output = whole.output.model_copy(update={"crop": (x0, y0, width, height)})
    return whole.model_copy(update={"bands": bands, "output": output})


def _ground(width: int, height: int, rng: np.random.Generator) -> np.ndarray:
    """(4, height, width) reflectance of the bands, from soil to vegetation."""
    cover = np.zeros((height, width), np.float32)
    for grain_px in (1.0, 3.0, 9.0, 40.0):
        shape = max(2, round(height / grain_px)), max(2, round(width / grain_px))
        cover += cv2.resize(rng.random(shape, np.float32), (width, height), interpolation=cv2.INTER_CUBIC) / 4
    levels = ((0.12, 0.1), (0.2, 0.05), (0.3, 0.52), (0.24, 0.3))
    return np.stack([low + (high - low) * cover for low, high in levels])


def _write_stack(path: Path, ground: np.ndarray, to_ground_px: np.ndarray, survey: Survey) -> None:
    (width, height) = survey.size_px
    raw_px = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
    positions = geometry.apply(to_ground_px, lens.undistort(survey.lens, raw_px)).astype(np.float32)
    profile = {"driver": "GTiff", "width": width, "height": height, "count": len(BANDS), "compress": "zstd"}
    profile |= {"dtype": "float32", "nodata": np.nan, "tiled": True, "interleave": "band"}
    with warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning):
        dataset = rasterio.open(path, "w", **profile)
    with dataset:
        for index, (plane, wavelength_nm) in enumerate(zip(ground, BANDS.values(), strict=True), start=1):
            dataset.write(cv2.remap(plane, positions, None, cv2.INTER_LINEAR), index)
            dataset.update_tags(index, wavelength=f"{wavelength_nm:g}", wavelength_units="nm", QUANTITY="reflectance")
        dataset.descriptions = tuple(BANDS)
        dataset.update_tags(RADIOMETRY="reflectance", TIFFTAG_DATETIME="2026:06:21 10:00:00")
