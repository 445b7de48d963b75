"""No capture is classified as sky by a single cue: a tag, a name, or an image without texture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from agalign.cameras.discover import discover
from agalign.cameras.metadata import Tags
from agalign.cameras.micasense import MicaSense
from agalign.flight.sky import sky_captures, sky_cues, sky_radiance
from agalign.values.capture import Band, Capture
from agalign.values.radiometry import Radiometry

DLS = "micasense.com/DLS"


def capture(folder: Path, *, rough: bool, elevation_deg: float | None, below: str = "") -> Capture:
    rng = np.random.default_rng(0)
    bands = []
    for name in ("Green", "NIR"):
        pixels = np.linspace(20000, 30000, 64)[:, None] + rng.normal(0, 6000 if rough else 60, (64, 80))
        tifffile.imwrite(folder / f"{name}.tif", pixels.clip(0, 65535).astype(np.uint16))
        bands.append(Band(name, folder / f"{name}.tif", 1, 80, 64, "uint16"))
    return Capture("IMG_0001", Path(below), tuple(bands), 0, elevation_deg=elevation_deg)


@pytest.mark.parametrize(
    ("rough", "elevation_deg", "below", "is_sky"),
    [
        (False, 40.0, "", True),
        (False, -80.0, "raw_sky_imgs", True),
        (True, 40.0, "sky", True),
        (False, -80.0, "", False),
        (True, 40.0, "", False),
        (True, -80.0, "sky", False),
        (False, 10.0, "", False),
        (False, None, "skyline_farm", False),
    ],
)
def test_two_cues_make_a_capture_of_the_sky(
    tmp_path: Path, rough: bool, elevation_deg: float | None, below: str, is_sky: bool
) -> None:
    one = capture(tmp_path, rough=rough, elevation_deg=elevation_deg, below=below)
    assert bool(sky_cues(one)) is is_sky
    sky, others = sky_captures([one])
    assert (len(sky), len(others)) == (is_sky, not is_sky)


def test_one_band_with_texture_or_that_cannot_be_read_is_not_the_sky(tmp_path: Path) -> None:
    smooth = capture(tmp_path, rough=False, elevation_deg=40.0)
    rough = tmp_path / "rough.tif"
    tifffile.imwrite(rough, np.random.default_rng(0).integers(0, 60000, (64, 80)).astype(np.uint16))
    for path in (rough, tmp_path / "x.tif"):
        assert sky_cues(replace(smooth, bands=(smooth.bands[0], replace(smooth.bands[1], path=path)))) == ()


@pytest.mark.parametrize(
    ("pitch", "roll", "elevation_deg"), [(0.0, 0.0, -90.0), (-0.87, 3.09, 40.1), (0.3, -0.4, -61.6)]
)
def test_the_light_sensor_gives_the_direction_of_the_camera(pitch: float, roll: float, elevation_deg: float) -> None:
    angles = {"Yaw": 1.0, "Pitch": pitch, "Roll": roll}
    tags = Tags(make="MicaSense", xmp={(DLS, name): (str(angle),) for name, angle in angles.items()})
    pose = MicaSense().pose(tags)
    assert (pose.heading_deg, pose.pitch_deg, pose.roll_deg) == pytest.approx(np.degrees([1.0, pitch, roll]))
    assert MicaSense().elevation_deg(tags) == pytest.approx(elevation_deg, abs=0.1)
    assert MicaSense().elevation_deg(Tags(make="MicaSense")) is None


@pytest.mark.real
def test_no_real_scene_is_classified_as_sky_whatever_its_tags(real_data: Path) -> None:
    found = discover(real_data / "flights").captures
    sky, _ = sky_captures(found)
    assert [s.capture.label for s in sky] == ["water/sky/IMG_0003"]
    turned, _ = sky_captures(replace(c, elevation_deg=60.0) for c in found if "sky" not in c.folder.parts)
    assert turned == []


def test_the_median_radiance_counts_saturated_pixels_as_bright(tmp_path: Path) -> None:
    """Two fifths are saturated, as around the sun: the median is among the brightest of the others."""
    (band, _) = capture(tmp_path, rough=False, elevation_deg=40.0).bands
    pixels = np.linspace(10_000, 60_000, 100 * 80).astype(np.uint16).reshape(100, 80)
    tifffile.imwrite(band.path, np.where(pixels > 40_000, 65_535, pixels).astype(np.uint16))
    band = replace(band, height_px=100, saturation_value=65535.0)
    band = replace(band, radiometry=Radiometry("radiance", 0.0, 1.0, 1.0))
    assert sky_radiance(band) == pytest.approx(35_000, rel=1e-3)
    tifffile.imwrite(band.path, np.where(pixels > 30_000, 65_535, pixels).astype(np.uint16))
    assert sky_radiance(band) is None
