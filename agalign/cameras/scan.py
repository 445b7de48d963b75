"""Options and result of the search for captures below a folder."""

from dataclasses import dataclass
from pathlib import Path

from agalign.errors import AgalignError
from agalign.values.capture import Capture
from agalign.values.choices import MAX_PIXELS, BandOrder


@dataclass(frozen=True)
class DiscoverOptions:
    """Options of `discover`."""

    pattern: str | None = None
    """Pattern of file names of other cameras, as '{capture}_{band}.tif'."""
    reference: str | None = None
    """Name of the reference band; None for the default of the camera."""
    ignore_metadata: bool = False
    """Ignore lens and rig tags."""
    with_rgb: bool = False
    """Include the colour photographs that some cameras take with each multispectral capture, as three bands."""
    bands: tuple[str, ...] = ()
    """Names of the bands to include; empty for all."""
    order: BandOrder = "index"
    """Order of the bands in the stacks: as numbered by the camera, by wavelength, or by name."""
    skip: tuple[Path, ...] = ()
    """Folders to leave out, such as the output folder."""
    max_pixels: int = MAX_PIXELS
    """Images with more pixels are refused before they are read."""
    jobs: int = 1
    """Processes that read the tags of many files; with more than one the calling script must be importable."""
    include: tuple[str, ...] = ()
    """Globs of the files to use, by path below the folder or by name; empty for all."""
    exclude: tuple[str, ...] = ()
    """Globs of the files to leave out."""


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
