"""What the stages of a capture cost."""

import time
from collections import defaultdict
from collections.abc import Mapping

from agalign.capture.align import PairProgress


class StageClock:
    """Hands progress on, and books the time between two reports to the stage that the first of them began."""

    def __init__(self, progress: PairProgress) -> None:
        self._progress = progress
        self._seconds: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._current: tuple[str, str] | None = None
        self._since = self._started = time.perf_counter()

    def __call__(self, band: str, stage: str, share: float) -> None:
        """As `PairProgress` has it."""
        if (band, stage) != self._current:
            self._book()
            self._current = band, stage
        self._progress(band, stage, share)

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.perf_counter() - self._started

    def stages(self) -> Mapping[tuple[str, str], float]:
        """Seconds by (band, stage), the one that lasts still included."""
        self._book()
        return dict(self._seconds)

    def _book(self) -> None:
        now = time.perf_counter()
        if self._current is not None:
            self._seconds[self._current] += now - self._since
        self._since = now
