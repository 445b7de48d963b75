import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile

import agalign
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, byte_string, read_directories, short
from agalign.config import WriteSettings
from agalign.errors import InputError
from agalign.pixels.radiometry import calibrated, check_pixels, plausible, with_radiometry
from agalign.pixels.raster import probe
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import paint_ground
from agalign.values.capture import Band, Capture, PanelFactor, Quantity, Radiometry
from agalign.values.choices import RadiometryChoice

from ..conftest import seeded


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
    pose = cameras.Pose(28.0, 20.0, 0.0, 0.0, 0.0, 0.0)
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


GOOD = Radiometry(
    "radiance",
    4800.0,
    65536.0,
    0.02,
    (640.0, 480.0),
    (1e-5, -2e-7),
    by_sun=(math.pi, "reflectance"),
    tags={"exposure time (s)": 0.001, "sensor gain": 1.0, "calibration coefficient": 1.5e-4},
)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"tags": {"calibration coefficient": 1e300}}, "calibration coefficient of 1e+300"),
        ({"tags": {"exposure time (s)": 1.44}}, "exposure time (s) of 1.44"),  # of 1.44 ms
        ({"tags": {"sensor gain": -1.0}}, "sensor gain of -1"),
        ({"tags": {"gain adjustment": 1e-3}}, "gain adjustment"),
        ({"black_level": 30000.0}, "black level of 30000"),
        ({"black_level": -1.0}, "black level of -1"),
        ({"vignetting": (1e300,)}, "vignetting"),
        ({"vignetting_centre_px": (math.nan, 0.0)}, "vignetting"),
        ({"vignetting_centre_px": (320.0, 240.0)}, "vignetting centre (share of the image) of 0.25"),
        ({"row_gradient": -0.01}, "row gradient of -8.6"),
    ],
)
def test_a_calibration_with_an_implausible_tag_is_not_used(change: dict[str, object], named: str) -> None:
    assert plausible(GOOD, (1280, 960)) == (GOOD, "")
    result, problem = plausible(replace(GOOD, **change), (1280, 960))
    assert result is None
    assert problem.startswith(f"the {named}")


@pytest.mark.parametrize(
    ("irradiance", "quantity", "is_plausible"),
    [
        (0.02, "reflectance", True),
        (1.9, "reflectance", True),
        (1e-3, "reflectance", False),
        (1e4, "reflectance", False),
        (500.0, "relative reflectance", True),
        (1e-3, "relative reflectance", False),
        (1e7, "relative reflectance", False),
    ],
)
def test_an_implausible_irradiance_leaves_radiance(irradiance: float, quantity: Quantity, is_plausible: bool) -> None:
    scale = math.pi if quantity == "reflectance" else 1.0
    radiometry = replace(GOOD, by_sun=(scale / irradiance, quantity))
    result, problem = plausible(radiometry, (1280, 960))
    assert result == (radiometry if is_plausible else replace(radiometry, by_sun=None))
    assert ("irradiance" in problem) == (not is_plausible)


@pytest.mark.parametrize(
    ("scene", "raw", "black", "gain", "message"),
    [
        ("crop", 20000, 4800.0, 1.0, None),
        ("water in the near infrared", 4700, 4800.0, 1.0, None),
        ("snow", 60000, 4800.0, 1.3, None),
        ("a black level above the pixels", 9000, 16000.0, 1.0, "black level of 16000 is above its pixels"),
        ("a shaded light sensor", 30000, 4800.0, 8.0, "median reflectance of 3.0"),
    ],
)
def test_pixels_that_do_not_fit_the_calibration_are_refused(
    tmp_path: Path, scene: str, raw: int, black: float, gain: float, message: str | None
) -> None:
    path = tmp_path / f"{scene}.tif"
    tifffile.imwrite(path, (raw + np.random.default_rng(0).integers(-50, 50, (60, 80))).astype(np.uint16))
    (stored,) = probe(path)
    band = replace(stored, radiometry=Radiometry("reflectance", black, 65536.0, gain))
    if message is None:
        check_pixels(band)
    else:
        with pytest.raises(InputError, match=message):
            check_pixels(band)


def edited(flight: Path, folder: Path, tag: str) -> Path:
    """A copy of a flight in which a band of the second capture has a damaged tag."""
    shutil.copytree(flight, folder)
    path = folder / "0000SET" / "000" / "IMG_0002_4.tif"
    directories = read_directories(path)
    first = {50714: short(16000)} if tag == "black level" else {}
    if tag == "black level":
        with rasterio.open(path, "r+") as file:
            file.write(file.read() // 2)
    else:
        packet = re.sub(rb"(?<=<DLS:HorizontalIrradiance>)[^<]+", b"0.001", directories[0][XMP].data)
        first = {XMP: byte_string(packet)}
    add_directories(path, first, directories[EXIF], directories[GPS])
    return folder


@pytest.mark.parametrize(
    ("tag", "choice", "states", "text"),
    [
        (
            "irradiance",
            "sun",
            ["done", "error"],
            r"light sensor in NIR \(the irradiance .* of 1e-05 is not within 0.005",
        ),
        ("irradiance", "auto", ["done", "done"], "not written as reflectance: NIR: the irradiance .* of 1e-05"),
        ("black level", "auto", ["done", "error"], "IMG_0002_4.tif: its black level of 16000 is above its pixels"),
    ],
)
def test_a_capture_with_an_implausible_tag_is_not_written_as_reflectance(
    flight: Path, tmp_path: Path, tag: str, choice: RadiometryChoice, states: list[str], text: str
) -> None:
    folder = edited(flight, tmp_path / "in", tag)
    reports = agalign.align_folder(folder, tmp_path / "out", settings=seeded(radiometry=choice))
    assert [r.state for r in reports] == states
    assert reports[0].problems == ()
    (problem,) = reports[1].problems
    assert re.search(text, problem)
    written = [r.result.output.radiometry for r in reports if r.result]
    assert written == ["reflectance by light sensor", "radiance by camera calibration"][: len(written)]
