"""A synthetic flight over a farm, written as a MicaSense-like camera would, with the truth beside it.

The scene is a plane of parcels with crop rows of different directions and spacings, bare soil, tracks and trees, or
terraces with trees that stand up from them. Each band sees it through its own lens (distortion, principal point), from
its own place and angle in the rig, with its own spectrum: vegetation is darker than soil in the visible bands and far
brighter in the near infra-red.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign.cameras.tiff_directory import Entry, add_directories, byte_string, rational, short, text
from agalign.synthetic.ground import Field, Ground, map_px, on_ground, paint_ground, reflectance
from agalign.synthetic.rig import (
    BANDS,
    FOCAL_LENGTH_MM,
    PIXELS_PER_MM,
    REFERENCE,
    BandSpec,
    Pose,
    place_and_rays,
    true_homography,
)
from agalign.values import geometry, lens
from agalign.values.geometry import Points
from agalign.values.image import Tile
from agalign.values.mapping import splined

ALTITUDE_M = 22.0, 34.0
_BLACK_LEVEL = 4800.0
_WHITE_LEVEL = 52000.0
_TIES, _TIES_OVER_RELIEF = (25, 19), (65, 49)
_VIGNETTING = 0.35
"""What the corners lack of the middle's light."""
_EXPOSURE_S = 1.3e-3
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""


def make_flight(
    folder: Path, captures: int = 3, size_px: tuple[int, int] = (1280, 960), rng_seed: int = 0,
    bands: Sequence[BandSpec] = BANDS, relief_m: float = 0.0,
    altitude_m: tuple[float, float] = ALTITUDE_M,
) -> Path:  # fmt: skip
    """Write `captures` captures of all bands into folder/0000SET/000 and the truth into folder/truth.json.

    The truth is {capture: {"reference": file, "bands": {file: {"fixed_to_moving": [[...]], "ties": [[x_ref, y_ref,
    x_mov, y_mov], ...]}}}}: the homography between undistorted pixels, and ties in raw pixels, exact to 0.001 px; the
    centre of the top-left pixel is (0, 0). With `relief_m` the ground has terraces of that height and trees half as
    high: the homography then is the plane's below them, and the ties are true. `altitude_m` is between what heights
    above the plane the captures are taken. Returns the path of truth.json.
    """
    poses, ground, rng = lay_out_flight(captures, size_px, rng_seed, relief_m, altitude_m)
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
    captures: int,
    size_px: tuple[int, int],
    rng_seed: int = 0,
    relief_m: float = 0.0,
    altitude_m: tuple[float, float] = ALTITUDE_M,
) -> tuple[list[Pose], Ground, np.random.Generator]:
    """(poses, ground, generator of the noise that follows) of the flight that `make_flight` writes."""
    rng = np.random.default_rng(rng_seed)
    poses = [_pose(rng, number, altitude_m) for number in range(captures)]
    return poses, paint_ground(rng, poses, size_px, relief_m), rng


def true_ties(
    ground: Ground, reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]
) -> list[list[float]]:
    """[x_ref, y_ref, x_mov, y_mov] in raw pixels on a lattice, where both lie in their images."""
    width, height = size_px
    here = geometry.lattice(width, height, *(_TIES if ground.height_m is None else _TIES_OVER_RELIEF))
    place, rays = place_and_rays(band, pose, size_px)
    seen = on_ground(ground, reference, pose, size_px, here)
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
        return map_px(ground, on_ground(ground, band, pose, size_px, raw_px)[..., :2])

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


def _pose(rng: np.random.Generator, number: int, altitude_m: tuple[float, float]) -> Pose:
    return Pose(
        altitude_m=float(rng.uniform(*altitude_m)), yaw_deg=float(rng.uniform(-180, 180)),
        roll_deg=float(rng.normal(0, 2)), pitch_deg=float(rng.normal(0, 2)),
        east_m=4.0 * (number % 10), north_m=4.0 * (number // 10),
    )  # fmt: skip


def _write_band(
    path: Path, pixels: NDArray[np.uint16], band: BandSpec, pose: Pose, number: int, size_px: tuple[int, int]
) -> None:
    density = PIXELS_PER_MM * size_px[0] / 1280
    model = band.lens(*size_px)
    moment = f"2026:06:21 10:{number // 60:02d}:{number % 60:02d}"
    xmp = _XMP.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm,
        cx=model.cx_px / density, cy=model.cy_px / density, focal=FOCAL_LENGTH_MM,
        k1=band.distortion[0], k2=band.distortion[1], k3=band.distortion[4],
        p1=band.distortion[2], p2=band.distortion[3],
        rig=", ".join(f"{v:.6f}" for v in band.rig_degrees),
        place=f"{band.baseline_m[0]:.4f}, {band.baseline_m[1]:.4f}, 0", index=band.rig_index, reference=REFERENCE,
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
        0x829A: rational(_EXPOSURE_S), 0x8827: short(100), 0x9003: text(moment), 0x920A: rational(FOCAL_LENGTH_MM),
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
   <Camera:RigTranslations>{place}</Camera:RigTranslations>
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
