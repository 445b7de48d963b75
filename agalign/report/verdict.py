"""The verdict about a flight: which band pairs indices can use, how accurate they are expected to be, and which indices
were requested and not written.
"""

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import NamedTuple

from agalign.errors import ConfigurationError
from agalign.records.sidecar import BandResult, ErrorPart, Sidecar
from agalign.spectral_indices.formulas import index_named
from agalign.spectral_indices.rasters import IndexReport, reason_not_written

_NO_RASTER = "its raster does not exist; 'agalign indices' writes it"


class ExpectedError(NamedTuple):
    """The expected error of a band of a capture."""

    std_px: float
    """RMS over the area that both images show, px of the reference."""
    other_px: float | None
    """The same in px of the band, if these differ from those of the reference."""
    capture: str
    band: str
    share_over_1_px: float | None
    """Share of the pixels of the output with an expected error above 1 px or unknown; None if none was written."""


@dataclass
class Verdict:
    """The moving bands that indices can use, over all captures, and the indices that were not written."""

    usable: Counter[str] = field(default_factory=Counter)
    """Number of usable moving bands by status: aligned, or predicted within the accepted standard error."""
    errors_px: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Expected errors of the usable moving bands, by name of the band, px of the reference."""
    largest_of: dict[str, ExpectedError] = field(default_factory=dict)
    """The largest of them, by name of the band."""
    unwritten: dict[str, list[tuple[str, str]]] = field(default_factory=lambda: defaultdict(list))
    """(label, reason) of the captures by requested index that was not written."""

    def add(self, label: str, sidecar: Sidecar, unwritten: Iterable[tuple[str, str]] = ()) -> None:
        """Add the bands of a capture, and the (name, reason) of its indices that were not written."""
        for index, reason in unwritten:
            self.unwritten[index].append((label, reason))
        for band in _usable_bands(sidecar):
            self.usable[str(band.status)] += 1
            if band.error is None:
                continue
            error = ExpectedError(band.error.std_px, band.error.other_px, label, band.band, band.share_over_1_px)
            self.errors_px[band.band].append(error.std_px)
            if band.band not in self.largest_of or error.std_px > self.largest_of[band.band].std_px:
                self.largest_of[band.band] = error

    @property
    def largest(self) -> ExpectedError | None:
        """The largest expected error, px of the reference; None if none is known."""
        return max(self.largest_of.values(), key=attrgetter("std_px"), default=None)

    @property
    def median_px(self) -> float | None:
        """Median of the expected errors, px of the reference; None if none is known."""
        errors_px = [px for of_band in self.errors_px.values() for px in of_band]
        return median(errors_px) if errors_px else None

    @property
    def unknown(self) -> int:
        """Number of usable bands without a known expected error."""
        return self.usable.total() - sum(map(len, self.errors_px.values()))

    def unusable(self, statuses: Mapping[str, int]) -> list[str]:
        """Return the numbers of moving bands that indices cannot use, in words, given those of all by status."""
        too_uncertain = statuses["predicted"] - self.usable["predicted"]
        counts = {"predicted with a larger error": too_uncertain}
        counts |= {status.replace("_", " "): statuses[status] for status in ("seed_only", "failed", "missing")}
        return [f"{count} {word}" for word, count in counts.items() if count]


def largest_error(sidecar: Sidecar) -> ErrorPart | None:
    """Return the largest expected error of the moving bands of a capture that indices can use, by px of the reference;
    None if none is known.
    """
    errors = (b.error for b in _usable_bands(sidecar) if b.error is not None)
    return max(errors, key=attrgetter("std_px"), default=None)


def _usable_bands(sidecar: Sidecar) -> list[BandResult]:
    """The moving bands of a capture that indices can use."""
    limit_px = sidecar.accept_predicted_px
    return [b for b in sidecar.bands if b.status != "reference" and b.is_usable(limit_px)]


def is_by_prediction(sidecar: Sidecar) -> bool:
    """Return True for a capture that is `ok`, but with a predicted band, which its own image did not confirm."""
    return sidecar.status == "ok" and any(b.status == "predicted" for b in sidecar.bands)


def unwritten_indices(sidecar: Sidecar, folder: Path, reports: Sequence[IndexReport]) -> Iterator[tuple[str, str]]:
    """Yield (name, reason) of the indices without a raster: those that the last rendering of the capture requested, and
    those that `agalign indices` could not write, given the folder of the sidecar and the reports of the capture.
    """
    problems = {report.index: report.problem for report in reports if report.path is None}
    written = {report.index for report in reports} - problems.keys()
    requested = (sidecar.options or {}).get("write", {}).get("indices", [])
    for name in dict.fromkeys([*map(str, requested), *problems]):
        if name not in written:
            before = f"when it was last calculated: {problems[name]}" if name in problems else _NO_RASTER
            yield name, _reason(name, sidecar, folder) or before


def _reason(name: str, sidecar: Sidecar, folder: Path) -> str:
    """Why an index cannot be calculated now; empty if it can, or if its formula is not known."""
    try:
        # The page may be opened elsewhere: files are relative to their capture.
        return reason_not_written(index_named(name), sidecar, folder).replace(f"{folder}{os.sep}", "")
    except ConfigurationError:  # a formula, or an index of another version
        return ""
