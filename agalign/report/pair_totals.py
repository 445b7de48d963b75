"""The band pairs of a run: their number by status, what to check in them, and which ones indices can use, with their
expected error.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import NamedTuple

from agalign.host.text import counted
from agalign.records.cautions import Caution, RunFacts
from agalign.records.sidecar import Sidecar
from agalign.report.light_over_captures import LightOverCaptures
from agalign.values.remedies import NO_RESULT, OTHER_REFERENCE, Remedy


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


@dataclass(frozen=True)
class CautionGroup:
    """The bands of a run with the same status and the same cause for a check."""

    status: str
    remedy: Remedy
    bands: Sequence[Caution]
    effect: float
    """Share of the values of all bands of the run that are missing, displaced or wrong, by `Caution.lost`."""

    @property
    def size(self) -> str:
        """How large it is, in words; empty if it has no size."""
        return max(self.bands, key=attrgetter("size")).size_text

    @property
    def advice(self) -> str:
        """The remedy; for predicted bands, also when they may be used as they are."""
        if self.status != "predicted":
            return self.remedy.advice
        usable = "indices use those with an expected error (prediction.std_px, px of the band) up to --accept-predicted"
        return f"{usable}; {self.remedy.advice}"

    @property
    def captures(self) -> int:
        """Number of captures with such a band."""
        return sum({b.capture: b.captures for b in self.bands}.values())

    @property
    def pairs(self) -> int:
        """Number of its bands, each counted in every capture."""
        return sum(b.captures for b in self.bands)

    @property
    def count(self) -> str:
        """The number of its bands and captures, in words."""
        captures = counted(self.captures, "capture")
        return captures if self.status == "no_result" else f"{counted(self.pairs, 'band')} of {captures}"


@dataclass
class BandTotals:
    """One band over all captures."""

    statuses: Counter[str] = field(default_factory=Counter)
    """Number of captures by the status of the band."""
    residuals_px: list[float] = field(default_factory=list)
    """Of the captures in which it is aligned."""
    offsets_px: list[float] = field(default_factory=list)
    """Lengths of its offset between the raw files; for the report only."""
    seconds: list[float] = field(default_factory=list)
    """Processing times."""
    errors_px: list[float] = field(default_factory=list)
    """Expected errors of the captures in which indices can use it, px of the reference."""
    largest: ExpectedError | None = None
    """The largest of them."""


@dataclass
class PairTotals:
    """The band pairs of a run, and what to check in them. Captures are added one by one, and not kept, which limits
    memory.
    """

    run: RunFacts = field(default_factory=RunFacts)
    bands: dict[str, BandTotals] = field(default_factory=lambda: defaultdict(BandTotals))
    usable: Counter[str] = field(default_factory=Counter)
    """Number of moving bands that indices can use by status: aligned, or predicted with an accepted expected error.
    """
    _cautions: list[Caution] = field(default_factory=list)
    _references: list[tuple[str, tuple[str, ...], str, set[str]]] = field(default_factory=list)
    """(capture, flight, reference band, its other bands with the missing ones)."""
    _votes: dict[tuple[str, ...], Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """By flight, the number of captures that have a band as the reference, or lack it."""
    _light: LightOverCaptures = field(default_factory=LightOverCaptures)

    def add(self, label: str, result: Sidecar) -> list[Caution]:
        """Add the bands of a capture, and return the cautions about them."""
        parts = {b.band: b for b in result.bands}
        for name, status, _ in result.pairs:
            band, part = self.bands[name], parts.get(name)
            band.statuses[status] += 1
            band.seconds += [] if part is None else [part.seconds]
            if status == "aligned" and part and part.metrics and math.isfinite(part.metrics.after.residual_px):
                band.residuals_px.append(part.metrics.after.residual_px)
        for part in result.usable:
            self.usable[str(part.status)] += 1
            if (error := part.error) is not None:
                band = self.bands[part.band]
                band.errors_px.append(error.std_px)
                if band.largest is None or error.std_px > band.largest.std_px:
                    share = part.share_over_1_px
                    band.largest = ExpectedError(error.std_px, error.other_px, label, part.band, share)
        camera, reference = result.camera, result.reference.band
        of_light = self._light.add(label, f"{camera.name} {camera.unit}", result.captured_at, result.output)
        cautions = [replace(c, capture=label) for c in (*self.run.cautions(result, label), *of_light)]
        self._cautions += cautions
        flight = (camera.name, camera.unit, result.flight_id, "" if camera.model else Path(label).parent.as_posix())
        self._references.append((label, flight, reference, {name for name, _, _ in result.pairs}))
        self._votes[flight].update((reference, *result.missing_bands))
        return cautions

    @property
    def statuses(self) -> Counter[str]:
        """Number of pairs by status, with those of missing bands."""
        return sum((band.statuses for band in self.bands.values()), Counter())

    @property
    def captures(self) -> set[str]:
        """Labels of the captures."""
        return {label for label, *_ in self._references}

    @property
    def unusable_captures(self) -> set[str]:
        """Labels of the captures with a band whose values are too uncertain for any use."""
        return {caution.capture for caution in self._cautions if caution.is_unusable}

    @property
    def largest(self) -> ExpectedError | None:
        """The largest expected error of a usable band, px of the reference; None if none is known."""
        known = (band.largest for band in self.bands.values() if band.largest is not None)
        return max(known, key=attrgetter("std_px"), default=None)

    @property
    def median_px(self) -> float | None:
        """Median of the expected errors of the usable bands, px of the reference; None if none is known."""
        errors_px = [px for band in self.bands.values() for px in band.errors_px]
        return median(errors_px) if errors_px else None

    @property
    def unknown(self) -> int:
        """Number of usable bands without a known expected error."""
        return self.usable.total() - sum(len(band.errors_px) for band in self.bands.values())

    @property
    def unusable(self) -> list[str]:
        """The numbers of moving bands that indices cannot use, in words."""
        statuses = self.statuses
        counts = {"predicted with a larger error": statuses["predicted"] - self.usable["predicted"]}
        counts |= {status.replace("_", " "): statuses[status] for status in ("seed_only", "failed", "missing")}
        return [f"{count} {word}" for word, count in counts.items() if count]

    def _other_references(self, lost: float) -> Iterator[Caution]:
        """Yield the captures whose reference differs from that of most captures of their flight. All their values are
        displaced from those of the others; `lost` is the number of bands of a capture.
        """
        used: dict[tuple[str, ...], set[str]] = defaultdict(set)
        for _, flight, band, _ in self._references:
            used[flight].add(band)
        # A band that all captures lack has their votes, and is the reference of none.
        usual = {f: next(b for b, _ in votes.most_common() if b in used[f]) for f, votes in self._votes.items()}
        for label, flight, band, others in self._references:
            if usual[flight] in others:
                reason = f"on the grid of {band}; most captures of the flight are on that of {usual[flight]}"
                yield Caution(band, OTHER_REFERENCE, reason, lost, status="other_reference", capture=label)

    def groups(self, without_result: Sequence[str] = ()) -> list[CautionGroup]:
        """Return what to check, by cause, the largest effect first: the cautions about bands, the captures with another
        reference than most of their flight, and those without a result, given by label.
        """
        pairs = self.statuses.total()
        pairs_per_capture = pairs / max(1, len(self._references))
        pairs_without_result = max(1.0, pairs_per_capture)
        by_cause: dict[tuple[str, Remedy], list[Caution]] = defaultdict(list)
        for caution in (*self._cautions, *self._other_references(pairs_per_capture), *self._light.uneven()):
            by_cause[caution.status, caution.remedy].append(caution)
        for label in without_result:
            lost = Caution("", NO_RESULT, NO_RESULT.cause, pairs_without_result, status="no_result", capture=label)
            by_cause[lost.status, lost.remedy].append(lost)
        values = max(1.0, pairs + pairs_without_result * len(without_result))
        groups = [CautionGroup(*cause, bands, sum(b.lost for b in bands) / values) for cause, bands in by_cause.items()]
        severity = "no_result", "failed", "seed_only", "missing", "other_reference", "predicted", "check"
        return sorted(groups, key=lambda g: (-g.effect, severity.index(g.status), -g.pairs, g.remedy.cause))
