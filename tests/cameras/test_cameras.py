"""Cameras: which of them recognises a file, its lenses, and what its rig tags mean."""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from agalign.cameras import dls, read_files
from agalign.cameras.base import default_reference
from agalign.cameras.discover import discover
from agalign.cameras.dls import horizontal_irradiance, transmission
from agalign.cameras.generic import Generic
from agalign.cameras.makers import known_cameras
from agalign.cameras.mapir import Mapir
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.pix4d import NAMESPACE, panel_in
from agalign.cameras.sun import sun_position
from agalign.cameras.tag_seeds import rig_seed
from agalign.errors import ConfigurationError
from agalign.pixels.raster import probe
from agalign.synthetic import cameras
from agalign.values import geometry
from agalign.values.capture import Band, CaptureTime, Position


def test_lenses_and_rig_of_the_synthetic_camera_are_its_truth(flight: Path) -> None:
    """The rig's mapping is that of a capture from very high, where parallax vanishes."""
    bands = {}
    for path in sorted((flight / "0000SET" / "000").glob("IMG_0001_*.tif")):
        (band,) = MicaSense().bands(path, read_tags(path), probe(path))
        bands[band.name] = band
    far = cameras.Pose(1e4, 0.0, 0.0, 0.0, 0.0, 0.0)
    for spec in cameras.BANDS:
        expected, result = spec.lens(480, 360), bands[spec.name].lens
        np.testing.assert_allclose(result.matrix, expected.matrix, atol=1e-4)
        np.testing.assert_allclose(result.distortion, expected.distortion)
        truth = cameras.true_homography(cameras.BANDS[cameras.REFERENCE], spec, far, (480, 360))
        assert geometry.corner_error_px(rig_seed(bands["Green"], bands[spec.name]), truth, 480, 360) < 0.01


MICASENSE, SENTERA = "micasense.com/MicaSense", "sentera.com"
STORED = (Band("", Path("IMG_0001_4.tif"), 1, 1280, 960, "uint16"),)


def tags(**camera: str) -> Tags:
    exif = {"FocalPlaneXResolution": 266.666667, "FocalPlaneResolutionUnit": 4, "FocalLength": 5.5}
    return Tags(make="MicaSense", xmp={(NAMESPACE, k): (v,) for k, v in camera.items()}, exif=exif)


@pytest.mark.parametrize("rig", ["", "a, b, c", "1.0, 2.0", "inf"])
def test_malformed_rig_tags_leave_the_principal_points(rig: str) -> None:
    both = [tags(PerspectiveFocalLength="5.45", PrincipalPoint=p, RigRelatives=rig) for p in ("2.4,1.8", "2.5,1.8")]
    (one,), (other,) = (MicaSense().bands(Path("IMG_0001_4.tif"), t, STORED) for t in both)
    seed = rig_seed(one, other)
    np.testing.assert_allclose(seed, geometry.translation(26.6666667, 0), atol=1e-9)


@pytest.mark.parametrize(
    ("tags", "name"),
    [
        (Tags(xmp={(MICASENSE, "CaptureId"): ("a",)}), "MicaSense"),
        (Tags(xmp={(NAMESPACE, "RigName"): ("Sequoia",)}), "Parrot Sequoia"),
        (Tags(xmp={(SENTERA, "AlignMatrix"): ("1",)}), "Sentera"),
        (Tags(make="MAPIR"), "MAPIR"),
    ],
)
def test_which_camera_recognises_which_tags(tags: Tags, name: str) -> None:
    assert next(c for c in known_cameras() if c.recognises(tags)).name == name


def test_a_pattern_is_above_all_cameras() -> None:
    assert [c.name for c in known_cameras("{capture}_{band}.tif")] == ["generic"]


def test_pattern() -> None:
    generic = Generic("cap{capture}-of-{band}.tif")
    assert generic.split(Path("cap12-of-X.tif")) == ("12", "X")
    assert generic.split(Path("other.tif")) == ("other", "")
    for bad in ("{capture}.tif", "{band}", "x", "{capture}{capture}{band}"):
        with pytest.raises(ConfigurationError, match="pattern"):
            Generic(bad)


def test_default_reference() -> None:
    def band(name: str, wavelength: float | None = None) -> Band:
        return Band(name, Path("x"), 1, 1, 1, "uint8", wavelength_nm=wavelength)

    assert default_reference([band("Blue"), band("Green-560"), band("NIR")]) == 1
    assert default_reference([band("BLU"), band("GRN"), band("NIR")]) == 1
    assert default_reference([band("band_1", 840), band("band_2", 560), band("band_3", 475)]) == 1
    assert default_reference([band("LWIR", 11000), band("Red", 668)]) == 1
    assert default_reference([band("a"), band("b")]) == 0
    # Thermal is never it, also where no other band's wavelength is known.
    assert default_reference([band("LWIR", 11000), band("a"), band("b")]) == 1
    assert default_reference([band("band_1", 11000), band("band_2")]) == 1


def test_an_alpha_band_that_is_not_the_last_shifts_no_index(tmp_path: Path) -> None:
    path = tmp_path / "survey.tif"
    with rasterio.open(path, "w", driver="GTiff", width=80, height=64, count=4, dtype="uint8") as file:
        file.colorinterp = [ColorInterp.gray, ColorInterp.alpha, ColorInterp.undefined, ColorInterp.undefined]
    result = Mapir().bands(path, Tags(make="MAPIR", model="Survey3"), probe(path))
    assert [(b.name, b.band_index) for b in result] == [("band_1", 1), ("band_3", 3), ("band_4", 4)]
    result = Generic().bands(path, Tags(make="MAPIR", model="Survey3W_RGN"), probe(path))
    assert [(b.name, b.band_index) for b in result] == [("Red", 1), ("NIR", 3)]


@pytest.mark.parametrize(("model", "name"), [("Survey3W_RE", "RE"), ("Survey3W", "band_1")])
def test_a_survey3_file_of_one_band_has_the_name_of_its_filter(tmp_path: Path, model: str, name: str) -> None:
    stored = Band("", tmp_path / "2021_0827_193517_009.tif", 1, 80, 64, "uint8")
    (band,) = Mapir().bands(stored.path, Tags(make="MAPIR", model=model), (stored,))
    assert band.name == name


# ---- MicaSense


def test_thermal_bands_count_in_hundredths_of_a_kelvin() -> None:
    (band,) = MicaSense().bands(Path("IMG_0001_6.tif"), tags(BandName="LWIR", CentralWavelength="11000"), STORED)
    assert (band.radiometry.quantity, band.radiometry.gain) == ("temperature", 0.01)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"CalibrationPicture": "2", "Albedo": "0.51", "ReflectArea": "40,10,20,10,20,30,40,30"}, (0.51, 4)),
        ({"CalibrationPicture": "1", "ReflectArea": "40,10,20,10,20,30,4000,30"}, (None, 0)),
        ({"ReflectArea": "40,10,20,10,20,30,40,30"}, (None, 4)),
        ({"CalibrationPicture": "2", "Albedo": "51", "ReflectArea": "1,2,3"}, (None, 0)),
        ({"CalibrationPicture": "0", "ReflectArea": "40,10,20,10,20,30,40,30"}, None),
        ({"ReflectArea": "0,0,0,0,0,0,0,0"}, None),
        ({"ReflectArea": "40,10,20,10,20,30,4000,30"}, None),
        ({"Albedo": "0.5"}, None),
    ],
)
def test_panels_as_firmware_writes_them(values: dict[str, str], expected: tuple[float | None, int] | None) -> None:
    """None: not a panel."""
    result = panel_in(tags(**values), (64, 48))
    assert (result and (result.albedo, len(result.corners_px))) == expected


# ---- the light sensor of MicaSense


SCALE = "IrradianceScaleToSIUnits"
DLS, NOON = "micasense.com/DLS", "2003-10-17T19:30:30"
GOLDEN = Position(39.742476, -105.1786, 1830.14)


def test_position_of_the_sun_equals_the_example_of_nrel() -> None:
    """Reda & Andreas 2004 (NREL/TP-560-34302), appendix A.5: elevation 39.872046 degrees before refraction."""
    elevation, azimuth = map(math.degrees, sun_position(GOLDEN, CaptureTime.of(NOON).utc.timestamp()))
    assert elevation == pytest.approx(39.872046, abs=0.01)
    assert azimuth == pytest.approx(194.340241, abs=0.01)


def test_the_window_transmits_less_at_a_grazing_angle() -> None:
    normal = (1 - ((1.6 - 1.000277) / 2.600277) ** 2) * (1 - (0.22 / 2.98) ** 2)
    assert transmission(0.0) == pytest.approx(normal)
    assert transmission(math.radians(40)) == pytest.approx(normal, rel=0.01)
    assert transmission(math.radians(80)) < 0.75 * normal


def irradiance(
    path: Path, values: dict[str, float], position: Position | None = GOLDEN, captured_at: str = NOON
) -> float | None:
    """The irradiance by a file's light sensor, with other values in its tags."""
    tags = vars(read_tags(path))
    xmp = {k: v for k, v in tags["xmp"].items() if k[0] != DLS} | {(DLS, k): (str(v),) for k, v in values.items()}
    changed = Tags(**tags | {"xmp": xmp, "position": position, "captured_at": captured_at})
    (band,) = MicaSense().bands(path, changed, probe(path))
    return band.radiometry.by_sun and math.pi / band.radiometry.by_sun.value


def test_irradiance_in_the_plane_of_the_sensor_is_corrected_for_its_tilt(flight: Path) -> None:
    """By the published model with direct = 6 diffuse; `lean` is towards the sun."""
    path = next(flight.rglob("IMG_0001_1.tif"))
    elevation, azimuth = sun_position(GOLDEN, CaptureTime.of(NOON).utc.timestamp())
    lean = math.radians(19)
    # Level; nose down towards the sun and away from it; the right side down, and the sun to the right and to the left.
    attitudes = (0, 0, 0, 0), (0, -lean, 0, lean), (0, lean, 0, -lean), (-90, 0, lean, lean), (90, 0, lean, -lean)
    for turn_deg, pitch, roll, towards_sun in attitudes:
        angle = math.pi / 2 - elevation - towards_sun
        measured = (1.2 * math.cos(angle) + 0.2) * transmission(angle)
        yaw = azimuth + math.radians(turn_deg)
        tags = {"SpectralIrradiance": measured, "Yaw": yaw, "Pitch": pitch, "Roll": roll}
        assert irradiance(path, tags) == pytest.approx(1.2 * math.sin(elevation) + 0.2)
        # Without a place or with a clock that was not set, the position of the sun is unknown.
        assert irradiance(path, tags, position=None) == pytest.approx(measured)
        assert irradiance(path, tags, captured_at="1970-01-01T19:30:30") == pytest.approx(measured)
    away, leaning = {"SpectralIrradiance": 0.2, "Pitch": 2.6}, {"SpectralIrradiance": 0.2, "Pitch": 0.5}
    for damaged in (away, leaning, {"HorizontalIrradiance": "1e-300", SCALE: "1e-300"}):
        assert irradiance(path, {"Yaw": azimuth, "Roll": 0.0} | damaged) is None
    assert math.isnan(horizontal_irradiance(0.2, (180, -5, 0), (math.radians(-3), math.pi)))  # the sun has set
    assert irradiance(path, {"HorizontalIrradiance": 120.0, SCALE: -0.01}) == pytest.approx(1.2)  # the usual scale
    for value, scale in ((-5, 0.01), (0, 0.01), ("nan", 0.01)):
        assert irradiance(path, {"HorizontalIrradiance": value, SCALE: scale}) is None
    assert irradiance(path, {}) is None


@pytest.mark.parametrize(("error", "expected"), [(1.0, 1.0), (1.004, 1.004), (1.2, 1.0)])
def test_a_horizontal_irradiance_that_contradicts_its_components_is_replaced(
    flight: Path, error: float, expected: float
) -> None:
    path = next(flight.rglob("IMG_0001_1.tif"))
    elevation, _ = sun_position(GOLDEN, CaptureTime.of(NOON).utc.timestamp())
    horizontal = 120.0 * math.sin(elevation) + 15.0
    tags = {"HorizontalIrradiance": horizontal * error, "DirectIrradiance": 120.0, "ScatteredIrradiance": 15.0}
    assert irradiance(path, tags) == pytest.approx(horizontal / 100 * expected)
    assert irradiance(path, tags, position=None) == pytest.approx(horizontal / 100 * error)


@pytest.mark.parametrize(
    ("values", "is_used"),
    [
        # Of a DLS 2, whose clock is wrong by half a day, and of a DLS 1.
        ({"Direct": 110.0, "Scattered": 20.0, "Horizontal": 100.0, "Spectral": 100.0}, True),
        ({"Spectral": 1.0}, False),
    ],
)
def test_a_sun_below_the_horizon_is_no_error_of_the_program(values: dict[str, float], is_used: bool) -> None:
    xmp = {(dls.NAMESPACE, f"{name}Irradiance"): (str(value),) for name, value in values.items()}
    xmp |= {(dls.NAMESPACE, name): ("0.0",) for name in ("Yaw", "Pitch", "Roll")}
    night = Tags(size_px=(64, 48), xmp=xmp, position=GOLDEN, captured_at="2026-06-21T07:00:00Z")
    result = dls.irradiance(night)
    assert (result.value > 0) is is_used
    assert ("the sun is below the horizon" in result.problem) is not is_used


def test_a_file_whose_tags_raise_an_error_does_not_cost_the_others(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(flight, tmp_path / "flight"))
    read = read_files.read_file

    def failing(path: Path, *rest: Any) -> Any:
        if path.name == "IMG_0001_4.tif":
            raise ValueError("math domain error")
        return read(path, *rest)

    monkeypatch.setattr(read_files, "read_file", failing)
    scan = discover(folder)
    (problem,) = scan.problems
    assert "IMG_0001_4.tif: its tags cannot be used (ValueError: math domain error); leave it out" in problem.text
    assert [len(c.bands) for c in scan.captures] == [4, 5]
