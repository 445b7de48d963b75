"""A synthetic flight over a farm, written as a MicaSense-like camera would, with the truth beside it.

The scene is a plane of parcels with crop rows of different directions and spacings, bare soil, tracks and trees, or
terraces with trees that stand up from them. Each band sees it through its own lens (distortion, principal point), from
its own place and angle in the rig, with its own spectrum: vegetation is darker than soil in the visible bands and far
brighter in the near infra-red.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.special import expit

from agalign import geometry, lens
from agalign.geometry import Matrix, Points
from agalign.mapping import splined
from agalign.records import Lens, Tile
from agalign.tiff_directory import Entry, add_directories, byte_string, rational, short, text

Field = NDArray[np.float32]

_PIXELS_PER_MM = 266.666667
_FOCAL_LENGTH_MM = 5.45
_BLACK_LEVEL = 4800.0
_WHITE_LEVEL = 52000.0
_TIES, _TIES_OVER_RELIEF = (25, 19), (65, 49)
_TERRACE_M = 8.0
_RAY_STEPS = 40
"""A ray falls on relief by repeated intersection with the height below its last place."""
_VIGNETTING = 0.35
"""What the corners lack of the middle's light."""
_EXPOSURE_S = 1.3e-3
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""
_MAP_PX_PER_IMAGE_PX = 1.25
"""Resolution of the painted ground relative to the images, so that they do not show its pixels."""


@dataclass(frozen=True)
class BandSpec:
    """One camera of the rig."""

    name: str
    wavelength_nm: float
    bandwidth_nm: float
    soil: float
    crop: float
    tree: float
    """Reflectances, 0 to 1."""
    rig_index: int
    rig_degrees: tuple[float, float, float]
    baseline_m: tuple[float, float]
    """Place of the lens in the rig, metres right of and below the rig's centre."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3."""
    centre_offset_px: tuple[float, float]
    """Of the principal point from the middle of a 1280 x 960 sensor."""

    @property
    def exposure(self) -> float:
        """Share of the full signal that a reflectance of 1 would give."""
        return 0.55 / max(self.soil, self.crop)

    def lens(self, width_px: int, height_px: int) -> Lens:
        """The lens on a sensor of the given size; smaller sensors have larger pixels."""
        scale = width_px / 1280
        focal = _FOCAL_LENGTH_MM * _PIXELS_PER_MM * scale
        cx = (width_px - 1) / 2 + self.centre_offset_px[0] * scale
        cy = (height_px - 1) / 2 + self.centre_offset_px[1] * scale
        return Lens(focal, focal, cx, cy, self.distortion)


BANDS = (
    BandSpec("Blue", 475, 20, 0.085, 0.042, 0.030, 0, (0.31, -0.22, 0.12), (-0.03, -0.021),
             (-0.104, 0.150, -0.0003, 0.0006, -0.03), (11.2, -7.5)),
    BandSpec("Green", 560, 20, 0.125, 0.105, 0.070, 1, (0.0, 0.0, 0.0), (0.0, -0.021),
             (-0.101, 0.145, 0.0002, -0.0004, -0.02), (-6.3, 4.9)),
    BandSpec("Red", 668, 10, 0.185, 0.055, 0.040, 2, (-0.42, 0.35, -0.18), (0.03, -0.021),
             (-0.108, 0.158, -0.0001, 0.0003, -0.04), (3.7, 12.6)),
    BandSpec("NIR", 840, 40, 0.265, 0.520, 0.430, 3, (0.55, -0.16, 0.21), (-0.03, 0.021),
             (-0.110, 0.152, -0.0003, 0.0005, -0.05), (13.5, 9.1)),
    BandSpec("Red edge", 717, 10, 0.225, 0.285, 0.220, 4, (-0.27, -0.31, -0.09), (0.03, 0.021),
             (-0.106, 0.160, 0.0004, -0.0002, -0.06), (-9.4, -5.8)),
)  # fmt: skip
REFERENCE = 1


@dataclass(frozen=True)
class Pose:
    """Where the rig is at a capture, and its attitude."""

    altitude_m: float
    yaw_deg: float
    roll_deg: float
    pitch_deg: float
    east_m: float
    north_m: float


@dataclass(frozen=True)
class Ground:
    """The painted ground: shares of materials and textures on a square grid centred on the origin."""

    crop: Field
    tree: Field
    brightness: Field
    vigour: Field
    metres_per_px: float
    height_m: Field | None = None
    """Above the plane; None where everything lies on it."""


def make_flight(
    folder: Path, captures: int = 3, size_px: tuple[int, int] = (1280, 960), rng_seed: int = 0,
    bands: Sequence[BandSpec] = BANDS, relief_m: float = 0.0,
) -> Path:  # fmt: skip
    """Write `captures` captures of all bands into folder/0000SET/000 and the truth into folder/truth.json.

    The truth is {capture: {"reference": file, "bands": {file: {"fixed_to_moving": [[...]], "ties": [[x_ref, y_ref,
    x_mov, y_mov], ...]}}}}: the homography between undistorted pixels, and ties in raw pixels, exact to 0.001 px; the
    centre of the top-left pixel is (0, 0). With `relief_m` the ground has terraces of that height and trees half as
    high: the homography then is the plane's below them, and the ties are true. Returns the path of truth.json.
    """
    poses, ground, rng = lay_out_flight(captures, size_px, rng_seed, relief_m)
    images = folder / "0000SET" / "000"
    images.mkdir(parents=True, exist_ok=True)
    truth: dict[str, Any] = {}
    reference = bands[REFERENCE]
    for band in bands:
        painted = reflectance(ground, band)
        for number, pose in enumerate(poses, start=1):
            pixels = render(painted, ground, band, pose, size_px, rng)
            _write_band(images / _file_name(number, band), pixels, band, pose, number, size_px)
    for number, pose in enumerate(poses, start=1):
        names = {b.name: _file_name(number, b) for b in bands}
        truth[f"IMG_{number:04d}"] = {
            "reference": names[reference.name],
            "bands": {
                names[b.name]: {
                    "fixed_to_moving": true_homography(reference, b, pose, size_px).tolist(),
                    "ties": true_ties(ground, reference, b, pose, size_px),
                }
                for b in bands
                if b is not reference
            },
        }
    path = folder / "truth.json"
    path.write_text(json.dumps(truth))
    return path


def lay_out_flight(
    captures: int, size_px: tuple[int, int], rng_seed: int = 0, relief_m: float = 0.0
) -> tuple[list[Pose], Ground, np.random.Generator]:
    """(poses, ground, generator of the noise that follows) of the flight that `make_flight` writes."""
    rng = np.random.default_rng(rng_seed)
    poses = [_pose(rng, number) for number in range(captures)]
    return poses, paint_ground(rng, poses, size_px, relief_m), rng


def true_homography(reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """fixed_to_moving between undistorted pixels: both cameras' homographies to the ground plane, chained."""
    return geometry.compose(
        geometry.invert(_pixel_to_ground(band, pose, size_px)), _pixel_to_ground(reference, pose, size_px)
    )


def true_ties(
    ground: Ground, reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]
) -> list[list[float]]:
    """[x_ref, y_ref, x_mov, y_mov] in raw pixels on a lattice, where both lie in their images."""
    width, height = size_px
    here = geometry.lattice(width, height, *(_TIES if ground.height_m is None else _TIES_OVER_RELIEF))
    place, rays = _place_and_rays(band, pose, size_px)
    seen = _on_ground(ground, reference, pose, size_px, here)
    # The way back: a point of the ground from the band's place, as a ray of its camera.
    straight = geometry.apply(geometry.invert(rays), (seen[:, :2] - place[:2]) / (seen[:, 2:] - place[2]))
    there = lens.distort(band.lens(*size_px), straight)
    inside = ((there >= 0) & (there <= (width - 1, height - 1))).all(axis=1)
    rows: list[list[float]] = np.hstack([here, there])[inside].round(4).tolist()
    return rows


def _file_name(number: int, band: BandSpec) -> str:
    return f"IMG_{number:04d}_{band.rig_index + 1}.tif"


def view(painted: Field, ground: Ground, band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Field:
    """(height, width) of a painted ground as a band's camera sees it, through its lens, without vignetting or noise."""
    width, height = size_px

    def on_map(raw_px: Points) -> Points:
        return _map_px(ground, _on_ground(ground, band, pose, size_px, raw_px)[..., :2])

    y, x = np.arange(height), np.arange(width)
    if ground.height_m is None:
        positions = splined(on_map, Tile(0, 0, width, height)).astype(np.float32)
    else:
        positions = on_map(np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)).astype(np.float32)
    seen = cv2.remap(painted, positions, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(seen, np.float32)


def render(
    painted: Field, ground: Ground, band: BandSpec, pose: Pose, size_px: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.uint16]:
    """What one camera records of the ground painted in its band: (height, width) uint16 with vignetting and noise."""
    width, height = size_px
    scene = view(painted, ground, band, pose, size_px)
    y, x = np.arange(height), np.arange(width)
    radius2 = ((x - width / 2) ** 2)[None, :] + ((y - height / 2) ** 2)[:, None]
    vignetting = 1 - _VIGNETTING * radius2 / ((width / 2) ** 2 + (height / 2) ** 2)
    signal = np.clip(scene * band.exposure * vignetting, 0, 1)
    electrons = signal * 4000
    noisy = electrons + rng.normal(size=signal.shape) * np.sqrt(electrons + 60)
    levels = _BLACK_LEVEL + noisy / 4000 * (_WHITE_LEVEL - _BLACK_LEVEL)
    return np.asarray((np.clip(np.rint(levels / 16), 0, 4095) * 16).astype(np.uint16))


def reflectance(ground: Ground, band: BandSpec) -> Field:
    """The ground in one band: materials by their shares, crop by its vigour (the other way round in the visible)."""
    bright = 1 if band.wavelength_nm > 700 else -0.5
    crop = band.crop * (1 + 0.35 * bright * ground.vigour)
    soil = band.soil * ground.brightness
    bare = 1 - ground.crop - ground.tree
    return np.asarray(
        soil * bare + crop * ground.crop + band.tree * (1 + 0.5 * ground.vigour) * ground.tree, np.float32
    )


def paint_ground(
    rng: np.random.Generator, poses: Sequence[Pose], size_px: tuple[int, int], relief_m: float = 0.0
) -> Ground:
    """Parcels, rows, tracks and trees, large enough for all poses."""
    focal = _FOCAL_LENGTH_MM * _PIXELS_PER_MM * size_px[0] / 1280
    lowest, highest = min(p.altitude_m for p in poses), max(p.altitude_m for p in poses)
    metres_per_px = lowest / focal / _MAP_PX_PER_IMAGE_PX
    reach_m = max(np.hypot(p.east_m, p.north_m) for p in poses) + 0.62 * highest * np.hypot(*size_px) / focal
    side = 2 * int(np.ceil(reach_m / metres_per_px))
    metre = 1 / metres_per_px
    count = max(6, round((side / metre / 9) ** 2))
    parcel, edge = _parcels(rng, side, count)
    angle, spacing = rng.uniform(0, np.pi, count), rng.uniform(0.45, 0.85, count) * metre
    density = np.where(rng.random(count) < 0.15, -9.0, rng.uniform(-0.4, 0.4, count))
    across_x = (2 * np.pi * np.cos(angle) / spacing).astype(np.float32)[parcel]
    across_y = (2 * np.pi * np.sin(angle) / spacing).astype(np.float32)[parcel]
    axis = np.arange(side, dtype=np.float32)
    wobble = 0.06 * metre * _noise(rng, side, 1.5 * metre)
    rows = np.cos(across_x * (axis[None, :] + wobble) + across_y * (axis[:, None] + wobble))
    leaves = 0.7 * _noise(rng, side, 0.05 * metre) + 0.5 * _noise(rng, side, 0.25 * metre)
    crop = expit(6 * (rows + leaves + density.astype(np.float32)[parcel]))
    gaps = _noise(rng, side, 0.6 * metre) > 1.5
    crop = np.where(gaps, crop * 0.15, crop)
    crop = np.where(edge < 0.35 * metre, 0.03, crop)
    tree = _trees(rng, side, metre)
    crop = crop * (1 - tree)
    ruts = np.clip(1.5 - np.abs(edge - 0.18 * metre) / (0.05 * metre), 0, 1)
    brightness = 1 + 0.22 * _noise(rng, side, 2.5 * metre) + 0.16 * _noise(rng, side, 0.08 * metre)
    brightness = np.clip(brightness + 0.25 * (edge < 0.35 * metre) - 0.3 * ruts, 0.3, 2.2)
    vigour = 0.5 * _noise(rng, side, 3 * metre) + 0.45 * _noise(rng, side, 0.12 * metre)
    return Ground(
        crop.astype(np.float32),
        tree,
        brightness.astype(np.float32),
        np.clip(vigour, -1.5, 1.5).astype(np.float32),
        metres_per_px,
        _relief(rng, tree, metre, relief_m) if relief_m else None,
    )


def _relief(rng: np.random.Generator, tree: Field, metre: float, relief_m: float) -> Field:
    """Metres above the plane: three levels with slopes between them, and round trees upon them.

    No slope is so steep that a camera could not see it: where one hides another there is nothing to align.
    """
    angle = rng.uniform(0, np.pi)
    axis = np.arange(len(tree)) / (_TERRACE_M * metre)
    along = np.cos(angle) * axis[None, :] + np.sin(angle) * axis[:, None]
    slope = np.clip((along % 1 - 0.4) / 0.6, 0, 1)
    level = np.floor(along) + slope * slope * (3 - 2 * slope)
    crowns = cv2.GaussianBlur(tree, (0, 0), 0.4 * metre)
    return np.asarray(relief_m * (np.abs(level % 4 - 2) + 0.5 * crowns), np.float32)


def _parcels(rng: np.random.Generator, side: int, count: int) -> tuple[NDArray[np.int64], Field]:
    """Index of each pixel's parcel, and its distance in px from the parcel's edge: a Voronoi division.

    Worked out on every fourth pixel; the tracks along the edges hide the steps.
    """
    small = side // 4 + 1
    axis = np.arange(small, dtype=np.float32) * 4
    sites = rng.uniform(0, side, (count, 2)).astype(np.float32)
    nearest = np.full((small, small), np.inf, np.float32)
    second = nearest.copy()
    index = np.zeros((small, small), np.int64)
    for number, (site_x, site_y) in enumerate(sites):
        distance = np.hypot(axis[None, :] - site_x, axis[:, None] - site_y)
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        nearest = np.where(closer, distance, nearest)
        index[closer] = number
    edge = cv2.resize((second - nearest) / 2, (4 * small, 4 * small), interpolation=cv2.INTER_LINEAR)
    full = np.repeat(np.repeat(index, 4, axis=0), 4, axis=1)
    return full[:side, :side], np.asarray(edge[:side, :side], np.float32)


def _trees(rng: np.random.Generator, side: int, metre: float) -> Field:
    cover = np.zeros((side, side), np.float32)
    ragged = 0.35 * _noise(rng, side, 0.3 * metre)
    for _ in range(max(3, round((side / metre / 10) ** 2))):
        radius = rng.uniform(0.5, 1.2) * metre
        column, row = rng.uniform(0, side, 2)
        reach = 2 * radius
        x = np.arange(max(0, int(column - reach)), min(side, int(column + reach)))
        y = np.arange(max(0, int(row - reach)), min(side, int(row + reach)))
        window = np.ix_(y, x)
        inside = 1.2 * (1 - np.hypot(x[None, :] - column, y[:, None] - row) / radius) + ragged[window]
        cover[window] = np.maximum(cover[window], np.clip(4 * inside, 0, 1))
    return cover


def _noise(rng: np.random.Generator, side: int, grain_px: float) -> Field:
    """Gaussian noise of mean 0 and standard deviation 1 whose blobs are `grain_px` wide."""
    reduction = max(1.0, grain_px / 2)
    small = max(8, int(np.ceil(side / reduction)))
    coarse = cv2.GaussianBlur(
        rng.normal(size=(small, small)).astype(np.float32), (0, 0), max(0.5, grain_px / reduction / 2)
    )
    field = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray((field - field.mean()) / field.std(), np.float32)


def _pose(rng: np.random.Generator, number: int) -> Pose:
    return Pose(
        altitude_m=float(rng.uniform(22, 34)), yaw_deg=float(rng.uniform(-180, 180)),
        roll_deg=float(rng.normal(0, 2)), pitch_deg=float(rng.normal(0, 2)),
        east_m=4.0 * (number % 10), north_m=4.0 * (number // 10),
    )  # fmt: skip


def _pixel_to_ground(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """Undistorted pixel -> metres east and south on the plane below: the ray from the lens, cut with the plane."""
    place, rays = _place_and_rays(band, pose, size_px)
    # ground = place + ray * (-place_z / ray_z): linear in the homogeneous pixel once multiplied by ray_z.
    to_plane = np.array([[-place[2], 0.0, place[0]], [0.0, -place[2], place[1]], [0.0, 0.0, 1.0]])
    return geometry.normalised(to_plane @ rays)


def _place_and_rays(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> tuple[NDArray[np.float64], Matrix]:
    """(where the lens is, metres east, south and down of the origin; undistorted pixel -> direction of its ray)."""
    attitude = _rotation(pose.roll_deg, pose.pitch_deg, pose.yaw_deg)
    rays = attitude @ _rotation(*band.rig_degrees) @ np.linalg.inv(band.lens(*size_px).matrix)
    place = attitude @ np.array([*band.baseline_m, 0.0]) + (pose.east_m, pose.north_m, -pose.altitude_m)
    return place, rays


def _on_ground(ground: Ground, band: BandSpec, pose: Pose, size_px: tuple[int, int], raw_px: Points) -> Points:
    """(..., 3) metres east, south and down of what raw pixels (..., 2) see."""
    straight = lens.undistort(band.lens(*size_px), raw_px)
    place, rays = _place_and_rays(band, pose, size_px)
    direction = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1) @ rays.T
    down = np.zeros(direction.shape[:-1])
    seen = place + direction * ((down - place[2]) / direction[..., 2])[..., None]
    for _ in range(0 if ground.height_m is None else _RAY_STEPS):
        at = _map_px(ground, seen[..., :2]).astype(np.float32).reshape(len(seen), -1, 2)
        height = cv2.remap(ground.height_m, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        down = -height.reshape(down.shape).astype(np.float64)
        seen = place + direction * ((down - place[2]) / direction[..., 2])[..., None]
    return np.asarray(seen)


def _map_px(ground: Ground, metres: Points) -> Points:
    """Positions on the painted ground's pixels."""
    return metres / ground.metres_per_px + (len(ground.crop) - 1) / 2


def _rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    turns = [
        cv2.Rodrigues(np.radians(angle) * axis)[0] for angle, axis in zip((a_deg, b_deg, c_deg), np.eye(3), strict=True)
    ]
    return np.asarray(turns[0] @ turns[1] @ turns[2], np.float64)


def _write_band(
    path: Path, pixels: NDArray[np.uint16], band: BandSpec, pose: Pose, number: int, size_px: tuple[int, int]
) -> None:
    density = _PIXELS_PER_MM * size_px[0] / 1280
    model = band.lens(*size_px)
    moment = f"2026:06:21 10:{number // 60:02d}:{number % 60:02d}"
    xmp = _XMP.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm,
        cx=model.cx_px / density, cy=model.cy_px / density, focal=_FOCAL_LENGTH_MM,
        k1=band.distortion[0], k2=band.distortion[1], k3=band.distortion[4],
        p1=band.distortion[2], p2=band.distortion[3],
        rig=", ".join(f"{v:.6f}" for v in band.rig_degrees), index=band.rig_index, reference=REFERENCE,
        capture=f"synthetic{number:011d}", altitude=pose.altitude_m,
        middle_x=size_px[0] / 2, middle_y=size_px[1] / 2,
        fall=-_VIGNETTING / ((size_px[0] / 2) ** 2 + (size_px[1] / 2) ** 2),
        gain=_IRRADIANCE / np.pi * _EXPOSURE_S * 65536 / (_WHITE_LEVEL - _BLACK_LEVEL) / band.exposure,
        irradiance=_IRRADIANCE * 100,
    ).encode()  # fmt: skip
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    latitude, longitude = 52.0 + pose.north_m / 111_320, 5.0 + pose.east_m / 68_500
    first = {
        271: text("MicaSense"), 272: text("RedEdge-M"), 305: text("agalign demo"), 306: text(moment),
        700: byte_string(xmp), 50714: short(round(_BLACK_LEVEL)),
    }  # fmt: skip
    exif = {
        0x829A: rational(_EXPOSURE_S), 0x8827: short(100), 0x9003: text(moment), 0x920A: rational(_FOCAL_LENGTH_MM),
        0x9290: text("000000"), 0xA20E: rational(density), 0xA20F: rational(density), 0xA210: short(4),
        0xA431: text("SY01-0000001-AG"),
    }  # fmt: skip
    gps = {
        1: text("N"), 2: _degrees(latitude), 3: text("E"), 4: _degrees(longitude), 5: byte_string(b"\0"),
        6: rational(pose.altitude_m),
    }  # fmt: skip
    add_directories(path, first, exif, gps)


def _degrees(angle_deg: float) -> Entry:
    minutes = angle_deg % 1 * 60
    return rational(int(angle_deg), int(minutes), minutes % 1 * 60)


_XMP = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:RigName>RedEdge-M</Camera:RigName>
   <Camera:BandName>{name}</Camera:BandName>
   <Camera:CentralWavelength>{wavelength:g}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{fwhm:g}</Camera:WavelengthFWHM>
   <Camera:ModelType>perspective</Camera:ModelType>
   <Camera:PrincipalPoint>{cx:.8f},{cy:.8f}</Camera:PrincipalPoint>
   <Camera:PerspectiveFocalLength>{focal}</Camera:PerspectiveFocalLength>
   <Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>
   <Camera:PerspectiveDistortion>
    <rdf:Seq>
     <rdf:li>{k1}</rdf:li><rdf:li>{k2}</rdf:li><rdf:li>{k3}</rdf:li><rdf:li>{p1}</rdf:li><rdf:li>{p2}</rdf:li>
    </rdf:Seq>
   </Camera:PerspectiveDistortion>
   <Camera:VignettingCenter>
    <rdf:Seq><rdf:li>{middle_x}</rdf:li><rdf:li>{middle_y}</rdf:li></rdf:Seq>
   </Camera:VignettingCenter>
   <Camera:VignettingPolynomial>
    <rdf:Seq>
     <rdf:li>0</rdf:li><rdf:li>{fall:.9e}</rdf:li><rdf:li>0</rdf:li>
     <rdf:li>0</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li>
    </rdf:Seq>
   </Camera:VignettingPolynomial>
   <Camera:RigRelatives>{rig}</Camera:RigRelatives>
   <Camera:RigCameraIndex>{index}</Camera:RigCameraIndex>
   <Camera:RigRelativesReferenceRigCameraIndex>{reference}</Camera:RigRelativesReferenceRigCameraIndex>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:FlightId>syntheticflight00001</MicaSense:FlightId>
   <MicaSense:CaptureId>{capture}</MicaSense:CaptureId>
   <MicaSense:PressureAlt>{altitude:.3f}</MicaSense:PressureAlt>
   <MicaSense:RadiometricCalibration>
    <rdf:Seq><rdf:li>{gain:.9e}</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li></rdf:Seq>
   </MicaSense:RadiometricCalibration>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:DLS="http://micasense.com/DLS/1.0/">
   <DLS:HorizontalIrradiance>{irradiance:.6f}</DLS:HorizontalIrradiance>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""
