"""What tells of a run as a whole, from the sidecars below its output folder: the page and the summary."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, select_autoescape

from agalign.errors import SidecarError
from agalign.products.panels import PANELS_FILE, read_panels
from agalign.products.sidecar import BandResult, CaptureResult, ResidualTile, Sidecar, find_sidecars, read_sidecar
from agalign.products.summary import panel_rows, summary_rows, write_summary
from agalign.values.files import write_text

REPORT_FILE, SUMMARY_FILE = "index.html", "summary.csv"
_SLOWEST = 5
_FULL_SCALE_PX = 1.0
"""Residual at which a heat map's colour is full."""


@dataclass(frozen=True)
class Arrow:
    """One window of the heat map, in the map's own units (the reference image is 160 wide)."""

    x: float
    y: float
    dx: float
    dy: float
    colour: str
    title: str


@dataclass(frozen=True)
class PairView:
    """A band pair as the page shows it."""

    band: BandResult
    arrows: tuple[Arrow, ...]
    map_height: float


@dataclass(frozen=True)
class CaptureView:
    """A capture as the page shows it."""

    anchor: str
    label: str
    sidecar: CaptureResult
    picture: str | None
    stack: str | None
    pairs: tuple[PairView, ...]

    @property
    def seconds(self) -> float:
        """What its alignment took."""
        return sum(p.band.seconds for p in self.pairs)


@dataclass(frozen=True)
class Pages:
    """What tells of a run as a whole."""

    report: Path
    summary: Path
    troubled: tuple[str, ...]
    """Labels of the captures that fell short,"""
    slowest: tuple[tuple[str, float], ...]
    """and of those that took longest, with their seconds."""


def write_pages(out: Path, on_problem: Callable[[str], None]) -> Pages:
    """OUT/index.html and OUT/summary.csv from all sidecars below OUT; what cannot be read is told to `on_problem`.

    Raises OutputError.
    """
    rows: list[dict[str, object]] = []
    captures: list[CaptureView] = []
    for path in find_sidecars(out):
        folder = path.parent.relative_to(out).as_posix()
        try:
            sidecar = read_sidecar(path)
        except SidecarError as error:
            on_problem(str(error))
            continue
        rows += summary_rows(folder, sidecar)
        captures.append(_capture_view(out, folder, sidecar))
    try:
        panels = read_panels(out)
    except SidecarError as error:
        on_problem(str(error))
        panels = []
    rows += [row for panel in panels for row in panel_rows(panel)]
    write_summary(rows, out / SUMMARY_FILE)
    troubled = [c for c in captures if c.sidecar.status != "ok"]
    slowest = sorted(captures, key=lambda c: -c.seconds)[:_SLOWEST]
    pairs = [p.band for c in captures for p in c.pairs]
    residuals = [r for p in pairs if p.status == "aligned" and (r := _residual(p)) is not None]
    environment = Environment(
        loader=PackageLoader("agalign.products", "."),
        autoescape=select_autoescape(["j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    html = environment.get_template("report.html.j2").render(
        captures=captures,
        counts=Counter(p.status for p in pairs),
        pairs=len(pairs),
        troubled=troubled,
        slowest=slowest if len(captures) > _SLOWEST else [],
        median_residual_px=median(residuals) if residuals else None,
        worst_residual_px=max(residuals, default=None),
        bands=_by_band(pairs),
        panels=panels,
        has_local=any(p.local is not None for p in pairs),
        version=captures[0].sidecar.agalign if captures else "",
    )
    write_text(out / REPORT_FILE, html)
    return Pages(
        out / REPORT_FILE, out / SUMMARY_FILE, tuple(c.label for c in troubled),
        tuple((c.label, c.seconds) for c in slowest),
    )  # fmt: skip


def pages_stand(out: Path) -> bool:
    """True where the pages of an earlier run are newer than all that they tell of."""
    try:
        written = min((out / name).stat().st_mtime_ns for name in (REPORT_FILE, SUMMARY_FILE))
        told = [*find_sidecars(out), *([out / PANELS_FILE] if (out / PANELS_FILE).exists() else [])]
        return all(path.stat().st_mtime_ns < written for path in told)
    except OSError:
        return False


def _capture_view(out: Path, folder: str, sidecar: Sidecar) -> CaptureView:
    base = "" if folder == "." else f"{folder}/"
    picture = f"{base}{sidecar.capture}.png"
    stack = f"{base}{sidecar.output.file}" if sidecar.output and sidecar.output.file else None
    reference = sidecar.reference
    # What is drawn of the long tables is drawn now, and then they go.
    result, tables = sidecar.result(), [b.metrics.tiles if b.metrics else [] for b in sidecar.bands]
    pairs = tuple(
        _pair_view(band, tiles, reference.width, reference.height)
        for band, tiles in zip(result.bands, tables, strict=True)
        if band.status != "reference"
    )
    return CaptureView(
        anchor=quote(f"{base}{sidecar.capture}"),
        label=f"{base}{sidecar.capture}",
        sidecar=result,
        picture=quote(picture) if (out / picture).is_file() else None,
        stack=quote(stack) if stack else None,
        pairs=pairs,
    )


def _pair_view(band: BandResult, tiles: Sequence[ResidualTile], width_px: int, height_px: int) -> PairView:
    scale = 160 / width_px
    return PairView(band, tuple(_arrow(t, scale) for t in tiles), height_px * scale)


def _arrow(tile: ResidualTile, scale: float) -> Arrow:
    x, y = tile.centre_px[0] * scale, tile.centre_px[1] * scale
    dx, dy = tile.shift_px
    if dx is None or dy is None:
        return Arrow(x, y, 0, 0, "#bbb", "no shift could be measured here")
    length = math.hypot(dx, dy)
    share = min(1.0, length / _FULL_SCALE_PX)
    reach = 6 / max(length, _FULL_SCALE_PX)
    # From blue-green to red, of equal lightness, so that the map reads in print too.
    return Arrow(x, y, dx * reach, dy * reach, f"hsl({200 - 200 * share:.0f} 70% 45%)", f"{dx:+.2f}, {dy:+.2f} px")


def _residual(band: BandResult) -> float | None:
    return band.metrics.after.residual_px if band.metrics else None


def _by_band(pairs: Sequence[BandResult]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for name in dict.fromkeys(p.band for p in pairs):
        mine = [p for p in pairs if p.band == name]
        residuals = [r for p in mine if p.status == "aligned" and (r := _residual(p)) is not None]
        rows.append(
            {
                "name": name,
                "aligned": sum(p.status == "aligned" for p in mine),
                "all": len(mine),
                "median": median(residuals) if residuals else None,
                "worst": max(residuals, default=None),
                "seconds": median(p.seconds for p in mine),
            }
        )
    return rows
