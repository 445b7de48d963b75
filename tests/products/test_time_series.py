"""The report draws the indices of plots over the dates of OUT/plots.csv."""

import shutil
from pathlib import Path

import pytest

from agalign.products.report import write_pages
from agalign.products.report.time_series import time_series

HEAD = "date,capture,plot,index,mean,median\n"


def table(folder: Path, days: tuple[str, ...] = ("2026-05-01", "2026-05-11", "2026-06-10"), plots: int = 20) -> None:
    """The table of a run, with a mosaic without a date and a camera without a clock."""
    rows = [
        f"{day}T10:0{n}:00,IMG_{n},{plot},ndvi,0,{0.2 * k + 0.01 * plot + 0.1 * n}\n"
        for k, day in enumerate(days)
        for plot in range(plots)
        for n in (0, 2)
    ]
    rows += [f"{day},a,0,ndvi,0,0.9\n" for day in ("", "1970-01-01T00:00:07")]
    (folder / "plots.csv").write_text(HEAD + "".join(rows))


def test_a_line_for_each_plot_and_their_median(tmp_path: Path) -> None:
    """With the time as axis: 10 of 40 days are a quarter of the width."""
    table(tmp_path)
    (series,) = time_series(tmp_path)
    assert (series.index, series.plots, len(series.lines)) == ("ndvi", 20, 13)
    assert [series.lines[k].name for k in (0, 1, -1)] == ["0", "1", "median of all"]
    assert series.limits == pytest.approx((0.1, 0.61))
    assert [(day, plots) for day, plots, _ in series.dates] == [(f"2026-0{d}", 20) for d in ("5-01", "5-11", "6-10")]
    assert [value for _, _, value in series.dates] == pytest.approx([0.195, 0.395, 0.595])
    (points,) = series.lines[0].points
    positions = [tuple(map(float, point.split(","))) for point in points.split()]
    assert [x for x, _ in positions] == [0, 160, 640]
    assert positions[0][1] == pytest.approx(124.8)


@pytest.mark.parametrize("text", ["", HEAD, "plot,index\n1,ndvi\n", HEAD + "x,IMG_1,1,ndvi,0,0.5\n", "\x00\xff"])
def test_other_tables_are_ignored(tmp_path: Path, text: str) -> None:
    (tmp_path / "plots.csv").write_text(text)
    assert time_series(tmp_path) == []
    table(tmp_path, days=("2026-05-01",))
    assert time_series(tmp_path) == []


def test_the_report_draws_two_dates(aligned_flight: Path, tmp_path: Path) -> None:
    out = shutil.copytree(aligned_flight, tmp_path / "out")
    table(out, days=("2026-05-01", "2026-06-10"), plots=3)
    write_pages(out, pytest.fail)
    page = (out / "index.html").read_text()
    assert "NDVI of plots over time" in page
    assert page.index("2026-05-01") < page.index("2026-06-10")
