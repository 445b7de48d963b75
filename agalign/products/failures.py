"""The problems of a run, each cause once, with its remedy."""

from dataclasses import dataclass, field

from agalign.products.sidecar import BandResult, CaptureResult
from agalign.values.issues import MISSING_BAND, Remedy
from agalign.verify.checks import KINDS

_GRAVITY = {"failed": 0, "seed_only": 1, "missing": 2, "predicted": 3}
"""The worse comes first."""
_UNTOLD = Remedy("no reason was recorded", "run again with --overwrite")


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
    """The bands of a run with one status for one cause."""

    status: str
    remedy: Remedy
    bands: list[UnalignedBand] = field(default_factory=list)

    @property
    def advice(self) -> str:
        """The remedy, if something must be done."""
        if self.status != "predicted":
            return self.remedy.advice
        usable = "use those with a standard error of at most 1 px (prediction.std_px in the sidecar), as indices do"
        return f"{usable}; {self.remedy.advice}"

    @property
    def captures(self) -> int:
        """How many captures it happened to."""
        return len({b.capture for b in self.bands})


@dataclass
class FailureGroups:
    """All of a run, as its captures are added."""

    _by_cause: dict[tuple[str, Remedy], FailureGroup] = field(default_factory=dict)

    def add(self, label: str, result: CaptureResult) -> None:
        """One capture more."""
        for band in result.bands:
            if band.status not in ("reference", "aligned"):
                self._put(UnalignedBand(label, band.band, band.status, band.reason or ""), _remedy_of(band))
        for name in result.missing_bands:
            self._put(UnalignedBand(label, name, "missing", MISSING_BAND.cause), MISSING_BAND)

    def groups(self) -> list[FailureGroup]:
        """The gravest first, and of those the most frequent."""
        return sorted(self._by_cause.values(), key=lambda s: (_GRAVITY[s.status], -len(s.bands), s.remedy.cause))

    def _put(self, short: UnalignedBand, cause: Remedy) -> None:
        self._by_cause.setdefault((short.status, cause), FailureGroup(short.status, cause)).bands.append(short)


def _remedy_of(band: BandResult) -> Remedy:
    """The first issue is the one in `reason`."""
    return KINDS[band.issues[0].kind].remedy if band.issues else _UNTOLD
