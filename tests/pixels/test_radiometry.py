import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import agalign
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, byte_string, read_directories
from agalign.config import WriteSettings
from agalign.errors import InputError
from agalign.pixels.radiometry import calibrated, plausible, with_checked_pixels, with_radiometry
from agalign.pixels.raster import probe, read_tile
from agalign.records.run_record import read_run_record
from agalign.records.sidecar_file import read_sidecar
from agalign.values.capture import Band, Capture
from agalign.values.choices import RadiometryChoice
from agalign.values.radiometry import Radiometry, ReflectanceFactor

from ..builders import in_full_run
from ..conftest import seeded
from ..program import agalign_here
from ..run_outputs import table_in


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
def blue(flight: Path) -> Path:
    return next(flight.rglob("IMG_0001_1.tif"))


def with_tags(path: Path, **changes: object) -> Radiometry | None:
    """The radiometry of a file with changed tags."""
    (band,) = MicaSense().bands(path, Tags(**{**vars(read_tags(path)), **changes}), probe(path))
    return band.radiometry


def test_gain_and_row_gradient_are_those_of_the_tags(blue: Path) -> None:
    tags = read_tags(blue)
    xmp = {**tags.xmp, ("micasense.com/MicaSense", "RadiometricCalibration"): ("2e-4", "1e-7", "3e-5")}
    radiometry = with_tags(blue, xmp=xmp, exif={**tags.exif, "ExposureTime": 1e-3, "ISOSpeed": 400})
    assert (radiometry.gain, radiometry.row_gradient) == pytest.approx((2e-4 / 4 / 1e-3, 1e-7 / 1e-3 - 3e-5))


@pytest.mark.parametrize("missing", ["RadiometricCalibration", "ExposureTime", "ISOSpeed", "black"])
def test_without_its_tags_there_is_no_radiometry(blue: Path, missing: str) -> None:
    tags = read_tags(blue)
    exif = {k: v for k, v in tags.exif.items() if missing not in k}
    xmp = {k: v for k, v in tags.xmp.items() if k[1] != missing}
    black = None if missing == "black" else tags.black_level
    assert with_tags(blue, exif=exif, xmp=xmp, black_level=black) is None


def by(path: Path, choice: RadiometryChoice, factors: dict[str, float] | None = None) -> Band:
    """Return the band of a file with the chosen radiometry, by these factors of a panel and the light sensor."""
    by_panel = {
        name: ReflectanceFactor(value, source="panel and light sensor", panel_age_s=60.0)
        for name, value in (factors or {}).items()
    }
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


def test_photographs_and_thermal_bands_do_not_prevent_reflectance() -> None:
    green = Band("Green", Path("g.tif"), 1, 64, 48, "uint16", radiometry=Radiometry("radiance", 0.0, 1.0, 2.0))
    colour = Band("RGB Red", Path("c.jpg"), 1, 64, 48, "uint8", is_from_photograph=True)
    kelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)
    thermal = Band("LWIR", Path("t.tif"), 1, 160, 120, "uint16", radiometry=kelvin)
    for choice in ("auto", "panel"):
        by_panel = {"Green": ReflectanceFactor(3.0, source="panel", panel_age_s=0.0)}
        capture = with_radiometry(Capture("a", Path(), (green, colour, thermal), 0), choice, by_panel)
        assert [b.radiometry and b.radiometry.gain for b in capture.bands] == [6.0, None, 0.01]
    assert calibrated(np.full((2, 2), 30115, np.uint16), kelvin, 0, 0) == pytest.approx(28.0)
    assert (WriteSettings(radiometry=True).radiometry, WriteSettings(radiometry=False).radiometry) == ("auto", "off")


GOOD = Radiometry(
    "radiance",
    4800.0,
    65536.0,
    0.02,
    (640.0, 480.0),
    (1e-5, -2e-7),
    by_sun=ReflectanceFactor(math.pi, "reflectance"),
    tags={"exposure time (s)": 0.001, "sensor gain": 1.0, "calibration coefficient": 1.5e-4},
)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"tags": {"calibration coefficient": 1e300}}, "calibration coefficient of 1e+300"),
        ({"tags": {"exposure time (s)": 1.44}}, "exposure time (s) of 1.44"),  # of 1.44 ms
        ({"tags": {"sensor gain": -1.0}}, "sensor gain of -1"),
        ({"tags": {"gain adjustment": 1e-3}}, "gain adjustment"),
        ({"tags": {"factor of a new camera": math.inf}}, "factor of a new camera of inf"),
        ({"black_level": 30000.0}, "black level of 30000"),
        ({"black_level": -1.0}, "black level of -1"),
        ({"vignetting": (1e300,)}, "vignetting"),
        ({"vignetting_centre_px": (math.nan, 0.0)}, "vignetting"),
        ({"vignetting_centre_px": (320.0, 240.0)}, "vignetting centre (share of the image) of 0.25"),
        ({"row_gradient": -0.01}, "row gradient of -8.6"),
        ({"by_sun": ReflectanceFactor(math.pi / 1e-3, "reflectance")}, "irradiance (W / m^2 / nm) of 0.001"),
        ({"by_sun": ReflectanceFactor(math.pi / 1e4, "reflectance")}, "irradiance (W / m^2 / nm) of 10000"),
        ({"by_sun": ReflectanceFactor(1e3, "relative reflectance")}, "relative irradiance of 0.001"),
        ({"by_sun": ReflectanceFactor(1e-7, "relative reflectance")}, "relative irradiance of 1e+07"),
    ],
)
def test_a_calibration_with_an_implausible_tag_is_not_used(change: dict[str, object], named: str) -> None:
    """Without a plausible irradiance it is radiance."""
    known = (math.pi / 0.02, "reflectance"), (math.pi / 1.9, "reflectance"), (1 / 500, "relative reflectance")
    for by_sun in (ReflectanceFactor(*one) for one in known):
        assert plausible(replace(GOOD, by_sun=by_sun), (1280, 960)) == (replace(GOOD, by_sun=by_sun), "")
    of_new_camera = replace(GOOD, tags={"factor of a new camera": -2.0})
    assert plausible(of_new_camera, (1280, 960)) == (of_new_camera, "")
    result, problem = plausible(replace(GOOD, **change), (1280, 960))
    assert result == (replace(GOOD, by_sun=None) if "irradiance" in named else None)
    assert problem.startswith(f"the {named}")


def test_the_means_of_cells_are_calibrated_and_corrected_for_vignetting(tmp_path: Path) -> None:
    y, x = np.mgrid[:480, :640]
    ground = np.where(x < 320, 0.1, 0.4)
    falloff = 1.0 + 1e-3 * np.hypot(x - 320, y - 240)
    for name, exposure, is_bright in (("bright", 1.0, True), ("dark", 0.1, False)):
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, np.round(4800 + 65536 * exposure * ground / falloff).astype(np.uint16))
        model = Radiometry(
            "reflectance", 4800.0, 65536.0, 1 / exposure, (320.0, 240.0), (1e-3,), vignetting_divides=False
        )
        means = np.array(
            with_checked_pixels(replace(probe(path)[0], radiometry=model), read_tile).radiometry.cell_means
        )
        assert means.shape == ((12, 16) if is_bright else (0,))
        if is_bright:
            np.testing.assert_allclose(means, np.broadcast_to(np.repeat((0.1, 0.4), 8), (12, 16)), rtol=0.02)


def test_pixels_that_do_not_fit_the_calibration_are_refused(tmp_path: Path) -> None:
    def check(raw: int, black: float, gain: float) -> list[str]:
        path = tmp_path / "a.tif"
        tifffile.imwrite(path, (raw + np.random.default_rng(0).integers(-50, 50, (60, 80))).astype(np.uint16))
        band = replace(probe(path)[0], radiometry=Radiometry("reflectance", black, 65536.0, gain))
        return [error.name for error in with_checked_pixels(band, read_tile).radiometry.errors]

    crop, water_in_near_infrared, snow = (20000, 4800.0, 1.0), (4700, 4800.0, 1.0), (60000, 4800.0, 1.3)
    assert check(*crop) == check(*water_in_near_infrared) == []
    assert check(*snow) == ["reflectance above 1"]
    with pytest.raises(InputError, match="black level of 16000 is above its pixels"):
        check(9000, 16000.0, 1.0)
    with pytest.raises(InputError, match="median reflectance of 3"):  # a shaded light sensor
        check(30000, 4800.0, 8.0)


def with_irradiance(flight: Path, folder: Path, irradiance: bytes) -> Path:
    """Copy a flight into a folder, and replace the irradiance in the tags of a band of the second capture."""
    shutil.copytree(flight, folder)
    path = folder / "0000SET" / "000" / "IMG_0002_4.tif"
    tags = read_directories(path)
    packet = re.sub(rb"(?<=<DLS:HorizontalIrradiance>)[^<]+", irradiance, tags[0][XMP].data)
    add_directories(path, {XMP: byte_string(packet)}, tags[EXIF], tags[GPS])
    return folder


@pytest.mark.parametrize(
    ("irradiance", "choice", "text"),
    [
        (b"0.001", "sun", r"light sensor in NIR \(the irradiance .* of 1e-05 is not within 0"),
        (b"0.6", "auto", "IMG_0002_4.tif: its median reflectance of .* is above 2"),
    ],
)
def test_a_capture_with_an_implausible_tag_is_not_written(
    flight: Path, tmp_path: Path, irradiance: bytes, choice: RadiometryChoice, text: str
) -> None:
    folder = with_irradiance(flight, tmp_path / "in", irradiance)
    reports = agalign.align_folder(folder, tmp_path / "out", settings=seeded(radiometry=choice))
    assert [r.state for r in reports] == ["done", "error"]
    assert reports[0].problems == ()
    (problem,) = reports[1].problems
    assert re.search(text, problem)


@pytest.mark.parametrize(
    ("irradiance", "text"),
    [
        (b"0.001", "NIR: the irradiance .* of 1e-05"),
        in_full_run(b"-80", "NIR: HorizontalIrradiance is negative"),
        in_full_run(b"1e-320", "NIR: the irradiance .* of 9.88131e-323 is"),
    ],
)
def test_radiance_instead_of_reflectance_is_the_same_caution_in_every_command(
    flight: Path, tmp_path: Path, irradiance: bytes, text: str
) -> None:
    folder, out = with_irradiance(flight, tmp_path / "in", irradiance), tmp_path / "out"
    cause = "radiance, not reflectance: the tags of the light sensor cannot be used"
    run = folder, "-o", out, "--seed", "rig", "--only-seed", "--radiometry", "auto"
    for command in (run, run, ("report", out), ("verify", out)):
        done = agalign_here(*command)
        assert done.returncode == (3 if command is run else 0), done.stderr
        assert (cause in done.stderr) == (command[0] != "verify")
        assert "resumes" not in done.stderr
        assert read_run_record(out).problems == []
        checks = {(row["capture"], row["band"]): row["check"] for row in table_in(out / "summary.csv")}
        assert all(bool(re.search(text, check)) == (key[0] == "IMG_0002") for key, check in checks.items())
    sidecars = [read_sidecar(out / "0000SET" / "000" / f"IMG_000{number}.json") for number in (1, 2)]
    written = [sidecar.output.radiometry for sidecar in sidecars]
    assert written == ["reflectance by light sensor", "radiance by camera calibration"]
