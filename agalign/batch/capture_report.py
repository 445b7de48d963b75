"""Reports of the captures of a run: what a caller in Python gets, and a notebook shows."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Literal

from agalign.host.text import counted
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import read_sidecar


@dataclass(frozen=True)
class CaptureReport:
    """State and result of one capture.

    Examples
    --------
    `reports` is that of the example of `align_folder`.

    >>> report = reports[0]
    >>> report.state, report.is_complete, report.problems
    ('done', True, ())
    >>> report.summary
    'done, 4 aligned'
    >>> nir = next(band for band in report.sidecar.bands if band.band == "NIR")
    >>> nir.status, nir.metrics.after.residual_px < 0.5
    ('aligned', True)
    """

    label: str
    """Folder and number of the capture, as 0000SET/000/IMG_0001."""
    state: Literal["done", "kept", "error", "panel", "sky"]
    """`done`: processed in this run. `kept`: the result of an earlier run, with the same settings unless there is a
    `why_kept`. `error`: the capture has no result. `panel`, `sky`: it shows a calibration panel or the sky, and is
    not aligned.
    """
    result: Sidecar | None = field(default=None, repr=False)
    """Content of the sidecar without its long tables; None for a capture with an `error`."""
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
    impossible_products: tuple[str, ...] = ()
    """Requested indices that no run can write, because of the units of the bands, and why."""
    why_kept: str = ""
    """Which input files of an earlier result are lost, so that this run does not replace it; empty if none are."""
    removed: tuple[tuple[Path, str], ...] = ()
    """Files of an earlier command that were removed, and why."""
    seconds: float = 0.0
    """Processing time in this run, s."""
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
        done = self.result is not None and self.result.status == "ok" and not self.problems
        return self.state in ("panel", "sky") or done

    @property
    def problems(self) -> tuple[str, ...]:
        """Errors, except bands that are not aligned; those are in the sidecar."""
        return tuple(
            dict.fromkeys(filter(None, (self.error, *self.failed_products, *self.impossible_products, self.why_kept)))
        )

    @property
    def summary(self) -> str:
        """The state, with the number of bands by status, or the error."""
        if self.result is None:
            return f"{self.state}: {self.error or self.panel or self.sky}"
        statuses = Counter(status for _, status, _ in self.result.pairs)
        return f"{self.state}, " + ", ".join(f"{number} {status}" for status, number in statuses.items())

    def _repr_html_(self) -> str:
        """A short table for notebooks."""
        if self.result is None:
            return f"<p><b>{escape(self.label)}</b>: {escape(self.summary)}</p>"
        residuals_px = [math.nan if b.metrics is None else b.metrics.after.residual_px for b in self.result.bands]
        rows = "".join(
            f"<tr><td>{escape(b.band)}</td><td>{b.status}</td><td>{f'{px:.3f}' if math.isfinite(px) else ''}</td>"
            f"<td>{escape(b.reason or '')}</td></tr>"
            for b, px in zip(self.result.bands, residuals_px, strict=True)
        )
        head = "<tr><th>band</th><th>status</th><th>residual, px</th><th>reason</th></tr>"
        return f"<p><b>{escape(self.label)}</b>: {self.result.status}</p><table>{head}{rows}</table>"


class FlightReports(list[CaptureReport]):
    """The reports of the captures of a run: a list, which a notebook shows as a table.

    Examples
    --------
    `reports` is that of the example of `align_folder`.

    >>> [report.state for report in reports]
    ['done', 'done']
    >>> [report.label for report in reports if not report.is_complete]
    []
    >>> [report.panel for report in reports.excluded]  # this flight has no calibration panel
    []
    """

    excluded: list[CaptureReport]
    """The reports of the captures of calibration panels and of the sky, which are not aligned and not in the list."""

    def __init__(self, reports: Iterable[CaptureReport] = ()) -> None:
        super().__init__(reports)
        self.excluded = []

    def _repr_html_(self) -> str:
        max_rows = 20
        counts = Counter(report.state for report in [*self, *self.excluded])
        total = ", ".join(f"{number} {state}" for state, number in counts.items())
        head = "<tr><th>capture</th><th>state</th><th>bands</th></tr>"
        rows = "".join(
            f"<tr><td>{escape(report.label)}</td><td>{report.state}</td><td>{escape(report.summary)}</td></tr>"
            for report in self[:max_rows]
        )
        more = f"<p>and {len(self) - max_rows} more</p>" if len(self) > max_rows else ""
        return f"<p>{counted(counts.total(), 'capture')}: {total}</p><table>{head}{rows}</table>{more}"
