"""Output folders of runs, with stacks and sidecars of aligned captures, made without aligning any: of a field of rows,
and of overlapping captures of one ground, with the errors of GPS and attitude.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio

from agalign.pixels.raster import without_warnings
from agalign.products.run.flight_map import FlightMap, ground_m
from agalign.products.sidecar.file import read_result, write_sidecar
from agalign.products.sidecar.schema import LensPart, Sidecar
from agalign.values import geometry, lens
from agalign.values.capture import Band, Capture, Pose, Position
from agalign.values.lens import Lens

BANDS = {"Green": (560, 0.12, 0.1), "Red": (668, 0.2, 0.05), "NIR": (842, 0.3, 0.52), "Red edge": (717, 0.24, 0.3)}
"""Wavelength in nm, and reflectance of soil and of vegetation."""
_FULL = 40000
"""Raw number of a reflectance of 1."""


def make_aligned(folder: Path, captures: int, size_px: tuple[int, int] = (160, 120), *, raw: bool = False) -> None:
    """Write captures of a field of rows below `folder`/0000SET, as reflectance or as raw numbers."""
    rng = np.random.default_rng(0)
    crop = (np.sin(np.arange(size_px[0]) / 3) > 0) * np.ones((size_px[1], 1))
    target = folder / "0000SET"
    target.mkdir(parents=True)
    for number in range(1, captures + 1):
        name = f"IMG_{number:04d}"
        cover = (crop + rng.normal(0, 0.05, crop.shape)).clip(0, 1)
        write_stack(target / f"{name}.tif", reflectances(cover), raw=raw)
        write_sidecar(target / f"{name}.json", sidecar_of(name, number, size_px, raw=raw))


def reflectances(cover: np.ndarray) -> np.ndarray:
    """Return (4, height, width) of the bands for shares (height, width) of vegetation."""
    return np.stack([soil + (vegetation - soil) * cover for _, soil, vegetation in BANDS.values()])


def write_stack(path: Path, planes: np.ndarray, *, raw: bool = False) -> None:
    """Write reflectances (4, height, width) as a stack of agalign, or raw numbers in proportion to them."""
    count, height, width = planes.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": count, "compress": "zstd"}
    profile |= {"dtype": "uint16"} if raw else {"dtype": "float32", "nodata": np.nan}
    of_stack, of_band = ({}, {}) if raw else ({"RADIOMETRY": "reflectance"}, {"QUANTITY": "reflectance"})
    with without_warnings(), rasterio.open(path, "w", **profile) as dataset:
        dataset.write((planes * _FULL if raw else planes).astype(profile["dtype"]))
        dataset.descriptions = tuple(BANDS)
        dataset.update_tags(TIFFTAG_DATETIME="2026:06:21 10:00:00", **of_stack)
        for index, (wavelength_nm, *_) in enumerate(BANDS.values(), start=1):
            dataset.update_tags(index, wavelength=wavelength_nm, wavelength_units="nm", **of_band)


def sidecar_of(name: str, number: int, size_px: tuple[int, int], *, raw: bool) -> Sidecar:
    """The sidecar of aligned.json with another name, time, place and size."""
    width, height = size_px
    content = json.loads(Path(__file__).with_name("aligned.json").read_text(encoding="utf-8").replace("IMG_0001", name))
    content["captured_at"] = f"2026-06-21T10:{number // 60 % 60:02d}:{number % 60:02d}"
    content["position"]["longitude"] += 1e-4 * number
    content["reference"] |= {"width": width, "height": height}
    content["output"]["crop"] = 0, 0, width, height
    if raw:
        content["output"] |= {"radiometry": None, "nodata": None}
    content["products"][0]["sha256"] = f"{number:064x}"
    return Sidecar.model_validate(content)


# ---- overlapping captures

LONGITUDE, LATITUDE = 3.0, 52.0
"""On the central meridian of a UTM zone: grid north is north there."""
_M_PER_DEGREE = 111_320 * np.cos(np.radians(LATITUDE)), 111_270
COLUMNS, ROWS = 3, 3
SIZE_PX = WIDTH_PX, HEIGHT_PX = 320, 240
"""Of a stack."""
OVERLAP, GSD_M = 0.65, 0.1
GPS_ERROR_M, ANGLE_ERROR_DEG = 1.5, 2.0
FOCAL_PX = 1.13 * WIDTH_PX
"""As in a RedEdge: 1450 px for 1280 px."""
LENS = Lens(FOCAL_PX, FOCAL_PX, (WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2, (-0.08,))
"""In pixels of the stacks; the corners move by several pixels."""
_CROP_PX = 60, 40
"""Margin of the reference around the stacks."""


def make_overlapping(folder: Path) -> dict[str, np.ndarray]:
    """Write stacks, sidecars and flight.geojson; return (3, 3) for each capture: undistorted pixels to metres east and
    north of (LONGITUDE, LATITUDE).
    """
    rng = np.random.default_rng(0)
    step_m = (1 - OVERLAP) * GSD_M * np.array(SIZE_PX)
    extent_px = (step_m * (COLUMNS - 1, ROWS - 1) / GSD_M + 1.6 * WIDTH_PX).astype(int)
    ground = _ground(*extent_px.tolist(), rng)
    corner_m = np.array([-0.5, 0.5]) * extent_px * GSD_M
    first_m = corner_m + np.array([0.8, -0.8]) * WIDTH_PX * GSD_M
    from_metres = np.linalg.inv(np.array([[GSD_M, 0, corner_m[0]], [0, -GSD_M, corner_m[1]], [0, 0, 1]]))
    flight_map, truth = FlightMap(folder), {}
    whole_px = WIDTH_PX + 2 * _CROP_PX[0], HEIGHT_PX + 2 * _CROP_PX[1]
    (folder / "0000SET").mkdir(parents=True)
    for number in range(COLUMNS * ROWS):
        row, column = divmod(number, COLUMNS)
        camera_m = first_m + step_m * (column, -row)
        heading, pitch, roll = (180.0 * (row % 2), *rng.normal(0, 1.5, 2))
        pose = Pose(heading, pitch, roll, height_m=GSD_M * FOCAL_PX, focal_length_px=FOCAL_PX)
        name = f"IMG_{number + 1:04d}"
        capture = _capture(name, camera_m, pose, SIZE_PX)
        points = geometry.lattice(*SIZE_PX, 5, 5)
        to_ground = geometry.fit_homography(points, ground_m(capture, points) + camera_m)
        write_stack(folder / "0000SET" / f"{name}.tif", _seen(ground, from_metres @ to_ground))
        write_sidecar(folder / "0000SET" / f"{name}.json", _sidecar(name, number))
        angles_deg = np.array((heading, pitch, roll)) + rng.normal(0, ANGLE_ERROR_DEG, 3)
        noisy = Pose(*angles_deg, height_m=pose.height_m, focal_length_px=FOCAL_PX)
        known = _capture(name, camera_m + rng.normal(0, GPS_ERROR_M, 2), noisy, whole_px)
        flight_map.add(known, "ok", read_result(folder / "0000SET" / f"{name}.json"))
        truth[capture.label] = to_ground
    flight_map.write()
    return truth


def _capture(name: str, camera_m: np.ndarray, pose: Pose, size_px: tuple[int, int]) -> Capture:
    longitude, latitude = ((LONGITUDE, LATITUDE) + camera_m / _M_PER_DEGREE).tolist()
    band = Band("Green", Path(f"{name}_2.tif"), 1, *size_px, "uint16")
    position = Position(latitude, longitude, 100.0)
    return Capture(name, Path("0000SET"), (band,), 0, position=position, pose=pose)


def _sidecar(name: str, number: int) -> Sidecar:
    """The sidecar of stacks that are a crop of the reference."""
    x0, y0 = _CROP_PX
    whole = sidecar_of(name, number, (WIDTH_PX + 2 * x0, HEIGHT_PX + 2 * y0), raw=False)
    part = LensPart.model_validate(asdict(replace(LENS, cx_px=LENS.cx_px + x0, cy_px=LENS.cy_px + y0)))
    bands = [b.model_copy(update={"lenses": None if b.status == "reference" else (part, part)}) for b in whole.bands]
    output = whole.output.model_copy(update={"crop": (x0, y0, *SIZE_PX)})
    return whole.model_copy(update={"bands": bands, "output": output})


def _ground(width: int, height: int, rng: np.random.Generator) -> np.ndarray:
    """(4, height, width) reflectance of the bands, from soil to vegetation."""
    cover = np.zeros((height, width), np.float32)
    for grain_px in (1.0, 3.0, 9.0, 40.0):
        shape = [max(2, round(n / grain_px)) for n in (height, width)]
        cover += cv2.resize(rng.random(shape, np.float32), (width, height), interpolation=cv2.INTER_CUBIC) / 4
    return reflectances(cover)


def _seen(ground: np.ndarray, to_ground_px: np.ndarray) -> np.ndarray:
    """(4, height, width) of a stack; `to_ground_px` maps its undistorted pixels to those of the ground."""
    raw_px = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in SIZE_PX)), axis=-1)
    positions = geometry.apply(to_ground_px, lens.undistort(LENS, raw_px)).astype(np.float32)
    return np.stack([cv2.remap(plane, positions, None, cv2.INTER_LINEAR) for plane in ground])
