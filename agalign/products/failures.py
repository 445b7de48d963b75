"""The bands of a run that are not aligned, grouped by cause, with a remedy for each cause."""

from dataclasses import dataclass, field

from agalign.products.sidecar import BandResult, CaptureResult
from agalign.values.issues import MISSING_BAND, Remedy
from agalign.verify.checks import KINDS

_SEVERITY = {"failed": 0, "seed_only": 1, "missing": 2, "predicted": 3}
"""Order of the statuses, the most severe first."""
_NO_REASON = Remedy("no reason was recorded", "run again with --overwrite")


@dataclass(frozen=True)
class UnalignedBand:
    """One band of one capture that is not aligned."""

    capture: str
    band: str
    status: str
    """`predicted`, `seed_only`, `failed`, or `missing`."""
    reason: str


@dataclass
class FailureGroup:
    """The bands of a run with the same status and the same cause."""

    status: str
    remedy: Remedy
    bands: list[UnalignedBand] = field(default_factory=list)

    @property
    def advice(self) -> str:
        """The remedy; for predicted bands, also when they may be used as they are."""
        if self.status != "predicted":
            return self.remedy.advice
        usable = "use those with a standard error of at most 1 px (prediction.std_px in the sidecar), as indices do"
        return f"{usable}; {self.remedy.advice}"

    @property
    def captures(self) -> int:
        """Number of captures with such a band."""
        return len({b.capture for b in self.bands})


@dataclass
class FailureGroups:
    """The groups of a run, whose captures are added one by one."""

    _by_cause: dict[tuple[str, Remedy], FailureGroup] = field(default_factory=dict)

    def add(self, label: str, result: CaptureResult) -> None:
        """Add the bands of a capture that are missing or not aligned."""
        for band in result.bands:
            if band.status not in ("reference", "aligned"):
                self._put(UnalignedBand(label, band.band, band.status, band.reason or ""), _remedy_of(band))
        for name in result.missing_bands:
            self._put(UnalignedBand(label, name, "missing", MISSING_BAND.cause), MISSING_BAND)

    def groups(self) -> list[FailureGroup]:
        """Return the groups, the most severe first, and the largest first of those."""
        return sorted(self._by_cause.values(), key=lambda g: (_SEVERITY[g.status], -len(g.bands), g.remedy.cause))

    def _put(self, band: UnalignedBand, remedy: Remedy) -> None:
        self._by_cause.setdefault((band.status, remedy), FailureGroup(band.status, remedy)).bands.append(band)


def _remedy_of(band: BandResult) -> Remedy:
    """The remedy of the first issue, which is the one in `reason`."""
    return KINDS[band.issues[0].kind].remedy if band.issues else _NO_REASON
