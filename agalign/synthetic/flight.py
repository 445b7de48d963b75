"""A synthetic flight over a farm, in the file format of a MicaSense-like camera, with ground truth.

The scene is a plane of parcels with crop rows of different directions and spacings, bare soil, tracks and trees. Each
band has its own lens (distortion, principal point), position and orientation in the rig, and spectrum: vegetation is
darker than soil in the visible bands and much brighter in the near infrared.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

from agalign.errors import ConfigurationError
from agalign.pixels.raster import suffix_format
from agalign.records.sidecar_file import find_sidecars, label_of, read_sidecar
from agalign.synthetic import cameras
from agalign.synthetic.cameras import REDEDGE, BandSpec, CameraSpec, Exposure, Pose, place_and_rays, true_homography
from agalign.synthetic.ground import Field, Ground, map_px, on_ground, paint_ground, reflectance
from agalign.values import geometry, lens
from agalign.values.geometry import Points
from agalign.values.mapping import splined

ALTITUDE_M = 22.0, 34.0
_TRUTH = "truth.json"
_CAPTURES_PER_GROUND = 4
"""Captures over one painted ground; longer flights have several grounds, one in memory at a time."""


Degrade = Callable[[Field, np.random.Generator], Field]
"""Changes the light (height, width), 0 to 1, that reaches a sensor."""


@dataclass(frozen=True)
class Shot:
    """One planned capture."""

    pose: Pose
    ground: Ground
    degrade: Degrade | None = None
    degraded_bands: tuple[str, ...] | None = None
    """Names of the bands that `degrade` changes; None for all."""
    without: tuple[str, ...] = ()
    """Bands without a file."""
    trouble: str = ""
    """Name of the fault of the capture in truth.json."""
    sun: float = 1.0
    """Sunlight as a multiple of what the light sensor measures."""
    shutter: float = 1.0
    """Exposure time as a multiple of the normal one."""


def make_flight(
    folder: Path,
    captures: int = 3,
    size_px: tuple[int, int] = (1280, 960),
    rng_seed: int = 0,
    camera: CameraSpec = REDEDGE,
    altitude_m: tuple[float, float] = ALTITUDE_M,
) -> Path:
    """Write captures of all bands to folder/0000SET/000, and return the path of their ground truth.

    The ground truth, folder/truth.json, is {capture: {"reference": file, "bands": {file: {"fixed_to_moving": [[...]],
    "ties": [[x_ref, y_ref, x_mov, y_mov], ...]}}}}: the homography between undistorted pixels, and tie points in raw
    pixels, exact to 0.001 px; the centre of the top-left pixel is (0, 0). `altitude_m` is the lowest and the highest
    altitude above the plane.
    """
    rng, truth = np.random.default_rng(rng_seed), dict[str, Any]()
    for first in range(0, captures, _CAPTURES_PER_GROUND):
        count = min(_CAPTURES_PER_GROUND, captures - first)
        poses, ground = plan_flight(rng, count, size_px, camera, altitude_m)
        truth |= _write(folder, [Shot(pose, ground) for pose in poses], size_px, camera, rng, first)
    return _write_truth(folder, truth)


def refuse_other_images(folder: Path) -> None:
    """Raise ConfigurationError for an image below a folder, or a truth.json without images, that `make_flight` has not
    written.
    """
    images = [path for path in sorted(folder.rglob("*")) if suffix_format(path) and path.is_file()]
    other = next((path for path in images if not _is_synthetic(path)), None)
    if other is None and not images and (folder / _TRUTH).exists():
        other = folder / _TRUTH
    if other is not None:
        raise ConfigurationError(f"{other}: was not written by agalign demo; choose another folder")


def _is_synthetic(path: Path) -> bool:
    with suppress(OSError, tifffile.TiffFileError), tifffile.TiffFile(path) as tiff:
        return bool(tiff.pages.first.tags.valueof("Software") == cameras.SOFTWARE)
    return False


def write_shots(
    folder: Path, shots: Sequence[Shot], size_px: tuple[int, int], camera: CameraSpec, rng: np.random.Generator
) -> Path:
    """Write captures like `make_flight`, and return the path of the ground truth, which also has their faults."""
    return _write_truth(folder, _write(folder, shots, size_px, camera, rng))


def _write(
    folder: Path,
    shots: Sequence[Shot],
    size_px: tuple[int, int],
    camera: CameraSpec,
    rng: np.random.Generator,
    before: int = 0,
) -> dict[str, Any]:
    """Write captures after `before` others over other grounds, and return their ground truth."""
    images = folder / "0000SET" / "000"
    images.mkdir(parents=True, exist_ok=True)
    for band in camera.bands:
        ground: Ground | None = None
        for number, shot in enumerate(shots, start=before + 1):
            if shot.ground is not ground:
                ground, painted = shot.ground, reflectance(shot.ground, band)
            degrade = shot.degrade if shot.degraded_bands is None or band.name in shot.degraded_bands else None
            light = painted if band.sees == "heat" else painted * np.float32(shot.sun * shot.shutter)
            pixels = recorded(view(light, shot.ground, band, shot.pose, size_px), band, rng, degrade)
            if band.name not in shot.without:
                path = images / camera.file_name(band, number)
                path.parent.mkdir(parents=True, exist_ok=True)
                pose = replace(shot.pose, north_m=shot.pose.north_m + before)
                camera.write_band(path, pixels, band, Exposure(pose, number, size_px, shot.shutter))
    return {
        camera.capture_name(number): _truth(shot, number, camera, size_px)
        for number, shot in enumerate(shots, start=before + 1)
    }


def _write_truth(folder: Path, truth: dict[str, Any]) -> Path:
    path = folder / _TRUTH
    path.write_text(json.dumps(truth), encoding="utf-8")
    return path


def _truth(shot: Shot, number: int, camera: CameraSpec, size_px: tuple[int, int]) -> dict[str, Any]:
    reference = camera.bands[camera.reference]
    return {
        "reference": Path(camera.file_name(reference, number)).name,
        "trouble": shot.trouble,
        "bands": {
            Path(camera.file_name(b, number)).name: {
                "fixed_to_moving": true_homography(reference, b, shot.pose, size_px).tolist(),
                "ties": true_ties(shot.ground, reference, b, shot.pose, size_px),
            }
            for b in camera.bands
            if b is not reference and b.name not in shot.without
        },
    }


def plan_flight(
    rng: np.random.Generator,
    captures: int,
    size_px: tuple[int, int],
    camera: CameraSpec = REDEDGE,
    altitude_m: tuple[float, float] = ALTITUDE_M,
) -> tuple[list[Pose], Ground]:
    """Return the poses of captures, as in `make_flight`, and their ground."""
    poses = []
    for number in range(captures):
        altitude, yaw_deg = float(rng.uniform(*altitude_m)), float(rng.uniform(-180, 180))
        roll_deg, pitch_deg = rng.normal(0, 2, 2).tolist()
        poses.append(Pose(altitude, yaw_deg, roll_deg, pitch_deg, 4.0 * (number % 10), 4.0 * (number // 10)))
    return poses, paint_ground(rng, poses, size_px, camera)


def true_ties(
    ground: Ground, reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]
) -> list[list[float]]:
    """Return tie points [x_ref, y_ref, x_mov, y_mov], raw px, on a lattice, if both points are inside their images."""
    columns_rows = (25, 19) if ground.height_m is None else (65, 49)
    fixed_px = geometry.lattice(*reference.size_px(size_px), *columns_rows)
    position, rays = place_and_rays(band, pose, size_px)
    points_m = on_ground(ground, reference, pose, size_px, fixed_px)
    # Project the points on the ground into the band.
    directions = (points_m[:, :2] - position[:2]) / (points_m[:, 2:] - position[2])
    moving_px = lens.distort(band.lens(*size_px), geometry.apply(geometry.invert(rays), directions))
    inside = ((moving_px >= 0) & (moving_px <= np.subtract(band.size_px(size_px), 1))).all(axis=1)
    rows: list[list[float]] = np.hstack([fixed_px, moving_px])[inside].round(4).tolist()
    return rows


def view(painted: Field, ground: Ground, band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Field:
    """Return the image (height, width) of a painted ground in a band, with distortion, without vignetting or noise.

    If its pixels are much larger than those of the ground, each is the mean of several samples.
    """
    width, height = band.size_px(size_px)
    samples = max(1, round(band.view / band.size_ratio[0]))

    def on_map(raw_px: Points) -> Points:
        return map_px(ground, on_ground(ground, band, pose, size_px, raw_px)[..., :2])

    x, y = ((np.arange(n * samples, dtype=np.float64) + 0.5) / samples - 0.5 for n in (width, height))
    if ground.height_m is None:
        positions = splined(on_map, x, y, dtype=np.float32)
    else:
        positions = on_map(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    image = cv2.remap(painted, positions, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    if samples > 1:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.float32)


def recorded(
    scene: Field, band: BandSpec, rng: np.random.Generator, degrade: Degrade | None = None
) -> NDArray[np.uint16]:
    """Return the sensor values (height, width) for a view of reflectances, with vignetting and noise; for heat,
    hundredths of a kelvin.
    """
    if band.sees == "heat":
        warmest_c, noise_c = 50.0, 0.05
        celsius = warmest_c * (scene if degrade is None else degrade(scene, rng))
        celsius = celsius + rng.normal(0, noise_c, scene.shape)
        return np.asarray(np.rint(100 * (celsius + 273.15)).astype(np.uint16))
    height, width = scene.shape
    y, x = np.arange(height), np.arange(width)
    radius2 = ((x - width / 2) ** 2)[None, :] + ((y - height / 2) ** 2)[:, None]
    vignetting = 1 - cameras.VIGNETTING * radius2 / ((width / 2) ** 2 + (height / 2) ** 2)
    light = np.asarray(scene * band.exposure, np.float32)
    signal = np.clip((light if degrade is None else degrade(light, rng)) * vignetting, 0, 1)
    electrons = signal * 4000
    noisy = electrons + rng.normal(size=signal.shape) * np.sqrt(electrons + 60)
    levels = cameras.BLACK_LEVEL + noisy / 4000 * (cameras.WHITE_LEVEL - cameras.BLACK_LEVEL)
    return np.asarray((np.clip(np.rint(levels / 16), 0, 4095) * 16).astype(np.uint16))


@dataclass(frozen=True)
class Score:
    """Error of a band pair at the tie points of the ground truth."""

    capture: str
    band: str
    status: str
    before_px: float
    median_px: float
    p95_px: float


def score_against_truth(out: Path, truth_path: Path) -> list[Score]:
    """Return the errors of every pair, px, from the grids in the sidecars below the output folder of a run."""
    truth = json.loads(truth_path.read_text(encoding="utf-8"))
    scores = []
    for path in find_sidecars(out):
        sidecar, label = read_sidecar(path), label_of(path, out)
        if sidecar.capture not in truth:  # of an earlier demo with more captures in the same folder
            continue
        for band in sidecar.bands:
            known = truth[sidecar.capture]["bands"].get(Path(band.file).name)
            if known is None or band.grid is None:
                continue
            fixed_px, moving_px = np.hsplit(np.asarray(known["ties"], dtype=np.float64), 2)
            mapping = CloughTocher2DInterpolator(np.asarray(band.grid.reference_px), np.asarray(band.grid.moving_px))
            before_px = float(np.median(np.linalg.norm(fixed_px - moving_px, axis=1)))
            errors_px = np.linalg.norm(mapping(fixed_px) - moving_px, axis=1)
            numbers = np.nanpercentile(errors_px, (50, 95)).tolist()
            scores.append(Score(label, band.band, band.status, before_px, *numbers))
    return scores
