"""The report of one capture, and the timer of its stages."""

import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Literal

from agalign.capture.align_bands import PairProgress
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import BandResult, CaptureResult, Sidecar
from agalign.values.text import counted


@dataclass(frozen=True)
class CaptureReport:
    """State and result of one capture."""

    label: str
    """Folder and number of the capture, as 0000SET/000/IMG_0001."""
    state: Literal["done", "kept", "error", "panel", "sky"]
    """`kept`: an earlier run with the same settings has finished the capture. `panel` and `sky`: the capture shows a
    calibration panel or the sky, and is not aligned.
    """
    result: CaptureResult | None = field(default=None, repr=False)
    """Content of the sidecar, without the long tables."""
    path: Path | None = None
    """Path of the sidecar."""
    error: str | None = None
    """Why the capture has no result, one line."""
    panel: str | None = None
    """Description of the calibration panel."""
    sky: str | None = None
    """Why the capture counts as sky."""
    failed_products: tuple[str, ...] = ()
    """Products that could not be written, and why."""
    seconds: float = 0.0
    """Processing time in this run."""
    stages: Mapping[tuple[str, str], float] = field(default_factory=dict, repr=False)
    """Processing time by (band, stage), s."""

    @property
    def sidecar(self) -> Sidecar | None:
        """The complete sidecar, read from its file; None if there is none. Raises SidecarError."""
        return None if self.path is None else read_sidecar(self.path)

    @property
    def is_complete(self) -> bool:
        """True if every band pair is aligned or predicted accurately enough, none is missing, and all products are
        written; also for panels and the sky.
        """
        done = self.result is not None and self.result.status == "ok" and not self.failed_products
        return self.state in ("panel", "sky") or done

    @property
    def problems(self) -> tuple[str, ...]:
        """Errors, except bands that are not aligned; those are in the sidecar."""
        return self.failed_products if self.error is None else (self.error, *self.failed_products)

    @property
    def summary(self) -> str:
        """The state, with the number of bands by status, or the error."""
        if self.result is None:
            return f"{self.state}: {self.error or self.panel or self.sky}"
        statuses = Counter(status for _, status, _ in self.result.pairs)
        return f"{self.state}, " + ", ".join(f"{number} {status}" for status, number in statuses.items())

    def _row(self) -> str:
        return f"<tr><td>{escape(self.label)}</td><td>{self.state}</td><td>{escape(self.summary)}</td></tr>"

    def _repr_html_(self) -> str:
        """A short table for notebooks."""
        if self.result is None:
            return f"<p><b>{escape(self.label)}</b>: {escape(self.summary)}</p>"
        rows = "".join(
            f"<tr><td>{escape(b.band)}</td><td>{b.status}</td><td>{_residual(b)}</td>"
            f"<td>{escape(b.reason or '')}</td></tr>"
            for b in self.result.bands
        )
        head = "<tr><th>band</th><th>status</th><th>residual, px</th><th>reason</th></tr>"
        return f"<p><b>{escape(self.label)}</b>: {self.result.status}</p><table>{head}{rows}</table>"


class FlightReports(list[CaptureReport]):
    """The reports of a run, which a notebook shows as a table."""

    def _repr_html_(self) -> str:
        max_rows = 20
        counts = Counter(report.state for report in self)
        total = ", ".join(f"{number} {state}" for state, number in counts.items())
        head = "<tr><th>capture</th><th>state</th><th>bands</th></tr>"
        rows = "".join(report._row() for report in self[:max_rows])
        more = f"<p>and {len(self) - max_rows} more</p>" if len(self) > max_rows else ""
        return f"<p>{counted(len(self), 'capture')}: {total}</p><table>{head}{rows}</table>{more}"


class StageClock:
    """Progress callback that forwards its calls and adds up the time of each stage."""

    def __init__(self, progress: PairProgress) -> None:
        self._progress = progress
        self._starts: list[tuple[float, tuple[str, str] | None]] = [(time.perf_counter(), None)]
        """Start time of each (band, stage); before the first, None."""

    def __call__(self, band: str, stage: str, share: float) -> None:
        """Report progress as `PairProgress`; a new band or stage ends the previous one."""
        if (band, stage) != self._starts[-1][1]:
            self._starts.append((time.perf_counter(), (band, stage)))
        self._progress(band, stage, share)

    @property
    def seconds(self) -> float:
        """Seconds since this timer was created."""
        return time.perf_counter() - self._starts[0][0]

    def stages(self) -> Mapping[tuple[str, str], float]:
        """Seconds by (band, stage), including the current stage."""
        seconds: defaultdict[tuple[str, str], float] = defaultdict(float)
        for (since, stage), (until, _) in pairwise([*self._starts, (time.perf_counter(), None)]):
            if stage is not None:
                seconds[stage] += until - since
        return dict(seconds)


def _residual(band: BandResult) -> str:
    residual_px = band.metrics.after.residual_px if band.metrics else None
    return "" if residual_px is None else f"{residual_px:.3f}"
