"""Light in the report: charts of sensor and panels; levels in sidecars, overlaps, jumps of exposure, cloud shadows."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from agalign.products.report.charts import CHART_HEIGHT, CaptureLight, light_charts, radiometric_check
from agalign.products.report.drawing import LEVEL_BLOCKS, block_means, read_reduced_bands
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import Sidecar
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid

from .test_sidecar import example

WIDTH, HEIGHT, STEP_PX = 320, 240, 100
BANDS = "Green", "NIR"


def lit(minute: int, irradiance: float | None, factor: float, panel_age_s: float | None) -> Sidecar:
    """The sidecar of a capture with one band, which was converted to reflectance."""
    illumination = [{"band": "Green", "irradiance": irradiance, "reflectance_per_radiance": factor}]
    output = {"file": None, "bytes": None, "crop": (0, 0, 10, 8), "nodata": None, "illumination": illumination}
    return example(output=output | {"panel_age_s": panel_age_s}, captured_at=f"2026-06-21T10:{minute:02d}:00")


def heights(points: tuple[str, ...]) -> list[float]:
    """Relative heights in a chart, -1 to 1."""
    ys = [float(pair.split(",")[1]) for run in points for pair in run.split()]
    return [round((1 - 2 * y / CHART_HEIGHT) / 0.92, 2) for y in ys]


def test_irradiance_and_panel_factors_are_drawn_in_the_order_of_time() -> None:
    sidecars = [lit(20, 1.2, 2.5, 600.0), lit(0, 1.0, 4.0, 60.0), lit(10, 0.9, 4.0, 0.0)]
    light = [CaptureLight.of(f"{k}", Path("a.json"), s) for k, s in enumerate(sidecars)]
    by_sensor, by_panel = light_charts(light)
    assert by_sensor.ends == ("1", "0")
    assert round(by_sensor.full, 3) == 0.2
    assert heights(by_sensor.lines[0].points) == [0.0, -0.5, 1.0]
    assert by_panel.title.startswith("Light by panels")
    assert heights(by_panel.lines[0].points) == [0.0, 0.0, 1.0]
    # No chart without a panel, and no chart of only two captures.
    alone = [CaptureLight.of(f"{m}", Path("a.json"), lit(m, 1.0, 3.0, None)) for m in range(3)]
    assert len(light_charts(alone)) == 1
    assert light_charts(alone[:2]) == []
    assert light_charts([CaptureLight.of("a", Path("a.json"), example())] * 3) == []


def flight(folder: Path, gains: list[float], nir: list[float] | None = None) -> list[CaptureLight]:
    """Captures along a strip over one texture that becomes brighter by half.

    `gains` multiply the levels of both bands, `nir` those of NIR.
    """
    noise = np.random.default_rng(0).random((HEIGHT // 4, (WIDTH + STEP_PX * len(gains)) // 4)).astype(np.float32)
    ground = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)[:HEIGHT] + 0.5
    ground *= np.linspace(1.0, 1.5, ground.shape[1], dtype=np.float32)
    captures = []
    for k, gain in enumerate(gains):
        view = ground[:, k * STEP_PX : k * STEP_PX + WIDTH]
        path = folder / f"{k}.png"
        cv2.imwrite(str(path), np.vstack([np.zeros_like(view), view * 100]).astype(np.uint8))
        levels = {"Green": block_means(gain * view), "NIR": block_means(gain * (nir or [1.0] * 9)[k] * view)}
        tile_px = (0, HEIGHT, WIDTH, HEIGHT)
        saturated = {"NIR": 0.01 * k}
        captures.append(CaptureLight("camera", f"{k}", f"{k}", {}, {}, saturated, levels, path, tile_px))
    return captures


def test_levels_of_overlapping_captures_are_compared_on_the_ground(tmp_path: Path) -> None:
    check = radiometric_check(flight(tmp_path, [1.0, 1.0, 1.05, 1.05]))
    assert [band["name"] for band in check.bands] == list(BANDS)
    assert [band["overlaps"] for band in check.bands] == [3, 3]
    assert check.bands[0]["median"] < 0.02
    assert check.bands[0]["p95"] == pytest.approx(0.05, abs=0.02)
    assert (check.bands[1]["saturated"], check.bands[1]["capture"]) == (0.03, "3")
    assert (check.jumps, len(check.chart.lines), check.chart.full) == ([], 2, 0.05)


def test_a_jump_of_one_band_is_no_shadow(tmp_path: Path) -> None:
    """A shadow darkens all bands."""
    (jump,) = radiometric_check(flight(tmp_path, [1.0] * 3, nir=[1.0, 1.0, 0.7])).jumps
    assert jump[0] == "2"
    assert re.search(r"NIR -(29|30|31)%", jump[1])
    assert "shadow" not in jump[1]
    assert "Green" not in jump[1]


def test_the_cues_of_a_shadow_are_named(tmp_path: Path) -> None:
    captures = flight(tmp_path, [1.0, 1.0, 0.7, 0.7])
    jumps = dict(radiometric_check(captures).jumps)
    assert list(jumps) == ["2"]
    assert "cloud shadow suspected (darker than the capture before)" in jumps["2"]
    light = [dict.fromkeys(BANDS, 0.7 if k == 2 else 1.0) for k in range(4)]
    captures = [replace(c, irradiance=one) for c, one in zip(captures, light, strict=True)]
    check = radiometric_check(captures)
    assert "(darker than the capture before, light sensor)" in dict(check.jumps)["2"]
    assert check.chart.full == pytest.approx(-np.log(0.7), abs=0.02)


def test_captures_of_other_cameras_and_damaged_previews_are_not_compared(tmp_path: Path) -> None:
    first, second = flight(tmp_path, [1.0, 0.5])
    assert radiometric_check([]) is None
    # Less light in the flight of another camera indicates no shadow.
    bright, dark = (dict.fromkeys(BANDS, value) for value in (1.0, 0.3))
    of_other = replace(second, camera="other", irradiance=dark)
    check = radiometric_check([replace(first, irradiance=bright), of_other])
    assert (check.bands[0]["overlaps"], check.jumps) == (0, [])
    second.preview.write_bytes(b"no image")
    assert radiometric_check([first, second]).bands[0]["overlaps"] == 0
    assert radiometric_check([first, replace(second, preview=tmp_path / "missing")]).jumps == []


def test_levels_and_saturation_of_a_band(tmp_path: Path) -> None:
    plane = np.full((60, 80), 3.0, np.float32)
    plane[:10, :4], plane[:10, 10:16] = np.nan, np.nan  # 40 % and 60 % of a block
    assert np.isnan(block_means(plane)).nonzero() == (0, 1)
    assert np.nanmin(block_means(plane)) == np.nanmax(block_means(plane)) == 3.0
    plane = np.where(np.isnan(plane), 255, plane).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), plane)
    band = Band("NIR", tmp_path / "a.png", 1, 80, 60, "uint8", saturation_value=255)
    bands = read_reduced_bands(Capture("a", tmp_path, (band,), 0), {}, OutputGrid(0, 0, 80, 60))
    assert bands.saturated == {"NIR": pytest.approx(100 / 4800)}


def test_sidecars_have_the_levels_of_what_was_written(aligned_flight: Path) -> None:
    path = next(aligned_flight.rglob("IMG_0001.json"))
    sidecar = read_sidecar(path)
    with rasterio.open(path.with_suffix(".tif")) as stack:
        for index, band in enumerate(sidecar.bands, start=1):
            pixels = np.where(stack.read_masks(index) > 0, stack.read(index), np.nan).astype(np.float32)
            np.testing.assert_allclose(np.array(band.levels, float), block_means(pixels), rtol=1e-4)
            assert 0 <= band.saturated < 0.05
    assert np.shape(sidecar.bands[0].levels) == LEVEL_BLOCKS
    assert "Radiometric check" in (aligned_flight / "index.html").read_text()
