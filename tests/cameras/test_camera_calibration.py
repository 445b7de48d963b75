"""Factors of the radiometric calibration that are missing, known twice, or of another camera."""

import math
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL.ExifTags import GPS as GPS_TAG

from agalign.batch.render import lost_reflectance
from agalign.cameras.consistency import far_from_flight
from agalign.cameras.discover import FolderScan, discover
from agalign.cameras.sun import sun_position
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, Entry, add_directories, byte_string, read_directories, text
from agalign.flight.groups import camera_overviews, flights_of
from agalign.pixels.radiometry import calibrated, with_radiometry
from agalign.rasters.aligned_files import _correction
from agalign.values.capture import Band, Capture, CaptureTime

from ..conftest import write_band
from .test_vendors import DJI, NAMESPACE, packet, write_file

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
FLIGHT_FOLDER = Path("0000SET", "000")


def changed(
    path: Path,
    *removed: str,
    put: Mapping[str, object] | None = None,
    exif: Mapping[int, Entry | None] | None = None,
    gps: Mapping[int, Entry | None] | None = None,
) -> None:
    """Change the tags of a file in place: remove XMP elements, put others (prefix:Name), replace or remove entries."""
    tags = read_directories(path)
    described = tags[0][XMP].data
    for name in (*removed, *(put or {})):
        described = re.sub(rf"<{name}>.*?</{name}>".encode(), b"", described, flags=re.DOTALL)
    more = "".join(f"<{name}>{value}</{name}>" for name, value in (put or {}).items())
    described = described.replace(b"</rdf:Description>", more.encode() + b"</rdf:Description>", 1)
    directories = [
        {tag: entry for tag, entry in (tags[key] | dict(other or {})).items() if entry is not None}
        for key, other in ((EXIF, exif), (GPS, gps))
    ]
    add_directories(path, {XMP: byte_string(described)}, *directories)


@pytest.fixture
def images(flight: Path, tmp_path: Path) -> Path:
    """The files of one synthetic capture."""
    folder = tmp_path / "images"
    folder.mkdir()
    for path in (flight / FLIGHT_FOLDER).glob("IMG_0001_*.tif"):
        shutil.copy(path, folder)
    return folder


def only(scan: FolderScan) -> Capture:
    (capture,) = scan.captures
    return capture


def nir(folder: Path) -> Band:
    return next(b for b in only(discover(folder)).bands if b.name == "NIR")


VIGNETTING = "Camera:VignettingCenter", "Camera:VignettingPolynomial"


@pytest.mark.parametrize("removed", [VIGNETTING, VIGNETTING[:1], VIGNETTING[1:]])
def test_a_band_without_a_factor_that_the_others_have_has_no_reflectance(
    images: Path, removed: tuple[str, ...]
) -> None:
    changed(images / "IMG_0001_4.tif", *removed)
    capture = only(discover(images))
    assert [b.name for b in capture.bands if b.radiometry is None] == ["NIR"]
    assert "its tags lack the vignetting, which other files of the camera have" in nir(images).missing_calibration


def test_a_band_without_the_irradiance_that_other_files_have_says_so(images: Path) -> None:
    """Otherwise, its capture would be radiance between others of reflectance, without a word."""
    changed(images / "IMG_0001_4.tif", "DLS:HorizontalIrradiance", "DLS:SpectralIrradiance", "Camera:Irradiance")
    assert nir(images).radiometry.by_sun is None
    assert nir(images).implausible == "its tags lack the irradiance, which other files of the camera have"
    capture = with_radiometry(only(discover(images)), "auto", {})
    assert (lost_reflectance(capture, "auto") or "").startswith("NIR: its tags lack")
    for path in images.iterdir():
        changed(path, "DLS:HorizontalIrradiance", "DLS:SpectralIrradiance", "Camera:Irradiance")
    assert not any(band.implausible for band in only(discover(images)).bands)


def test_a_factor_that_all_files_lack_is_named_with_its_size(images: Path) -> None:
    whole = nir(images).radiometry
    for path in images.iterdir():
        changed(path, *VIGNETTING)
    radiometry = nir(images).radiometry
    assert whole.uncorrected == ()
    assert radiometry.uncorrected == ("vignetting",)
    assert radiometry.std_percent == pytest.approx(math.hypot(whole.std_percent, 12.0))
    (overview,) = camera_overviews(discover(images).captures)
    assert "not corrected for vignetting" in overview.text


@pytest.mark.parametrize("value", ["nan", "1.#QNAN", "text", "0"])
def test_a_vignetting_that_is_no_number_is_missing(images: Path, value: str) -> None:
    changed(images / "IMG_0001_4.tif", put={VIGNETTING[1]: value})
    assert nir(images).radiometry is None


@pytest.mark.parametrize("missing", [33434, 34855, "MicaSense:RadiometricCalibration"])
def test_a_band_without_exposure_gain_or_coefficients_names_them(images: Path, missing: int | str) -> None:
    path = images / "IMG_0001_4.tif"
    if isinstance(missing, str):
        changed(path, put={missing: "nan"})
    else:
        changed(path, exif={missing: None})
    assert nir(images).radiometry is None
    assert nir(images).missing_calibration.startswith("no tag ")


# ---- the light sensor


def with_components(path: Path, *removed: str, **values: object) -> float:
    """Give a file the tags of a DLS 2; return the horizontal irradiance, W / m^2 / nm."""
    capture = only(discover(path.parent))
    time = CaptureTime.of(capture.captured_at)
    elevation, azimuth = sun_position(capture.position, time.utc.timestamp())
    tags = {"DirectIrradiance": 75.0, "ScatteredIrradiance": 5.0, "SpectralIrradiance": 80.0}
    tags |= {"HorizontalIrradiance": 75.0 * math.sin(elevation) + 5.0}
    tags |= {"SolarElevation": elevation, "SolarAzimuth": azimuth} | values
    changed(path, "DLS:HorizontalIrradiance", put={f"DLS:{k}": v for k, v in tags.items() if k not in removed})
    return (75.0 * math.sin(elevation) + 5.0) / 100


@pytest.mark.parametrize("removed", [(), ("HorizontalIrradiance",), ("DirectIrradiance",), ("SpectralIrradiance",)])
def test_the_irradiance_of_a_dls_2_is_that_of_its_components(images: Path, removed: tuple[str, ...]) -> None:
    expected = with_components(images / "IMG_0001_4.tif", *removed)
    assert nir(images).radiometry.irradiance == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", ["HorizontalIrradiance", "DirectIrradiance"])
def test_a_component_in_another_unit_does_not_count(images: Path, name: str) -> None:
    """The light in the plane of the sensor tells which of the two contradicting values is right."""
    expected = with_components(images / "IMG_0001_4.tif", **{name: 0.75})
    radiometry = nir(images).radiometry
    assert radiometry.irradiance == pytest.approx(expected, rel=1e-6)
    assert [e.name for e in radiometry.by_sun.errors if e.state == "contradicted"] == ["components of the irradiance"]


def test_components_that_all_contradict_each_other_are_not_used(images: Path) -> None:
    with_components(images / "IMG_0001_4.tif", HorizontalIrradiance=9.0, DirectIrradiance=1.0)
    assert nir(images).radiometry.by_sun is None
    assert "contradict each other" in nir(images).implausible


def with_dls_1(folder: Path, **values: object) -> None:
    tags = {"SpectralIrradiance": 0.8, "Yaw": 0.3, "Pitch": 0.2, "Roll": 0.1} | values
    for path in folder.iterdir():
        changed(path, "DLS:HorizontalIrradiance", put={f"DLS:{name}": value for name, value in tags.items()})


def test_a_tilt_that_cannot_be_corrected_is_named(images: Path) -> None:
    """Degrees and minutes suffice for the position of the sun."""
    with_dls_1(images)
    corrected = nir(images).radiometry
    for path in images.iterdir():
        numbers = read_directories(path)[GPS][GPS_TAG.GPSLatitude]
        seconds = numbers.data[:16] + bytes(8)  # 0/0
        changed(path, gps={GPS_TAG.GPSLatitude: replace(numbers, data=seconds)})
    scan = discover(images)
    assert nir(images).radiometry.irradiance == pytest.approx(corrected.irradiance, rel=1e-3)
    assert any("the seconds of its GPS position are not numbers" in p.text for p in scan.problems)
    assert only(scan).position is None
    for path in images.iterdir():
        changed(path, gps={GPS_TAG.GPSLatitude: None})
    assert nir(images).radiometry.by_sun.errors[-1].name == "tilt of the light sensor"
    assert nir(images).radiometry.by_sun.errors[-1].state == "missing"
    assert {e.state for e in corrected.by_sun.errors} == {"expected"}


@pytest.mark.parametrize("missing", ["Yaw", "Pitch", "Roll"])
def test_a_band_with_an_unknown_tilt_has_no_reflectance_by_the_sensor(images: Path, missing: str) -> None:
    with_dls_1(images)
    changed(images / "IMG_0001_4.tif", f"DLS:{missing}")
    capture = only(discover(images))
    assert [b.name for b in capture.bands if b.radiometry.by_sun is None] == ["NIR"]
    assert "tilt of the light sensor is not known" in nir(images).implausible


def test_a_light_sensor_whose_two_tags_differ_is_not_used(images: Path) -> None:
    with_dls_1(images, SpectralIrradiance=0.8)
    changed(images / "IMG_0001_4.tif", put={"Camera:Irradiance": 0.4})
    assert nir(images).radiometry.by_sun is None
    assert "contradict each other" in nir(images).implausible


# ---- position


def test_missing_letters_of_a_position_follow_from_the_sun(images: Path) -> None:
    true = only(discover(images)).position
    for path in images.iterdir():
        with_components(path)
    for path in images.iterdir():
        changed(path, gps={GPS_TAG.GPSLatitudeRef: None, GPS_TAG.GPSLongitudeRef: None})
    scan = discover(images)
    assert only(scan).position == true
    assert "its GPS tags lack N or S, or E or W: by the sun it is at 52.0000 N, 5.0000 E" in scan.problems[0].text


def test_without_the_sun_a_position_without_letters_is_not_used(images: Path) -> None:
    for path in images.iterdir():
        changed(path, gps={GPS_TAG.GPSLongitudeRef: None})
    scan = discover(images)
    assert only(scan).position is None
    assert "its GPS tags lack N or S, or E or W" in scan.problems[0].text
    assert "correct the tags" in scan.problems[0].text


# ---- files of one camera


def test_a_calibration_of_another_camera_is_named(images: Path) -> None:
    changed(images / "IMG_0001_4.tif", exif={}, put={"MicaSense:RadiometricCalibration": "2.0e-4, 0, 0"})
    for path in list(images.iterdir()):
        for number in ("0002", "0003"):
            other = images / path.name.replace("0001", number)
            shutil.copy(path, other)
            changed(other, put={"MicaSense:CaptureId": number})
    changed(images / "IMG_0002_4.tif", put={"MicaSense:RadiometricCalibration": "3.1e-4, 0, 0"})
    texts = [p.text for p in discover(images).problems]
    expected = "the calibration coefficient in its tags is 0.00031; 2 files of the camera have 0.0002; correct the tags"
    assert [t for t in texts if expected in t]


def test_a_black_level_that_differs_between_bands_is_named(images: Path) -> None:
    tags = read_directories(images / "IMG_0001_4.tif")
    add_directories(images / "IMG_0001_4.tif", {0xC61A: Entry(3, 1, b"\x00\x20")}, *(tags[key] for key in (EXIF, GPS)))
    texts = [p.text for p in discover(images).problems]
    assert [t for t in texts if "IMG_0001_4.tif: the black level in its tags is 8192" in t]


def phantom(
    folder: Path,
    number: int,
    tags: Mapping[str, str],
    serial: str = "",
    of_pix4d: bool = True,
    more: Mapping[str, str] | None = None,
) -> None:
    """Write the five bands of a capture of a Phantom 4, without a serial number in Exif."""
    folder.mkdir(parents=True, exist_ok=True)
    values = {"SensorGain": "1", "ExposureTime": "1000", "BlackLevel": "4096", "Irradiance": "5000"}
    values |= {"SensorGainAdjustment": "1.2", "VignettingData": "1e-5, 0, 0, 0, 0, 0", "CaptureUUID": f"c{number}"}
    values |= {"CalibratedOpticalCenterX": "800", "CalibratedOpticalCenterY": "650"} | (
        {"DroneID": serial} if serial else {}
    )
    twice = {"SunSensor": "5000", "BlackCurrent": "4096", "RadiometricCalibration": "1.2, 0, 0"} if of_pix4d else {}
    twice |= dict(more or {})
    for k in range(1, 6):
        own = {(DJI, name): (value,) for name, value in (values | dict(tags)).items() if value}
        own |= {(NAMESPACE, name): (value,) for name, value in twice.items()}
        path = folder / f"DJI_{number:03d}{k}.TIF"
        write_band(path, 64 * np.random.default_rng(k).integers(70, 1000, (1300, 1600)).astype(np.uint16))
        described = byte_string(packet(own, "attributes"))
        add_directories(path, {271: text("DJI"), 272: text("FC6360"), XMP: described}, {}, {})


@pytest.mark.parametrize("name", ["SensorGainAdjustment", "Irradiance"])
def test_a_factor_that_dji_writes_twice_may_be_missing_once(tmp_path: Path, name: str) -> None:
    phantom(tmp_path / "a", 1, {})
    phantom(tmp_path / "b", 1, {name: ""})
    one, other = (only(discover(tmp_path / folder)).bands[0].radiometry for folder in "ab")
    assert (other.gain, other.irradiance) == (one.gain, one.irradiance)
    assert other.uncorrected == ()


def test_a_factor_that_dji_writes_differently_twice_is_not_used(tmp_path: Path) -> None:
    phantom(tmp_path, 1, {"SensorGainAdjustment": "0.9"})
    band = only(discover(tmp_path)).bands[0]
    assert band.radiometry is None
    assert "other tags contradict SensorGainAdjustment" in band.missing_calibration


@pytest.mark.parametrize("gain", ["1", ""])
def test_corners_of_raw_numbers_of_dji_become_brighter(tmp_path: Path, gain: str) -> None:
    """DJI multiplies by the polynomial, also in a file that lacks tags for radiance."""
    k = "1e-5, 0, 0, 0, 0, 0"
    phantom(tmp_path, 1, {"SensorGain": gain}, more={"VignettingCenter": "800, 650", "VignettingPolynomial": k})
    band = only(discover(tmp_path)).bands[0]
    assert (band.radiometry is None) == (not gain)
    correction = _correction(band)
    raw = np.full((1, 1), correction.black_level + 1000)
    assert calibrated(raw, correction, 0, 650)[0, 0] == pytest.approx(1000 * (1 + 1e-5 * 800), rel=1e-6)


def test_a_missing_gain_adjustment_is_named_with_its_size(tmp_path: Path) -> None:
    phantom(tmp_path, 1, {"SensorGainAdjustment": ""}, of_pix4d=False)
    radiometry = only(discover(tmp_path)).bands[0].radiometry
    assert radiometry.uncorrected == ("sensor gain adjustment",)
    assert radiometry.std_percent > 40


@pytest.mark.parametrize("is_by_serial", [True, False])
def test_two_drones_of_a_model_are_two_flights(tmp_path: Path, is_by_serial: bool) -> None:
    """By serial numbers in XMP, or by the calibration of their lenses without any."""
    for number in (1, 2):
        centre = "1.5" if number == 1 else "2.5"
        tags = {} if is_by_serial else {"RelativeOpticalCenterX": centre, "RelativeOpticalCenterY": "0"}
        phantom(tmp_path, number, tags, f"drone{number}" if is_by_serial else "")
    captures = discover(tmp_path).captures
    assert len(flights_of(captures)) == 2
    assert len(camera_overviews(captures)) == 2
    phantom(tmp_path, 3, tags, "drone2" if is_by_serial else "")
    assert len(flights_of(discover(tmp_path).captures)) == 2


# ---- pixels that a program has changed


def test_raw_numbers_stored_as_signed_ones_are_refused(images: Path) -> None:
    for path in images.iterdir():
        tags = read_directories(path)
        pixels = tifffile.imread(path)
        pixels[:10] = 40000
        write_band(path, pixels.view(np.int16))
        add_directories(path, {t: tags[0][t] for t in (271, 272, XMP, 0xC61A)}, tags[EXIF], tags[GPS])
    scan = discover(images)
    assert not scan.captures
    assert all("raw numbers above 32767 were stored as signed ones" in p.text for p in scan.problems)
    assert len(scan.problems) == 5


@pytest.mark.parametrize("is_first", [False, True])
def test_a_constant_second_sample_is_not_a_band(images: Path, is_first: bool) -> None:
    for path in images.iterdir():
        tags, pixels = read_directories(path), tifffile.imread(path)
        constant = np.full_like(pixels, 65535)
        both = np.stack([constant, pixels] if is_first else [pixels, constant])
        tifffile.imwrite(path, both, planarconfig="separate", photometric="minisblack")
        add_directories(path, {t: tags[0][t] for t in (271, 272, XMP, 0xC61A)}, tags[EXIF], tags[GPS])
    scan = discover(images)
    assert [b.name for b in only(scan).bands] == ["Blue", "Green", "Red", "NIR", "Red edge"]
    (problem,) = scan.problems
    assert f"sample {1 if is_first else 2} of its pixels is constant" in problem.text


# ---- what firmware writes twice, and what all files of a capture share


@pytest.mark.parametrize(
    ("put", "text_"),
    [
        ({"Camera:BandSensitivity": "0.2"}, "and BandSensitivity 0.2 contradict each other"),
        ({"MicaSense:DarkRowValue": "3000, 3000, 3010, 3020"}, "its BlackLevel 4800 is above its DarkRowValue 3000"),
        ({"DLS:CenterWavelength": "717"}, "its CentralWavelength 840 and the CenterWavelength 717 of the light sensor"),
        ({"Camera:RigName": "Altum"}, "its Model RedEdge-M and RigName Altum contradict each other"),
        ({"Camera:VignettingCenter": "300, 180"}, ""),
    ],
)
def test_tags_that_contradict_each_other_are_named(images: Path, put: dict[str, str], text_: str) -> None:
    if "MicaSense:DarkRowValue" in put:
        tags = read_directories(images / "IMG_0001_4.tif")
        black = {0xC61A: Entry(3, 1, (4800).to_bytes(2, "little"))}
        add_directories(images / "IMG_0001_4.tif", black, tags[EXIF], tags[GPS])
    changed(images / "IMG_0001_4.tif", put=put)
    texts = [p.text for p in discover(images).problems]
    if text_:
        assert [t for t in texts if text_ in t]
    else:
        assert nir(images).radiometry is None
        assert "the vignetting has its centre" in nir(images).missing_calibration


def test_tags_that_agree_are_no_problem(images: Path) -> None:
    sensitivity = 3.8079e-5 / nir(images).radiometry.tags["calibration coefficient"]
    more = {"Camera:BandSensitivity": sensitivity, "DLS:CenterWavelength": 840, "Camera:RigName": "RedEdge-M"}
    changed(images / "IMG_0001_4.tif", put=more)
    assert discover(images).problems == ()


def test_a_gain_that_no_camera_has_is_named(images: Path) -> None:
    changed(images / "IMG_0001_4.tif", exif={34855: Entry(3, 1, (260).to_bytes(2, "little"))})
    assert "its sensor gain of 2.6 is not one of 1, 2, 4, 8" in discover(images).problems[0].text


def test_files_of_one_capture_share_position_and_serial_number(images: Path) -> None:
    latitude = read_directories(images / "IMG_0001_4.tif")[GPS][GPS_TAG.GPSLatitude]
    north = (53_000_000).to_bytes(4, "little") + (1_000_000).to_bytes(4, "little") + latitude.data[8:]
    changed(images / "IMG_0001_4.tif", gps={GPS_TAG.GPSLatitude: replace(latitude, data=north)})
    changed(images / "IMG_0001_3.tif", exif={0xA431: text("OTHER")})
    texts = [p.text for p in discover(images).problems]
    assert [t for t in texts if "IMG_0001_4.tif: its position is 111 km from that of the other files" in t]
    assert [t for t in texts if "IMG_0001_3.tif: its serial number OTHER is not that of the other files" in t]


@pytest.mark.parametrize(
    "serials",
    [("0A1 0B2 0C3",), ("0A1 0B2 -",), ("0A1 0B2 0C3",) * 2, ("A A A A A B", "A A A A A B B B B B")],
    ids=["one capture", "one without", "two captures", "dual"],
)
def test_bands_of_several_cameras_have_several_serial_numbers(tmp_path: Path, serials: tuple[str, ...]) -> None:
    """Of a rig with a camera for each band; of a dual camera, with files of the second half lost."""
    for number, of_capture in enumerate(serials):
        for k, serial in enumerate(of_capture.split()):
            exif = {} if serial == "-" else {0xA431: text(serial)}
            write_file(tmp_path / f"f{number}_{400 + 50 * k}nm.tif", {272: text("Rig")}, exif)
    assert not [p.text for p in discover(tmp_path).problems if "serial number" in p.text]


@pytest.mark.parametrize(
    ("apart_s", "degrees", "found"),
    [(1, 60.0, [3]), (1, 0.002, []), (7200, 0.5, []), (1, math.nan, [])],
    ids=["another drone's", "next line", "next field", "unknown"],
)
def test_a_capture_far_from_its_flight_is_named(flight: Path, apart_s: float, degrees: float, found: list[int]) -> None:
    first, captures = discover(flight).captures[0], []
    assert first.position is not None
    for k in range(6):
        bands = tuple(replace(b, path=Path(f"{k}.tif")) for b in first.bands)
        here = replace(first.position, latitude=10 + 0.0001 * k + (degrees if k == 3 else 0.0))
        at = f"{np.datetime64('2024-06-01T12:00:00') + np.timedelta64(int(apart_s * k), 's')}+00:00"
        place = here if math.isfinite(here.latitude) else None
        captures.append(replace(first, bands=bands, position=place, captured_at=at))
    problems = list(far_from_flight(captures))
    assert [int(p.path.stem) for p in problems] == found
    assert all("km from those of the captures around it; correct the tags" in p.text for p in problems)


@pytest.mark.parametrize("axis", [GPS_TAG.GPSLatitude, GPS_TAG.GPSLongitude])
def test_a_coordinate_of_zero_is_missing(images: Path, axis: int) -> None:
    for path in images.iterdir():
        entry = read_directories(path)[GPS][axis]
        zero = (bytes(4) + (1).to_bytes(4, "little")) * 3
        changed(path, gps={axis: replace(entry, data=zero)})
    assert only(discover(images)).position is None


@pytest.mark.parametrize(("reference", "sign"), [(0, 1), (1, -1), (2, 1), (3, -1)])
def test_the_sign_of_an_altitude_is_that_of_its_reference(images: Path, reference: int, sign: int) -> None:
    """0 and 1: above and below the ellipsoid (until Exif 2.3: sea level), 2 and 3: above and below sea level."""
    altitude_m = only(discover(images)).position.altitude_m
    for path in images.iterdir():
        changed(path, gps={GPS_TAG.GPSAltitudeRef: Entry(1, 1, bytes([reference]))})
    assert only(discover(images)).position.altitude_m == sign * altitude_m != 0


@pytest.mark.parametrize(
    ("tags", "of_pix4d", "named"),
    [
        ({"BandFreq": "840(+/-26)nm"}, {"CentralWavelength": "717"}, "CentralWavelength 717 and BandFreq 840"),
        ({}, {"RigName": "FC9999"}, "its Model FC6360 and RigName FC9999 contradict each other"),
        ({"BandFreq": "840(+/-26)nm"}, {"CentralWavelength": "840", "RigName": "FC6360"}, ""),
    ],
)
def test_facts_that_dji_writes_twice_are_compared(
    tmp_path: Path, tags: dict[str, str], of_pix4d: dict[str, str], named: str
) -> None:
    phantom(tmp_path, 1, tags, more=of_pix4d)
    texts = [p.text for p in discover(tmp_path).problems]
    found = [text for text in texts if "BandFreq" in text or "RigName" in text]
    assert [named in text for text in found] == ([True] if named else [])


def test_two_centres_of_the_vignetting_are_compared(tmp_path: Path) -> None:
    vignetting = {"VignettingCenter": "700, 650", "VignettingPolynomial": "1e-5, 0, 0, 0, 0, 0"}
    phantom(tmp_path, 1, {}, more=vignetting)
    assert "other tags contradict CalibratedOpticalCenter" in only(discover(tmp_path)).bands[0].missing_calibration
