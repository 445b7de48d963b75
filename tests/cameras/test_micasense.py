import math
from pathlib import Path

import pytest

from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense, horizontal_irradiance, sun_position, transmission
from agalign.pixels.raster import probe
from agalign.values.capture import CaptureTime, Position

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


@pytest.mark.parametrize(
    ("attitude_deg", "lean_deg"),
    [
        ((0, 0, 0), 0),
        ((180, -19, 0), 19),  # nose down, towards the sun in the south
        ((0, -19, 0), -19),
        ((90, 0, 19), 19),  # the right side is down, and the aircraft flies east
        ((270, 0, 19), -19),
    ],
)
def test_a_tilted_sensor_measures_the_light_on_the_horizontal_plane(
    attitude_deg: tuple[float, float, float], lean_deg: float
) -> None:
    """By the published model with direct = 6 diffuse; `lean_deg` is towards the sun."""
    elevation_deg, direct, diffuse = 40.0, 0.6, 0.1
    angle = math.radians(90 - elevation_deg - lean_deg)
    measured = (direct * math.cos(angle) + diffuse) * transmission(angle)
    result = horizontal_irradiance(measured, attitude_deg, (math.radians(elevation_deg), math.pi))
    assert result == pytest.approx(direct * math.sin(math.radians(elevation_deg)) + diffuse)


def test_a_sensor_that_sees_no_direct_light_measures_nothing() -> None:
    low, night = (math.radians(20), math.pi), (math.radians(-3), math.pi)
    assert math.isnan(horizontal_irradiance(0.2, (0, -19, 0), low))
    assert math.isnan(horizontal_irradiance(0.2, (0, -180, 0), low))
    assert math.isnan(horizontal_irradiance(0.2, (180, -5, 0), night))


def irradiance(
    path: Path, values: dict[str, float], position: Position | None = GOLDEN, captured_at: str = NOON
) -> float | None:
    """The irradiance by a file's light sensor, with other values in its tags."""
    tags = vars(read_tags(path))
    xmp = {k: v for k, v in tags["xmp"].items() if k[0] != DLS} | {(DLS, k): (str(v),) for k, v in values.items()}
    changed = Tags(**tags | {"xmp": xmp, "position": position, "captured_at": captured_at})
    (band,) = MicaSense().bands(path, changed, probe(path))
    return band.radiometry.by_sun and math.pi / band.radiometry.by_sun[0]


def test_irradiance_in_the_plane_of_the_sensor_is_corrected_for_its_tilt(flight: Path) -> None:
    path = next(flight.rglob("IMG_0001_1.tif"))
    elevation, azimuth = sun_position(GOLDEN, CaptureTime.of(NOON).utc.timestamp())
    for lean in (0.0, math.radians(19), math.radians(-19)):
        angle = math.pi / 2 - elevation - lean
        measured = (1.2 * math.cos(angle) + 0.2) * transmission(angle)
        tags = {"SpectralIrradiance": measured, "Yaw": azimuth, "Pitch": -lean, "Roll": 0}
        assert irradiance(path, tags) == pytest.approx(1.2 * math.sin(elevation) + 0.2)
        # Without a place or with a clock that was not set, the position of the sun is unknown.
        assert irradiance(path, tags, position=None) == pytest.approx(measured)
        assert irradiance(path, tags, captured_at="1970-01-01T19:30:30") == pytest.approx(measured)
    for damaged in ({"SpectralIrradiance": 0.2, "Pitch": 2.6}, {"HorizontalIrradiance": "1e-300", SCALE: "1e-300"}):
        assert irradiance(path, {"Yaw": azimuth} | damaged) is None
    assert irradiance(path, {"HorizontalIrradiance": 120.0, SCALE: -0.01}) is None


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
