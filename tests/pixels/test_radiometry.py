import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.config import WriteSettings
from agalign.pixels.radiometry import calibrated, is_physical, with_radiometry
from agalign.pixels.raster import probe
from agalign.synthetic import camera_model, cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import paint_ground
from agalign.values.capture import Band, Capture, PanelFactor, Radiometry
from agalign.values.choices import RadiometryChoice


def test_every_term_of_the_calibration_is_applied() -> None:
    radiometry = Radiometry("radiance", 1000.0, 65536.0, 2.0, (3.0, 4.0), (0.1, 0, 0, 0, 0, 0), True, 0.01)
    raw = np.full((10, 12), 3000, np.uint16)
    result = calibrated(raw, radiometry, 0, 0)
    signal = 2.0 * 2000 / 65536
    assert result[4, 3] == pytest.approx(signal / 1.04, rel=1e-6)
    assert result[4, 8] == pytest.approx(signal / 1.5 / 1.04, rel=1e-6)
    assert result[9, 3] == pytest.approx(signal / 1.5 / 1.09, rel=1e-6)
    times = calibrated(raw, replace(radiometry, vignetting_divides=False), 0, 0)
    assert times[4, 8] == pytest.approx(signal * 1.5 / 1.04, rel=1e-6)


def test_a_calibrated_window_equals_a_part_of_the_image() -> None:
    radiometry = Radiometry("radiance", 1000.0, 65536.0, 2.0, (30.0, 20.0), (1e-3, -1e-5, 0, 0, 0, 0), True, 0.001)
    raw = np.random.default_rng(0).integers(2000, 60000, (50, 60)).astype(np.uint16)
    whole = calibrated(raw, radiometry, 0, 0)
    np.testing.assert_allclose(calibrated(raw[10:30, 20:50], radiometry, 20, 10), whole[10:30, 20:50], rtol=1e-6)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images of a synthetic capture."""
    folder = tmp_path_factory.mktemp("radiometry")
    synthetic.make_flight(folder, 1, (320, 240), rng_seed=1)
    return folder / "0000SET" / "000"


@pytest.fixture(scope="module")
def blue(images: Path) -> Path:
    return images / "IMG_0001_1.tif"


def test_reflectance_of_the_synthetic_flight_is_the_truth(images: Path) -> None:
    rng = np.random.default_rng(1)
    pose = camera_model.Pose(28.0, 20.0, 0.0, 0.0, 0.0, 0.0)
    ground = paint_ground(rng, [pose], (320, 240))
    for spec in cameras.BANDS:
        band = by(images / f"IMG_0001_{spec.rig_index + 1}.tif", "sun")
        assert band.radiometry.quantity == "reflectance"
        bright = np.full_like(ground.crop, 0.3 * max(spec.soil, spec.crop))
        raw = synthetic.recorded(synthetic.view(bright, ground, spec, pose, (320, 240)), spec, rng)
        result = calibrated(raw, band.radiometry, 0, 0)
        np.testing.assert_allclose(np.median(result), bright[0, 0], rtol=0.01)
        # Vignetting is removed: the corners are as bright as the centre.
        assert np.median(result[:40, :40]) == pytest.approx(np.median(result[100:140, 140:180]), rel=0.02)


def with_tags(path: Path, **changes: object) -> Radiometry | None:
    """The radiometry of a file with changed tags."""
    (band,) = MicaSense().bands(path, Tags(**{**vars(read_tags(path)), **changes}), probe(path))
    return band.radiometry


@pytest.mark.parametrize("missing", ["RadiometricCalibration", "ExposureTime", "ISOSpeed", "black"])
def test_without_its_tags_there_is_no_radiometry(blue: Path, missing: str) -> None:
    tags = read_tags(blue)
    exif = {k: v for k, v in tags.exif.items() if missing not in k}
    xmp = {k: v for k, v in tags.xmp.items() if k[1] != missing}
    black = None if missing == "black" else tags.black_level
    assert with_tags(blue, exif=exif, xmp=xmp, black_level=black) is None


@pytest.mark.parametrize("value", [None, "-5", "0", "nan"])
def test_without_a_plausible_light_sensor_it_is_radiance(blue: Path, value: str | None) -> None:
    xmp = {k: v for k, v in read_tags(blue).xmp.items() if value or k[0] != "micasense.com/DLS"}
    if value is not None:
        xmp["micasense.com/DLS", "HorizontalIrradiance"] = (value,)
    radiometry = with_tags(blue, xmp=xmp)
    assert (radiometry.quantity, radiometry.by_sun) == ("radiance", None)


def by(path: Path, choice: RadiometryChoice, factors: dict[str, float] | None = None) -> Band:
    """Return the band of a file with the chosen radiometry, by these factors of a panel and the light sensor."""
    by_panel = {name: PanelFactor(value, "panel and light sensor", 60.0) for name, value in (factors or {}).items()}
    bands = MicaSense().bands(path, read_tags(path), probe(path))
    return with_radiometry(Capture("IMG_0001", Path(), bands, 0), choice, by_panel).bands[0]


def test_the_chosen_radiometry_is_applied(blue: Path) -> None:
    raw, camera, sun = (by(blue, choice).radiometry for choice in ("off", "camera", "sun"))
    assert raw == camera
    assert (camera.quantity, sun.quantity) == ("radiance", "reflectance")
    assert (camera.source, sun.source) == ("camera calibration", "light sensor")
    assert sun.gain == pytest.approx(camera.gain * np.pi / 0.8)
    panel = by(blue, "panel", {"Blue": 2.5}).radiometry
    assert (panel.source, panel.panel_age_s) == ("panel and light sensor", 60.0)
    assert (panel.quantity, panel.gain) == ("reflectance", pytest.approx(2.5 * camera.gain))
    assert by(blue, "panel", {"Green": 2.5}).radiometry is None
    assert by(blue, "auto", {"Blue": 2.5}).radiometry == panel
    assert by(blue, "auto").radiometry == sun


def test_rgb_companions_do_not_prevent_reflectance() -> None:
    green = Band("Green", Path("g.tif"), 1, 64, 48, "uint16", radiometry=Radiometry("radiance", 0.0, 1.0, 2.0))
    colour = Band("RGB Red", Path("c.jpg"), 1, 64, 48, "uint8", companion=True)
    capture = with_radiometry(
        Capture("a", Path(), (green, colour), 0), "auto", {"Green": PanelFactor(3.0, "panel", 0.0)}
    )
    assert [b.radiometry and b.radiometry.gain for b in capture.bands] == [6.0, None]
    assert (WriteSettings(radiometry=True).radiometry, WriteSettings(radiometry=False).radiometry) == ("auto", "off")


def test_thermal_bands_are_not_converted() -> None:
    kelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)
    band = Band("LWIR", Path("IMG_0001_6.tif"), 1, 160, 120, "uint16", radiometry=kelvin)
    for choice in ("auto", "camera", "sun", "panel"):
        (result,) = with_radiometry(Capture("IMG_0001", Path(), (band,), 0), choice, {}).bands
        assert result.radiometry == kelvin
    assert calibrated(np.full((2, 2), 30115, np.uint16), kelvin, 0, 0) == pytest.approx(28.0)


@pytest.mark.parametrize(
    "change",
    [
        {"gain": 1e300},
        {"gain": -1.0},
        {"gain": math.nan},
        {"full_scale": 0.0},
        {"black_level": math.inf},
        {"by_sun": (-5.0, "reflectance")},
        {"vignetting": (10.0,)},
        {"vignetting": (1e300,)},
        {"vignetting_centre_px": (math.nan, 0.0)},
        {"row_gradient": -0.01},
    ],
)
def test_implausible_calibrations_are_rejected(change: dict[str, object]) -> None:
    good = Radiometry("radiance", 4800.0, 65536.0, 0.02, (640.0, 480.0), (1e-5, -2e-7))
    assert is_physical(good, (1280, 960))
    assert not is_physical(replace(good, **change), (1280, 960))
