from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import probe
from agalign.synthetic import flight as synthetic
from agalign.synthetic import rig
from agalign.synthetic.ground import paint_ground
from agalign.values.capture import Radiometry


def test_every_term_has_its_place() -> None:
    radiometry = Radiometry("radiance", 1000.0, 65536.0, 2.0, (3.0, 4.0), (0.1, 0, 0, 0, 0, 0), True, 0.01)
    raw = np.full((10, 12), 3000, np.uint16)
    found = calibrated(raw, radiometry, 0, 0)
    signal = 2.0 * 2000 / 65536
    assert found[4, 3] == pytest.approx(signal / 1.04, rel=1e-6)
    assert found[4, 8] == pytest.approx(signal / 1.5 / 1.04, rel=1e-6)
    assert found[9, 3] == pytest.approx(signal / 1.5 / 1.09, rel=1e-6)
    times = calibrated(raw, replace(radiometry, vignetting_divides=False), 0, 0)
    assert times[4, 8] == pytest.approx(signal * 1.5 / 1.04, rel=1e-6)


def test_a_window_is_a_part_of_the_whole() -> None:
    radiometry = Radiometry("radiance", 1000.0, 65536.0, 2.0, (30.0, 20.0), (1e-3, -1e-5, 0, 0, 0, 0), True, 0.001)
    raw = np.random.default_rng(0).integers(2000, 60000, (50, 60)).astype(np.uint16)
    whole = calibrated(raw, radiometry, 0, 0)
    np.testing.assert_allclose(calibrated(raw[10:30, 20:50], radiometry, 20, 10), whole[10:30, 20:50], rtol=1e-6)


def test_reflectance_of_the_synthetic_flight_is_the_truth(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pose = rig.Pose(28.0, 20.0, 0.0, 0.0, 0.0, 0.0)
    synthetic.make_flight(tmp_path, 1, (320, 240), rng_seed=1)
    ground = paint_ground(rng, [pose], (320, 240))
    for spec in rig.BANDS:
        path = tmp_path / "0000SET" / "000" / f"IMG_0001_{spec.rig_index + 1}.tif"
        (band,) = MicaSense().bands(path, read_tags(path), probe(path))
        assert band.radiometry is not None
        assert band.radiometry.quantity == "reflectance"
        bright = np.full_like(ground.crop, 0.3 * max(spec.soil, spec.crop))
        raw = synthetic.render(bright, ground, spec, pose, (320, 240), rng)
        found = calibrated(raw, band.radiometry, 0, 0)
        np.testing.assert_allclose(np.median(found), bright[0, 0], rtol=0.01)
        # Vignetting is gone: the corners are as bright as the middle.
        assert np.median(found[:40, :40]) == pytest.approx(np.median(found[100:140, 140:180]), rel=0.02)


@pytest.mark.parametrize("missing", ["RadiometricCalibration", "ExposureTime", "ISOSpeed", "black"])
def test_without_its_tags_there_is_no_radiometry(tmp_path: Path, missing: str) -> None:
    synthetic.make_flight(tmp_path, 1, (320, 240), rng_seed=1)
    path = tmp_path / "0000SET" / "000" / "IMG_0001_1.tif"
    tags = read_tags(path)
    exif = {k: v for k, v in tags.exif.items() if missing not in k}
    xmp = {k: v for k, v in tags.xmp.items() if k[1] != missing}
    black = None if missing == "black" else tags.black_level
    (band,) = MicaSense().bands(
        path, Tags(**{**vars(tags), "exif": exif, "xmp": xmp, "black_level": black}), probe(path)
    )
    assert band.radiometry is None


def test_without_a_light_sensor_it_is_radiance(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path, 1, (320, 240), rng_seed=1)
    path = tmp_path / "0000SET" / "000" / "IMG_0001_1.tif"
    tags = read_tags(path)
    xmp = {k: v for k, v in tags.xmp.items() if k[0] != "micasense.com/DLS"}
    (band,) = MicaSense().bands(path, Tags(**{**vars(tags), "xmp": xmp}), probe(path))
    assert band.radiometry is not None
    assert band.radiometry.quantity == "radiance"
