"""Result of the search for captures below a folder."""

from dataclasses import dataclass
from pathlib import Path

from agalign.errors import AgalignError
from agalign.values.capture import Capture


@dataclass(frozen=True)
class Problem:
    """A file or capture that is left out, and the reason."""

    path: Path
    error: AgalignError

    @property
    def text(self) -> str:
        """The message, one line with the file and the remedy."""
        return str(self.error)


@dataclass(frozen=True)
class FolderScan:
    """The captures and the problems below a folder."""

    folder: Path
    captures: tuple[Capture, ...]
    problems: tuple[Problem, ...]

    @property
    def eight_bit(self) -> tuple[Capture, ...]:
        """The captures with a file per band and 8 bits per pixel in each band."""
        return tuple(
            c for c in self.captures
            if len({b.path for b in c.bands}) > 1 and all(b.dtype == "uint8" for b in c.bands)
            and not any(b.one_lens for b in c.bands)
        )  # fmt: skip
