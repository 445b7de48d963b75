"""What one real Mavic 3 Multispectral writes, and what it means."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from agalign.cameras import other_rig_seed, rig_seed
from agalign.cameras.dji import Dji
from agalign.cameras.metadata import Tags
from agalign.capture.tag_seeds import seed_candidates
from agalign.config import SeedSettings
from agalign.pixels.raster import probe
from agalign.values import geometry, lens
from agalign.values.capture import Band

DJI = "dji.com/drone-dji"


def mavic_tags(matrix: str | None = None, **more: str) -> Tags:
    """A band's file of a Mavic 3, with the values of one real unit's red band and no distortion."""
    xmp = {
        "RelativeOpticalCenterX": "11.32",
        "RelativeOpticalCenterY": "3.06",
        "CalibratedOpticalCenterX": "1296",
        "CalibratedOpticalCenterY": "972",
        "DewarpData": "2022-09-08;2170,2170,0,0,0,0,0,0,0",
        "DewarpHMatrix": "1.7162,0,415.7048,0,1.7162,309.8536,0,0,1",
        **more,
    }
    if matrix is not None:
        xmp["CalibratedHMatrix"] = matrix
    return Tags(make="DJI", model="M3M", xmp={(DJI, k): (v,) for k, v in xmp.items()})


def mavic_band(tmp_path: Path, tags: Tags) -> Band:
    path = tmp_path / "DJI_20230607112233_0001_MS_R.TIF"
    tifffile.imwrite(path, np.zeros((48, 64), np.uint16), photometric="minisblack", metadata=None)
    (band,) = Dji().bands(path, tags, probe(path))
    return band


def test_a_mavic_without_calibration_shifts_by_its_optical_centres(tmp_path: Path) -> None:
    red = mavic_band(tmp_path, mavic_tags())
    nir = mavic_band(tmp_path, mavic_tags(RelativeOpticalCenterX="0", RelativeOpticalCenterY="0"))
    np.testing.assert_allclose(rig_seed(nir, red), geometry.translation(11.32, 3.06), atol=1e-9)
    assert other_rig_seed(nir, red) is None
    assert red.lens is not None
    assert not lens.is_distorting(red.lens)


def test_a_calibrated_mavic_offers_both(tmp_path: Path) -> None:
    red = mavic_band(tmp_path, mavic_tags("1,0,-11,0,1,-3,0,0,1"))
    nir = mavic_band(tmp_path, mavic_tags("1,0,0,0,1,0,0,0,1", RelativeOpticalCenterX="0", RelativeOpticalCenterY="0"))
    np.testing.assert_allclose(rig_seed(nir, red), geometry.translation(11, 3), atol=1e-9)
    np.testing.assert_allclose(other_rig_seed(nir, red), geometry.translation(11.32, 3.06), atol=1e-9)
    offered = seed_candidates(nir, red, SeedSettings())
    assert list(offered) == ["rig", "centre", "identity"]


def test_the_mavic_s_colour_photograph_goes_through_the_designed_frame(tmp_path: Path) -> None:
    """The middle of the bands' frame, (1296, 972), lies at (2639.9, 1978.0) of the photograph."""
    colour = Tags(make="DJI", model="M3M", xmp={(DJI, "CaptureUUID"): ("abc",)})
    photo = tmp_path / "DJI_20230607112233_0001_D.JPG"
    cv2.imwrite(str(photo), np.zeros((48, 64, 3), np.uint8))
    nir = mavic_band(tmp_path, mavic_tags(RelativeOpticalCenterX="0", RelativeOpticalCenterY="0"))
    rgb = Dji().bands(photo, colour, probe(photo))
    assert [b.to_rig for b in rgb] == [None] * 3
    placed = {b.name: b for b in Dji().with_shared_rig([nir, *rgb], [mavic_tags(), colour])}
    seed = rig_seed(nir, placed["RGB Red"])
    np.testing.assert_allclose(geometry.apply(seed, np.array([[1296.0, 972.0]])), [[2639.9, 1978.0]], atol=0.01)
    assert geometry.local_scale(seed, 2592, 1944)[-1] == pytest.approx(1.7162)
    # The Phantom's matrix of that name is none such.
    phantom = Tags(**{**vars(mavic_tags()), "model": "FC6360"})
    assert Dji().with_shared_rig([nir, *rgb], [phantom, colour])[1].to_rig is None


@pytest.mark.parametrize(("roll", "yaw"), [("0.00", "30"), ("+180.00", "-150")])
def test_a_mavic_s_gimbal_is_turned_either_way(roll: str, yaw: str) -> None:
    tags = mavic_tags(
        GimbalRollDegree=roll,
        GimbalYawDegree=yaw,
        GimbalPitchDegree="-90",
        FlightXSpeed="8.66",
        FlightYSpeed="5",
        RelativeAltitude="20",
        CalibratedFocalLength="2170",
    )
    assert Dji().motion(tags) == pytest.approx((0.0, 0.5), abs=1e-3)
    pose = Dji().pose(tags)
    assert (pose.heading_deg % 360, pose.pitch_deg, pose.height_m) == (pytest.approx(30), 0, 20)


def test_pixels_that_are_dewarped_have_no_distortion(tmp_path: Path) -> None:
    bent = "2022-09-08;2170,2170,0,0,-0.1,0.05,0,0,0"
    result = [mavic_band(tmp_path, mavic_tags(DewarpData=bent, DewarpFlag=flag)).lens for flag in "01"]
    assert [lens.is_distorting(one) for one in result] == [True, False]


@pytest.mark.parametrize("black", ["0", "4096"])
def test_a_black_level_of_0_is_a_black_level(tmp_path: Path, black: str) -> None:
    tags = mavic_tags(SensorGain="1", ExposureTime="2000", BlackLevel=black)
    band = mavic_band(tmp_path, replace(tags, black_level=3200.0))
    assert band.radiometry.black_level == float(black)


def test_without_a_black_level_there_is_no_radiometry(tmp_path: Path) -> None:
    tags = mavic_tags(SensorGain="1", ExposureTime="2000")
    assert mavic_band(tmp_path, tags).radiometry is None
    by_tiff_tag = mavic_band(tmp_path, replace(tags, black_level=0.0)).radiometry
    assert by_tiff_tag.black_level == 0.0
