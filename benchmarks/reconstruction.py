"""Reconstructs a flight from its bands with COLMAP, and compares the poses that the bands of each capture get.

python benchmarks/reconstruction.py FLIGHT OUT

OUT is the output of `agalign FLIGHT -o OUT --layout bands`. Each band is reconstructed by itself, then all bands
together: in the common reconstruction the bands of a capture have one pose where they are aligned. The original images,
which a rig of several cameras took, are the control. `pip install "pycolmap>=4"`; it is no dependency of agalign.
"""

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from agalign.cameras import known_cameras
from agalign.cameras.discover import discover
from agalign.cameras.read_files import read_file
from agalign.cameras.scan import DiscoverOptions
from agalign.pixels.raster import open_raster, without_warnings
from agalign.products.sidecar_file import find_sidecars, read_sidecar
from agalign.values.capture import Band

_SHOWN_PERCENTILES = 0.5, 99.5


@dataclass(frozen=True)
class Pinhole:
    """The camera of all photos."""

    matrix: NDArray[np.float64]
    size_px: tuple[int, int]

    @property
    def params(self) -> str:
        """fx, fy, cx, cy; COLMAP counts from the corner of the top-left pixel."""
        k = self.matrix
        return f"{k[0, 0]},{k[1, 1]},{k[0, 2] + 0.5},{k[1, 2] + 0.5}"


@dataclass(frozen=True)
class Photo:
    """One band of one capture in 8 bits, undistorted to the pinhole camera that all photos share."""

    capture: str
    band: str
    pixels: NDArray[np.uint8]

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.capture}--{self.band}.png"


@dataclass(frozen=True)
class BandPose:
    """The pose of a band of one capture relative to the reference's."""

    band: str
    rotation_px: float
    """The angle between the two, px at the centre of the image."""
    offset_px: float
    """The distance of the two centres of projection, px of the ground below."""
    shift_px: float
    """Median distance of the scene's points in the two images: over flat ground a rotation and an offset cancel."""


def photo_of(capture: str, name: str, band: Band, camera: Pinhole) -> Photo:
    """A band of a file, undistorted by the lens in the file's tags."""
    with open_raster(band.path) as source:
        raw = source.read(band.band_index).astype(np.float32)
    low, high = np.percentile(raw[raw > 0], _SHOWN_PERCENTILES)
    grey = (np.clip((raw - low) / (high - low), 0, 1) * 255).astype(np.uint8)
    assert band.lens is not None
    distortion = np.array((*band.lens.distortion, *(0.0,) * 8)[:8])
    maps = cv2.initUndistortRectifyMap(
        band.lens.matrix, distortion, np.eye(3), camera.matrix, camera.size_px, cv2.CV_32FC1
    )  # fmt: skip
    return Photo(capture, name, np.asarray(cv2.remap(grey, *maps, cv2.INTER_CUBIC), np.uint8))


def aligned_photos(out: Path) -> tuple[list[Photo], Pinhole, str]:
    """(the band files of a run, their camera, the name of the reference)."""
    photos: list[Photo] = []
    camera, reference = None, ""
    for path in find_sidecars(out):
        sidecar = read_sidecar(path)
        reference = sidecar.reference.band
        for part in sidecar.bands:
            if part.place is not None:
                (band,) = read_file(path.parent / part.place.file, known_cameras(), DiscoverOptions()).bands
                assert band.lens is not None
                camera = camera or Pinhole(band.lens.matrix, band.size_px)
                photos.append(photo_of(sidecar.capture, part.band, band, camera))
    if camera is None:
        raise SystemExit(f"{out}: no band files; run agalign with --layout bands")
    return photos, camera, reference


def original_photos(flight: Path, names: set[str]) -> tuple[list[Photo], Pinhole]:
    """(the original bands of these captures, the camera of the first one's reference)."""
    captures = [c for c in discover(flight).captures if c.name in names]
    lens = captures[0].reference.lens
    assert lens is not None
    camera = Pinhole(lens.matrix, captures[0].reference.size_px)
    return [photo_of(c.name, b.name, b, camera) for c in captures for b in c.bands], camera


def reconstruct(photos: Sequence[Photo], camera: Pinhole) -> pycolmap.Reconstruction | None:
    """The largest model of some photos with a known camera; None where there is none."""
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False, ba_refine_principal_point=False, ba_refine_extra_params=False,
        min_model_size=2, random_seed=0,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        images, database = root / "images", root / "database.db"
        images.mkdir()
        for one in photos:
            cv2.imwrite(str(images / one.name), one.pixels)
        pycolmap.extract_features(
            database, images, camera_mode=pycolmap.CameraMode.SINGLE, device=pycolmap.Device.cpu,
            reader_options=pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=camera.params),
        )  # fmt: skip
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(database, images, root / "models", options)
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def poses(model: pycolmap.Reconstruction, camera: Pinhole, reference: str) -> list[BandPose]:
    """The poses of the bands relative to the reference of their capture, where both are in the model."""
    found = {tuple(i.name.removesuffix(".png").split("--")): i for i in model.images.values() if i.has_pose}
    focal_px = float(camera.matrix[0, 0])
    result = []
    for (capture, band), image in found.items():
        other = found.get((capture, reference))
        if band == reference or other is None:
            continue
        one, two = image.cam_from_world(), other.cam_from_world()
        turned = one.rotation.matrix() @ two.rotation.matrix().T
        angle = math.acos(min(1.0, (float(np.trace(turned)) - 1) / 2))
        points = np.array([model.points3D[p.point3D_id].xyz for p in other.points2D if p.has_point3D()])
        seen, seen_by_other = (points @ m.rotation.matrix().T + m.translation for m in (one, two))
        shifts = (seen[:, :2] / seen[:, 2:] - seen_by_other[:, :2] / seen_by_other[:, 2:]) * focal_px
        distance = float(np.linalg.norm(image.projection_center() - other.projection_center()))
        offset_px = distance / float(np.median(seen_by_other[:, 2])) * focal_px
        shift_px = float(np.median(np.linalg.norm(shifts, axis=1)))
        result.append(BandPose(band, math.tan(angle) * focal_px, offset_px, shift_px))
    return result


def summary(model: pycolmap.Reconstruction | None, photos: Sequence[Photo]) -> str:
    """Photos with a pose, points, and the mean reprojection error, as cells of a table."""
    if model is None:
        return f"0 of {len(photos)} | - | -"
    error_px = model.compute_mean_reprojection_error()
    return f"{model.num_reg_images()} of {len(photos)} | {model.num_points3D()} | {error_px:.2f}"


def print_by_band(photos: Sequence[Photo], camera: Pinhole) -> None:
    """A reconstruction for each band."""
    print("\n| aligned band by itself | photos with a pose | points | reprojection error, px |\n|---|---|---|---|")
    for band in dict.fromkeys(p.band for p in photos):
        own = [p for p in photos if p.band == band]
        print(f"| {band} | {summary(reconstruct(own, camera), own)} |")


def print_together(title: str, photos: Sequence[Photo], camera: Pinhole, reference: str) -> None:
    """One reconstruction of all bands."""
    model = reconstruct(photos, camera)
    if model is None:
        print(f"\n{title}: no model; do at least three captures overlap?")
        return
    print(f"\n{title}: {summary(model, photos)}")
    print(
        f"\n| band | captures | shift of the scene against {reference}, px | rotation, px | offset, px of the ground |"
    )
    print("|---|---|---|---|---|")
    result = poses(model, camera, reference)
    for band in sorted({p.band for p in result}):
        own = [p for p in result if p.band == band]
        columns = [p.shift_px for p in own], [p.rotation_px for p in own], [p.offset_px for p in own]
        cells = " | ".join(f"{median(values):.2f}, {max(values):.2f}" for values in columns)
        print(f"| {band} | {len(own)} | {cells} |")


def main() -> None:
    """Print all tables; shifts, rotations and offsets are median and maximum over the captures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    with without_warnings():
        photos, camera, reference = aligned_photos(arguments.out)
        originals, their_camera = original_photos(arguments.flight, {p.capture for p in photos})
    print_by_band(photos, camera)
    print_together("All aligned bands", photos, camera, reference)
    print_together("All original bands", originals, their_camera, reference)


if __name__ == "__main__":
    main()
