"""Builds the page from the sidecars below an output folder."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, select_autoescape

from agalign.products.sidecar import BandPart, ResidualTile, Sidecar
from agalign.products.summary import panels_of, sidecars_below
from agalign.values.files import write_text

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

    band: BandPart
    arrows: tuple[Arrow, ...]
    map_height: float


@dataclass(frozen=True)
class CaptureView:
    """A capture as the page shows it."""

    anchor: str
    label: str
    sidecar: Sidecar
    picture: str | None
    stack: str | None
    pairs: tuple[PairView, ...]


def write_report(out: Path) -> Path:
    """OUT/index.html from the sidecars below OUT. Raises OutputError."""
    captures = [_capture_view(out, folder, sidecar) for folder, sidecar in sidecars_below(out)]
    pairs = [p.band for c in captures for p in c.pairs]
    counts = Counter(p.status for p in pairs)
    residuals = [r for p in pairs if p.status == "aligned" and (r := _residual(p)) is not None]
    environment = Environment(
        loader=PackageLoader("agalign.products", "."),
        autoescape=select_autoescape(["j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    html = environment.get_template("report.html.j2").render(
        captures=captures,
        counts=counts,
        pairs=len(pairs),
        troubled=[c for c in captures if c.sidecar.status != "ok"],
        median_residual_px=median(residuals) if residuals else None,
        worst_residual_px=max(residuals, default=None),
        bands=_by_band(pairs),
        panels=panels_of(out),
        has_local=any(p.local is not None for p in pairs),
        version=captures[0].sidecar.agalign if captures else "",
    )
    path = out / "index.html"
    write_text(path, html)
    return path


def _capture_view(out: Path, folder: str, sidecar: Sidecar) -> CaptureView:
    base = "" if folder == "." else f"{folder}/"
    picture = f"{base}{sidecar.capture}.png"
    stack = f"{base}{sidecar.output.file}" if sidecar.output and sidecar.output.file else None
    reference = sidecar.reference
    pairs = tuple(_pair_view(b, reference.width, reference.height) for b in sidecar.bands if b.status != "reference")
    return CaptureView(
        anchor=quote(f"{base}{sidecar.capture}"),
        label=f"{base}{sidecar.capture}",
        sidecar=sidecar,
        picture=quote(picture) if (out / picture).is_file() else None,
        stack=quote(stack) if stack else None,
        pairs=pairs,
    )


def _pair_view(band: BandPart, width_px: int, height_px: int) -> PairView:
    tiles = band.metrics.tiles if band.metrics else []
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


def _residual(band: BandPart) -> float | None:
    return band.metrics.after.residual_px if band.metrics else None


def _by_band(pairs: Sequence[BandPart]) -> list[dict[str, object]]:
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
