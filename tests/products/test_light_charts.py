from pathlib import Path

from agalign.products.report.charts import CHART_HEIGHT
from agalign.products.report.light import CaptureLight, light_charts
from agalign.products.sidecar import Sidecar

from .test_sidecar import example


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
    alone = [CaptureLight.of("a", Path("a.json"), lit(m, 1.0, 3.0, None)) for m in range(3)]
    assert len(light_charts(alone)) == 1
    assert light_charts(alone[:2]) == []
    assert light_charts([CaptureLight.of("a", Path("a.json"), example())] * 3) == []
