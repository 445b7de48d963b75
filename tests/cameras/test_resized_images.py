"""Images that a program resized or cropped, with the camera's tags."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from agalign.cameras import pix4d
from agalign.cameras.discover import FolderScan, discover
from agalign.cameras.metadata import Tags
from agalign.cameras.tiff_directory import EXIF, GPS, add_directories, read_directories, short
from agalign.pixels.radiometry import calibrated
from agalign.values import geometry
from agalign.values.capture import Capture
from agalign.values.pixel_units import PixelScale

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def resized(source: Path, folder: Path, share: float, *, with_size: bool) -> Path:
    """Reduce the first capture of a flight, with its tags; `with_size` adds the size of the original to Exif."""
    folder.mkdir()
    for path in sorted(source.rglob("IMG_0001_*.tif")):
        pixels = tifffile.imread(path)
        size_px = round(share * pixels.shape[1]), round(share * pixels.shape[0])
        tifffile.imwrite(folder / path.name, cv2.resize(pixels, size_px, interpolation=cv2.INTER_AREA), metadata=None)
        tags = read_directories(path)
        first = {tag: entry for tag, entry in tags[0].items() if tag in (271, 272, 306, 700, 0xC61A)}
        size = {0xA002: short(pixels.shape[1]), 0xA003: short(pixels.shape[0])} if with_size else {}
        add_directories(folder / path.name, first, tags[EXIF] | size, tags[GPS])
    return folder


def only(scan: FolderScan) -> Capture:
    (capture,) = scan.captures
    return capture


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_tags_in_pixels_follow_the_size_that_exif_names(flight: Path, tmp_path: Path, share: float) -> None:
    scan = discover(resized(flight, tmp_path / "small", share, with_size=True))
    full, small = discover(flight).captures[0], only(scan)
    assert not scan.problems
    scale = PixelScale.between(full.bands[0].size_px, small.bands[0].size_px)
    for before, after in zip(full.bands, small.bands, strict=True):
        assert after.lens.fx_px == pytest.approx(share * before.lens.fx_px)
        point = np.array([[100.0, 80.0]])
        np.testing.assert_allclose(
            geometry.apply(after.to_rig, scale.positions(point)), geometry.apply(before.to_rig, point), atol=1e-9
        )
        # Equal numbers at one place of the scene are equal radiances.
        grey = np.full((before.height_px, before.width_px), 20000, np.uint16)
        radiance = calibrated(grey, before.radiometry, 0, 0)
        reduced = calibrated(grey[: after.height_px, : after.width_px], after.radiometry, 0, 0)
        expected = cv2.resize(radiance, after.size_px, interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(reduced, expected, rtol=1e-3)
    assert small.pose.focal_length_px == pytest.approx(share * full.pose.focal_length_px)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_the_lens_of_another_image_size_is_left_out_with_a_line(flight: Path, tmp_path: Path, share: float) -> None:
    scan = discover(resized(flight, tmp_path / "small", share, with_size=False))
    (problem,) = scan.problems
    size = " x ".join(map(str, only(scan).bands[0].size_px))
    assert f"is not that of an image of {size} px, and so in 4 other files; lens, rig and radiometry" in problem.text
    assert all(b.lens is None and b.to_rig is None and b.radiometry is None for b in only(scan).bands)
    assert only(scan).pose == replace(discover(flight).captures[0].pose, focal_length_px=None)


@pytest.mark.parametrize(("size_px", "focal_px"), [((1280, 960), 1454.4), ((160, 120), 181.8), ((160, 80), None)])
def test_a_lens_in_mm_without_exif_has_its_centre_near_the_middle(
    size_px: tuple[int, int], focal_px: float | None
) -> None:
    values = {"PrincipalPoint": ("2.3745", "1.8165"), "PerspectiveFocalLength": ("5.45",)}
    tags = Tags(size_px=size_px, xmp={(pix4d.NAMESPACE, name): value for name, value in values.items()})
    lens = pix4d.perspective_lens(tags)
    assert (lens and lens.fx_px) == (focal_px and pytest.approx(focal_px, rel=1e-3))
    assert lens is None or lens.is_plausible(size_px)
