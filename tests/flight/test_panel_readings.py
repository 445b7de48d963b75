import math
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from agalign.flight.panel_readings import (
    BandReading,
    PanelReading,
    compared,
    missing_panel,
    read_panel,
    reflectance_factors,
    with_cues,
    with_height,
    with_panels,
)
from agalign.pixels.panel_detection import DetectedPanel
from agalign.pixels.radiometry import with_radiometry
from agalign.report.panel_and_sky_files import write_panels
from agalign.values.capture import Band, CameraIdentity, Capture, Panel, Pose, Position
from agalign.values.radiometry import Quantity, Radiometry, ReflectanceFactor

from ..program import agalign

AREA = ((20.0, 10.0), (39.0, 10.0), (39.0, 29.0), (20.0, 29.0))
PLAIN = Radiometry("radiance", 1000.0, 65536.0, 2.0)
GREEN = Band("Green", Path("x.tif"), 1, 64, 48, "uint16")
HELD = replace(GREEN, panel=Panel("look"))
GROUND, HIGH = Position(52.0, 5.0, 93.0), Position(52.0, 5.0, 112.0)


def panel_file(path: Path, levels: int | np.ndarray = 33768) -> Band:
    """A square of one level or of (30, 30), by default (33768 - 1000) / 65536 = 0.5, in the dark."""
    pixels = np.full((48, 64), 2000, np.uint16)
    pixels[5:35, 15:45] = levels
    tifffile.imwrite(path, pixels)
    panel = Panel("tags", "RP04", 0.4, AREA)
    return Band("Green", path, 1, 64, 48, "uint16", saturation_value=65520.0, radiometry=PLAIN, panel=panel)


def capture(band: Band, moment: str = "2026-06-21T10:00:00", **more: object) -> Capture:
    return Capture("IMG_0001", Path(), (band,), 0, CameraIdentity("a", "b", "1"), captured_at=moment, **more)


def reading(moment: str, factor: float) -> PanelReading:
    return PanelReading(capture(GREEN, moment), (BandReading(GREEN, 0.5, 0.5 / factor),))


def test_the_factor_is_reflectance_by_the_tags_or_the_user_over_radiance(tmp_path: Path) -> None:
    shown = capture(panel_file(tmp_path / "a.tif"))
    (result,) = read_panel(shown, {}).bands
    assert result.radiance == pytest.approx(1.0)
    assert (result.albedo, result.factor) == (0.4, pytest.approx(0.4))
    assert read_panel(shown, {"": 0.6}).bands[0].factor == pytest.approx(0.6)
    assert read_panel(shown, {"": 0.6, "green": 0.7}).bands[0].factor == pytest.approx(0.7)
    assert read_panel(shown, {"red": 0.6}).bands[0].factor == pytest.approx(0.4)


def levels(shaded_columns: int = 0, light: float = 0.5, noise: float = 0.03) -> np.ndarray:
    """Levels (30, 30) of a panel with the noise of a camera and less light in some columns."""
    panel = np.random.default_rng(1).normal(1.0, noise, (30, 30))
    panel[:, :shaded_columns] *= light
    return np.clip(1000 + 20000 * panel, 0, 65000)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        (levels(), ""),
        (levels(11), ""),
        (levels(15), "its pixels vary by "),
        (levels(noise=0.6), "its pixels vary by "),
        (levels(15, light=0.0), "its pixels vary by "),
        (900, "it is black"),
        (65535, "saturated"),
    ],
)
def test_a_panel_is_measured_where_it_is_evenly_lit_and_exposed(
    tmp_path: Path, values: int | np.ndarray, problem: str
) -> None:
    """A shadow over 30 % of the panel, by half, would make every band 16 % too bright."""
    reading = read_panel(capture(panel_file(tmp_path / "a.tif", values)), {})
    (result,) = reading.bands
    if problem:
        assert problem in result.problem
        assert result.factor is None
        assert f"not used in Green: {result.problem}" in write_panels([reading], tmp_path)[0].sentence
    else:
        assert (result.problem, result.radiance) == ("", pytest.approx(2.0 * 20000 / 65536, rel=0.03))


def test_illumination_is_interpolated_in_time_and_constant_outside() -> None:
    panels = [reading("2026-06-21T10:00:00", 2.0), reading("2026-06-21T11:00:00", 4.0)]
    for hour, factor, age_s in (("09:00", 2.0, 3600), ("10:30", 1 / 0.375, 1800), ("12:00", 4.0, 3600)):
        result = reflectance_factors(capture(GREEN, f"2026-06-21T{hour}:00"), panels)
        assert facts(result) == {"Green": (pytest.approx(factor), "panel", age_s)}
    assert reflectance_factors(capture(GREEN, "2026-06-23T10:30:00"), panels) == {}
    assert reflectance_factors(replace(capture(GREEN), camera=CameraIdentity("a", "b", "2")), panels) == {}


def test_the_age_of_a_panel_is_that_of_the_nearest_one_with_the_band() -> None:
    """The NIR of the panel at noon is saturated: its factor, and how old this is, are those of the panel before."""
    nir = replace(GREEN, name="NIR")
    shown = [replace(capture(GREEN, f"2026-06-21T{hour}:00:00"), bands=(GREEN, nir)) for hour in (10, 12)]
    of_green, of_nir = BandReading(GREEN, 0.5, 0.25), BandReading(nir, 0.5, 0.25)
    lost = BandReading(nir, 0.5, 0.25, "5% of it is saturated")
    panels = [PanelReading(shown[0], (of_green, of_nir)), PanelReading(shown[1], (of_green, lost))]
    later = replace(capture(GREEN, "2026-06-21T11:55:00"), bands=(GREEN, nir))
    result = reflectance_factors(later, panels)
    assert {name: factor.panel_age_s for name, factor in result.items()} == {"Green": 300, "NIR": 6900}
    light = {name: max(e.std_percent for e in factor.errors) for name, factor in result.items()}
    assert light["NIR"] > 5 * light["Green"]


def facts(factors: dict[str, ReflectanceFactor]) -> dict[str, tuple[float, str, float | None]]:
    """(value, source, age of the panel in s) by band."""
    return {name: (f.value, f.source, f.panel_age_s) for name, f in factors.items()}


def lit(irradiance: float, quantity: Quantity = "reflectance", name: str = "Green") -> Band:
    """A band with a light sensor that measures an irradiance."""
    return replace(GREEN, name=name, radiometry=replace(PLAIN, by_sun=ReflectanceFactor(np.pi / irradiance, quantity)))


def lit_panel(moment: str, *measured: float, quantity: Quantity = "reflectance") -> PanelReading:
    """A panel of reflectance 0.5 under an irradiance of 1 that the light sensor of each band measures as `measured`."""
    bands = tuple(lit(*facts) for facts in zip(measured, [quantity] * 3, ("Green", "Red", "NIR"), strict=False))
    seen = replace(capture(GREEN, moment), bands=bands)
    return PanelReading(seen, tuple(BandReading(band, 0.5, 0.5 / np.pi) for band in bands))


def test_the_panel_scales_the_light_sensor_which_follows_the_light() -> None:
    """53 minutes after the panel, the sensor measures 15 % more light; it shows 0.9 of the light on the panel."""
    panel, later = lit_panel("2026-06-21T15:04:00", 0.9), capture(lit(0.9 * 1.15), "2026-06-21T15:57:00")
    result = reflectance_factors(later, [panel])
    assert facts(result) == {"Green": (pytest.approx(np.pi / 1.15), "panel and light sensor", 53 * 60)}
    # Between two panels, the scale of the sensor is interpolated.
    two = [panel, lit_panel("2026-06-21T16:50:00", 1.0)]
    scale = (1 / 0.9 + 1.0) / 2
    assert reflectance_factors(later, two)["Green"].value == pytest.approx(np.pi / (0.9 * 1.15) / scale)


def test_a_light_sensor_that_was_shaded_at_the_panel_is_not_combined_with_it() -> None:
    later = capture(lit(1.2), "2026-06-21T10:30:00")
    shaded, good = lit_panel("2026-06-21T10:00:00", 0.6), lit_panel("2026-06-21T11:00:00", 1.0)
    assert shaded.sensor_scales == {"Green": pytest.approx(1 / 0.6)}
    assert [r.fits_sensor for r in (shaded, good)] == [False, True]
    for panels in ([shaded], [shaded, good]):
        factors = reflectance_factors(later, panels)
        assert facts(factors) == {"Green": (pytest.approx(np.pi), "panel", 1800)}
        sources = [with_radiometry(later, c, factors).bands[0].radiometry.source for c in ("auto", "panel", "sun")]
        assert sources == ["light sensor", "panel", "light sensor"]
    # A sensor with an unknown unit has any scale.
    relative = lit_panel("2026-06-21T10:00:00", 3000.0, quantity="relative reflectance")
    assert (relative.sensor_scales, relative.fits_sensor) == ({}, True)
    in_same_unit = capture(lit(3300.0, "relative reflectance"), "2026-06-21T10:30:00")
    assert reflectance_factors(in_same_unit, [relative])["Green"].value == pytest.approx(np.pi / 1.1)


@pytest.mark.parametrize("lacking", ["capture", "panel"])
def test_the_bands_of_a_capture_are_under_one_light(lacking: str) -> None:
    """The light has halved since the panel. Red lacks the irradiance, so no band follows the sensor: the ratio of two
    bands is that of their radiances then.
    """
    panel = lit_panel("2026-06-21T10:00:00", 1.0, 1.0)
    bands = lit(0.5), lit(0.5, name="Red")
    without = replace(bands[1], radiometry=PLAIN)
    if lacking == "panel":
        panel = replace(panel, bands=(panel.bands[0], replace(panel.bands[1], band=without)))
    later = replace(
        capture(GREEN, "2026-06-21T10:30:00"), bands=(bands[0], without if lacking == "capture" else bands[1])
    )
    factors = reflectance_factors(later, [panel])
    assert facts(factors) == dict.fromkeys(("Green", "Red"), (pytest.approx(np.pi), "panel", 1800))
    whole = reflectance_factors(replace(later, bands=bands), [lit_panel("2026-06-21T10:00:00", 1.0, 1.0)])
    assert facts(whole) == dict.fromkeys(("Green", "Red"), (pytest.approx(2 * np.pi), "panel and light sensor", 1800))


def test_a_panel_that_is_saturated_in_a_band_has_there_the_change_of_the_light_in_the_others() -> None:
    """The second panel has 1.25 times the light of the first one; only the first shows NIR."""
    moments = "2026-06-21T10:00:00", "2026-06-21T11:00:00"
    first, second = (lit_panel(moment, 1.0, 1.0, 1.0) for moment in moments)
    brighter = [replace(b, radiance=1.25 * (b.radiance or 0)) for b in second.bands]
    saturated = replace(brighter[2], radiance=None, problem="5% of it is saturated")
    plain = tuple(replace(b.band, radiometry=PLAIN) for b in first.bands)
    flown = replace(first.capture, captured_at="2026-06-21T10:45:00", bands=plain)
    panels = [first, replace(second, bands=(*brighter[:2], saturated))]
    factors = reflectance_factors(flown, panels)
    assert [f.value for f in factors.values()] == [pytest.approx(np.pi / 1.1875)] * 3
    differences = [e.std_percent for f in factors.values() for e in f.errors if e.name == "difference of the panels"]
    assert differences == [pytest.approx(100 * (1.25**0.5 - 1))] * 3


@pytest.mark.parametrize(("scale", "source"), [(1.18, "panel and light sensor"), (1.4, "panel")])
def test_a_panel_that_differs_from_the_light_sensor_in_one_band_is_not_combined_with_it(
    scale: float, source: str
) -> None:
    """On a RedEdge-M with a DLS 1, the largest scale of a band is 1.18 times the smallest."""
    panel = lit_panel("2026-06-21T10:30:00", 1.0, 1.0, 1 / scale)
    assert reflectance_factors(capture(lit(1.2), "2026-06-21T10:30:00"), [panel])["Green"].source == source


def test_a_panel_on_the_ground_gives_the_height_of_other_captures() -> None:
    ground, high = PanelReading(capture(HELD, position=GROUND), ()), capture(GREEN, position=HIGH, pose=Pose(30.0))
    result = with_height(high, [ground])
    assert result.pose.height_m == pytest.approx(20.0)
    assert with_height(high, []) == high
    in_scene = replace(GREEN, panel=Panel("QR code", in_scene=True))
    assert with_height(high, [PanelReading(capture(in_scene, position=GROUND), ())]) == high
    with_tags = replace(high, pose=Pose(30.0, height_m=25.0))
    assert with_height(with_tags, [ground]) == with_tags
    assert with_height(replace(high, position=Position(52.0, 5.0, 93.5)), [ground]).pose == high.pose
    on_another_field = replace(ground, capture=replace(ground.capture, position=Position(52.1, 5.0, 93.0)))
    assert with_height(high, [on_another_field]) == high
    of_the_day_before = PanelReading(capture(HELD, "2026-06-20T10:30:00", position=GROUND), ())
    assert with_height(high, [of_the_day_before]) == high


def found(folder: Path, seconds: Iterable[int], shown: Sequence[int], undated: int | None = None) -> list[int]:
    """The captures with a panel, by the second in which they were taken, of a flight with panels in some of them."""
    flight = []
    for k in seconds:
        band = replace(panel_file(folder / f"{k}.tif", 33768 if k in shown else 2000), panel=None)
        moment = "" if k == undated else f"2026-06-21T10:00:{k:02d}"
        flight.append(replace(capture(band, moment), name=f"{k}"))
    return [int(c.name) for c in with_panels(flight, without_code=True) if c.panel]


def test_the_search_for_panels_ends_after_three_captures_without_one(tmp_path: Path) -> None:
    assert found(tmp_path, range(20), [0, 1, 2, 3, 6, 10, 14, 18]) == [0, 1, 2, 3, 6, 18]
    for few in ([7], [7, 8], []):
        assert found(tmp_path, few, few) == few
    # One unknown time leaves the captures in their order.
    turned = [*range(10, 20), *range(10)]
    assert found(tmp_path, turned, [0, 19]) == [19, 0]
    assert found(tmp_path, turned, [0, 19], undated=5) == []


def test_without_a_time_no_panel_is_of_the_same_hours() -> None:
    """Without a GPS fix the clock starts in 1970; such a panel does not match captures without a time."""
    undated, of_1970 = reading("", 2.0), reading("1970-01-01T01:00:00", 2.0)
    assert (undated.capture.time_s, of_1970.capture.time_s) == (None, 3600.0)
    assert reflectance_factors(capture(GREEN, ""), [of_1970]) == {}
    assert reflectance_factors(of_1970.capture, [undated]) == {}
    assert reflectance_factors(undated.capture, [undated]) == {}
    assert facts(reflectance_factors(of_1970.capture, [undated, of_1970])) == {"Green": (2.0, "panel", 0.0)}
    # Nor is one at the height of the ground.
    ground = PanelReading(capture(HELD, "1970-01-01T01:00:00", position=GROUND), ())
    high = capture(GREEN, "", position=HIGH, pose=Pose(30.0))
    assert with_height(high, [ground]) == high


@pytest.mark.parametrize("code", ["RP04", ""])
@pytest.mark.parametrize("in_scene", [False, True])
def test_a_square_alone_leaves_nothing_out(monkeypatch: pytest.MonkeyPatch, code: str, in_scene: bool) -> None:
    """A roof resembles a panel: without a code it is measured, but the capture is aligned."""
    monkeypatch.setattr("agalign.flight.panel_readings._detect", lambda *_, **__: DetectedPanel(code, AREA, in_scene))
    (result,) = with_panels([capture(GREEN)], without_code=True)
    assert (result.panel is not None) == (code != "" or not in_scene)
    assert result.is_of_a_panel == (code != "" and not in_scene)


@pytest.mark.parametrize(
    ("panel", "level", "altitude_m", "name", "cues"),
    [
        (Panel("tags", corners_px=AREA), 33768, 112.0, "IMG_0001", ["tags", "square"]),
        (Panel("tags", corners_px=((40.0, 5.0), (60.0, 5.0), (60.0, 40.0), (40.0, 40.0))), 33768, 112.0, "1", ["tags"]),
        (Panel("tags", corners_px=AREA), 2000, 93.0, "IMG_0001", ["tags", "square", "altitude"]),
        (Panel("QR code"), 33768, 112.0, "IMG_0001", ["QR"]),
        (Panel("QR code"), 33768, 93.0, "IMG_0001", ["QR", "altitude"]),
        (Panel("look", corners_px=AREA), 33768, 112.0, "IMG_0001", ["square"]),
        (Panel("look", corners_px=AREA), 33768, 112.0, "panel_1", ["square", "name"]),
    ],
)
def test_two_cues_leave_out_a_capture_of_a_panel(
    tmp_path: Path, panel: Panel, level: int, altitude_m: float, name: str, cues: list[str]
) -> None:
    band = replace(panel_file(tmp_path / "a.tif", level), panel=panel)
    one = replace(capture(band, position=Position(52.0, 5.0, altitude_m)), name=name)
    result = with_cues(one, 112.0)
    assert len(result.panel.cues) == len(cues)
    assert all(cue in text for cue, text in zip(cues, result.panel.cues, strict=True))
    assert result.is_of_a_panel is (len(cues) > 1)


@pytest.mark.full
def test_a_capture_that_the_search_for_panels_cannot_finish_is_abandoned(flight: Path, tmp_path: Path) -> None:
    """A worker process that never opens its image is ended at the time limit; the other capture is planned."""
    # A process imports it at its start.
    (tmp_path / "sitecustomize.py").write_text(
        "import io, time, traceback\n"
        "now = io.open\n"
        "def late(path, *given, **named):\n"
        "    searched = any(frame.f_code.co_name == '_detect' for frame, _ in traceback.walk_stack(None))\n"
        "    time.sleep(60 if searched and str(path).endswith('IMG_0002_2.tif') else 0)\n"
        "    return now(path, *given, **named)\n"
        "io.open = late\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    done = agalign(flight, "-o", tmp_path / "out", "--timeout", 3, "--dry-run", env=environment, timeout=50)
    assert "1 capture to be aligned, 1 capture stopped after 3 s (--timeout)" in done.stdout


# ---- clocks that were not set


def numbered(name: str, moment: str, folder: str = "000") -> Capture:
    return replace(capture(GREEN, moment), name=name, folder=Path(folder))


def before_fix(name: str, factor: float = 2.0, folder: str = "000") -> PanelReading:
    """A panel that was photographed before the first GPS fix."""
    return replace(reading("1970-01-01T00:01:21", factor), capture=numbered(name, "1970-01-01T00:01:21", folder))


@pytest.mark.parametrize(("panel", "name"), [("IMG_0000", "IMG_0007"), ("DJI_001", "DJI_250"), ("panel", "f_3")])
def test_the_only_panel_is_used_if_its_clock_was_not_set(panel: str, name: str) -> None:
    later = numbered(name, "2026-06-21T10:00:00", "001")
    assert facts(reflectance_factors(later, [before_fix(panel)])) == {"Green": (pytest.approx(2.0), "panel", None)}
    assert missing_panel(later, [before_fix(panel)]) == ""


@pytest.mark.parametrize(("name", "factor"), [("IMG_0003", 2.0), ("IMG_0090", 4.0)])
def test_of_several_panels_the_next_by_number_is_used(name: str, factor: float) -> None:
    panels = [before_fix("IMG_0001", 2.0), before_fix("IMG_0088", 4.0)]
    flown = numbered(name, "2026-06-21T10:00:00")
    assert reflectance_factors(flown, panels)["Green"].value == pytest.approx(factor)
    elsewhere = replace(flown, folder=Path("001"))
    assert reflectance_factors(elsewhere, panels) == {}
    assert missing_panel(elsewhere, panels).startswith("the clock of 000/IMG_0001 was not set")


def test_a_panel_with_a_time_is_preferred(tmp_path: Path) -> None:
    flown = numbered("IMG_0003", "2026-06-21T10:00:00")
    timed = replace(reading("2026-06-21T09:50:00", 3.0), capture=numbered("IMG_0500", "2026-06-21T09:50:00"))
    assert facts(reflectance_factors(flown, [before_fix("IMG_0001"), timed])) == {
        "Green": (pytest.approx(3.0), "panel", 600)
    }
    far = numbered("IMG_0003", "2026-06-28T10:00:00")
    assert "is 7 days older" in missing_panel(far, [timed])


# ---- panels that contradict each other


def panels_of(light: float, minutes: int = 20, albedo: float = 0.5, serial: str = "") -> list[PanelReading]:
    """A panel, and later another one with a share of the light."""
    moments = "2026-06-21T10:00:00", f"2026-06-21T10:{minutes:02d}:00"
    panels = [reading(moment, 2.0 / k) for moment, k in zip(moments, (1.0, light), strict=True)]
    result = []
    for k, one in enumerate(panels):
        own = replace(one.bands[0], albedo=(0.5, albedo)[k], radiance=one.bands[0].radiance)
        shown = replace(GREEN, panel=Panel("tags", serial))
        result.append(replace(one, capture=replace(one.capture, name=f"panel{k}", bands=(shown,)), bands=(own,)))
    return result


def test_a_panel_in_shade_is_not_used() -> None:
    flown = capture(GREEN, "2026-06-21T10:10:00")
    bright, dark = compared(panels_of(0.3))
    assert (bright.brighter, dark.brighter) == ("", "panel0")
    assert dark.light_ratio == pytest.approx(0.3)
    factor = reflectance_factors(flown, [bright, dark])["Green"]
    assert factor.value == pytest.approx(2.0)
    (doubt,) = [e for e in factor.errors if e.state == "contradicted"]
    assert doubt.name == "two calibration panels"
    assert doubt.std_percent == pytest.approx(100 * (math.sqrt(1 / 0.3) - 1))


def test_panels_that_agree_are_interpolated_and_their_difference_is_an_error() -> None:
    flown = capture(GREEN, "2026-06-21T10:10:00")
    factor = reflectance_factors(flown, compared(panels_of(0.9)))["Green"]
    assert factor.value == pytest.approx(2.0 / 0.95)
    by_name = {e.name: e.std_percent for e in factor.errors}
    assert by_name["difference of the panels"] == pytest.approx(100 * (math.sqrt(1 / 0.9) - 1))


def test_a_panel_below_a_cloud_is_used_and_named() -> None:
    flown = capture(GREEN, "2026-06-21T10:10:00")
    factor = reflectance_factors(flown, compared(panels_of(0.7)))["Green"]
    assert factor.value == pytest.approx(2.0 / 0.85)
    assert [e.name for e in factor.errors if e.state == "contradicted"] == ["two calibration panels"]


def test_panels_hours_apart_are_not_compared() -> None:
    one, other = panels_of(0.3)
    later = replace(other, capture=replace(other.capture, captured_at="2026-06-21T12:00:00"))
    assert [r.brighter for r in compared([one, later])] == ["", ""]


def test_two_reflectances_of_one_panel_are_named(tmp_path: Path) -> None:
    flown = capture(GREEN, "2026-06-21T10:10:00")
    readings = compared(panels_of(1.0, albedo=0.45, serial="RP04-1"))
    assert [r.bands[0].other_albedo for r in readings] == [0.45, 0.5]
    errors = reflectance_factors(flown, readings)["Green"].errors
    assert "reflectance of the panel" in [e.name for e in errors if e.state == "contradicted"]
    assert compared(panels_of(1.0, albedo=0.45, serial=""))[0].bands[0].other_albedo is None
