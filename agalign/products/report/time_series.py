"""Charts of OUT/plots.csv, the table of `agalign plots`: the indices of plots over several dates."""

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from statistics import median

from agalign.products.report.rigs import CHART_HEIGHT, CHART_WIDTH, Line, hue_of
from agalign.values.files import read_regular

PLOTS_FILE = "plots.csv"
_MARGIN = 0.04
"""Share of the height above and below the values, where the chart has its lines."""


@dataclass(frozen=True)
class TimeSeries:
    """An index over the dates of a table, for a chart and its table."""

    index: str
    plots: int
    """Number of plots; the chart has some of them, and their median."""
    lines: Sequence[Line]
    limits: tuple[float, float]
    """Values at the lower and the upper end of the axis."""
    dates: Sequence[tuple[str, int, float]]
    """(date, number of plots, median of their values) of each date."""


def time_series(out: Path) -> list[TimeSeries]:
    """Return a time series for each index with two dates or more in OUT/plots.csv; empty without such a table.

    The value of a plot on a date is the median of its medians in all captures of that day.
    """
    samples: defaultdict[str, dict[str, dict[str, list[float]]]] = defaultdict(dict)
    try:
        for row in csv.DictReader(io.StringIO(read_regular(out / PLOTS_FILE).decode())):
            if row["median"] and row["date"] >= "1971":  # mosaics may have no date, and cameras without a clock 1970
                day = date.fromisoformat(row["date"][:10]).isoformat()
                of_plot = samples[row["index"]].setdefault(row["plot"], {})
                of_plot.setdefault(day, []).append(float(row["median"]))
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [series for index, of_plots in samples.items() if (series := _series(index, of_plots)) is not None]


def _series(index: str, of_plots: dict[str, dict[str, list[float]]]) -> TimeSeries | None:
    values = {plot: {day: median(v) for day, v in by_day.items()} for plot, by_day in of_plots.items()}
    days = sorted({day for by_day in values.values() for day in by_day})
    if len(days) < 2:
        return None
    on_day = {day: [by_day[day] for by_day in values.values() if day in by_day] for day in days}
    max_lines = 12  # more lines cannot be distinguished; the median is of all plots
    drawn = dict(list(values.items())[:max_lines]) | {"median of all": {d: median(v) for d, v in on_day.items()}}
    shown = [v for by_day in drawn.values() for v in by_day.values()]
    low, high = min(shown), max(shown)
    first, last = (date.fromisoformat(day).toordinal() for day in (days[0], days[-1]))

    def point(day: str, value: float) -> str:
        x = (date.fromisoformat(day).toordinal() - first) / (last - first)
        y = _MARGIN + (1 - 2 * _MARGIN) * (high - value) / ((high - low) or 1.0)
        return f"{CHART_WIDTH * x:.1f},{CHART_HEIGHT * y:.1f}"

    lines = [
        Line(name, hue_of(k, len(drawn)), (" ".join(point(day, v) for day, v in sorted(by_day.items())),))
        for k, (name, by_day) in enumerate(drawn.items())
    ]
    return TimeSeries(index, len(values), lines, (low, high), [(d, len(v), median(v)) for d, v in on_day.items()])
