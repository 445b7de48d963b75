"""Reconstructs a flight from its bands with COLMAP, and compares the poses that the bands of each capture get.

python benchmarks/reconstruction.py FLIGHT OUT

OUT is the output of `agalign FLIGHT -o OUT --layout bands`. In the reconstruction from all bands, the bands of a
capture have one pose where they are aligned. The original images, which a rig of several cameras took, are the control.
`pip install "pycolmap>=4"`; it is no dependency of agalign.
"""

import tempfile
from collections import defaultdict
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import pycolmap
from common import print_head, print_row, read_band, run
from numpy.typing import NDArray

from agalign.cameras.discover import discover
from agalign.cameras.makers import known_cameras
from agalign.cameras.read_files import read_file
from agalign.config import DiscoverOptions
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values.capture import Band

_SHOWN_PERCENTILES = 0.5, 99.5
Photos = dict[tuple[str, str], NDArray[np.uint8]]
"""By capture and band: 8 bits, undistorted to the pinhole camera that all photos share."""


def photo_of(band: Band, shared: Band) -> NDArray[np.uint8]:
    """A band of a file, undistorted by the lens in the file's tags to the pinhole camera of another band."""
    raw = read_band(band.path, band.band_index).astype(np.float32)
    low, high = np.percentile(raw[raw > 0], _SHOWN_PERCENTILES)
    grey = (np.clip((raw - low) / (high - low), 0, 1) * 255).astype(np.uint8)
    distortion = np.array((*band.lens.distortion, *(0.0,) * 8)[:8])
    new = shared.lens.matrix, shared.size_px, cv2.CV_32FC1
    maps = cv2.initUndistortRectifyMap(band.lens.matrix, distortion, np.eye(3), *new)
    return np.asarray(cv2.remap(grey, *maps, cv2.INTER_CUBIC), np.uint8)


def aligned_photos(out: Path) -> tuple[Photos, Band, str]:
    """(the band files of a run, a band with the camera of all, the name of the reference)."""
    bands: dict[tuple[str, str], Band] = {}
    for path in find_sidecars(out):
        sidecar = read_sidecar(path)
        for part in (p for p in sidecar.bands if p.place is not None):
            (band,) = read_file(path.parent / part.place.file, known_cameras(), DiscoverOptions()).bands
            bands[sidecar.capture, part.band] = band
    if not bands:
        raise SystemExit(f"{out}: no band files; run agalign with --layout bands")
    first = next(iter(bands.values()))
    return {key: photo_of(band, first) for key, band in bands.items()}, first, sidecar.reference.band


def original_photos(flight: Path, names: set[str]) -> tuple[Photos, Band]:
    """(the original bands of these captures, a band with the camera of all: the reference of the first one)."""
    captures = [c for c in discover(flight).captures if c.name in names]
    first = captures[0].reference
    return {(c.name, b.name): photo_of(b, first) for c in captures for b in c.bands}, first


def reconstruct(photos: Photos, shared: Band) -> pycolmap.Reconstruction | None:
    """The largest model of some photos with the known camera of a band; None where there is none."""
    fixed = dict.fromkeys(("ba_refine_focal_length", "ba_refine_principal_point", "ba_refine_extra_params"), False)
    options = pycolmap.IncrementalPipelineOptions(**fixed, min_model_size=2, random_seed=0)
    k = shared.lens  # COLMAP counts from the corner of the top-left pixel
    params = f"{k.fx_px},{k.fy_px},{k.cx_px + 0.5},{k.cy_px + 0.5}"
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=params)
    on_cpu = {"device": pycolmap.Device.cpu}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        images, database = root / "images", root / "database.db"
        images.mkdir()
        for key, pixels in photos.items():
            cv2.imwrite(str(images / f"{'--'.join(key)}.png"), pixels)
        camera = {"camera_mode": pycolmap.CameraMode.SINGLE, "reader_options": reader}
        pycolmap.extract_features(database, images, **camera, **on_cpu)
        pycolmap.match_exhaustive(database, **on_cpu)
        models = pycolmap.incremental_mapping(database, images, root / "models", options)
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def shifts_px(model: pycolmap.Reconstruction, shared: Band, reference: str) -> dict[str, list[float]]:
    """The poses of each band relative to the reference of its capture, where both are in the model: median distance of
    the scene's points in the two images.
    """
    images = {tuple(i.name.removesuffix(".png").split("--")): i for i in model.images.values() if i.has_pose}
    result = defaultdict[str, list[float]](list)
    for (capture, band), image in sorted(images.items()):
        other = images.get((capture, reference))
        if band == reference or other is None:
            continue
        points = np.array([model.points3D[p.point3D_id].xyz for p in other.points2D if p.has_point3D()])
        seen = [
            points @ m.rotation.matrix().T + m.translation for m in (image.cam_from_world(), other.cam_from_world())
        ]
        here, there = (shared.lens.fx_px * m[:, :2] / m[:, 2:] for m in seen)
        result[band].append(float(np.median(np.linalg.norm(here - there, axis=1))))
    return result


def print_together(title: str, photos: Photos, shared: Band, reference: str) -> None:
    """One reconstruction of all bands; medians and maxima over the captures."""
    model = reconstruct(photos, shared)
    if model is None:
        print(f"\n{title}: no model; do at least three captures overlap?")
        return
    error_px = model.compute_mean_reprojection_error()
    print(f"\n{title}: {model.num_reg_images()} of {len(photos)} photos, reprojection error {error_px:.2f} px\n")
    print_head("band", "captures", f"shift of the scene against {reference}, px: median, maximum")
    for band, own in sorted(shifts_px(model, shared, reference).items()):
        print_row(band, len(own), f"{median(own):.2f}, {max(own):.2f}")


def main(flight: Path, out: Path) -> None:
    """Print all tables."""
    pycolmap.logging.minloglevel = 2
    photos, camera, reference = aligned_photos(out)
    originals, their_camera = original_photos(flight, {capture for capture, _ in photos})
    print_together("All aligned bands", photos, camera, reference)
    print_together("All original bands", originals, their_camera, reference)


if __name__ == "__main__":
    run(main)
