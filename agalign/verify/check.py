"""The interface of a check: what it may look at, and what it returns."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol

from agalign.pixels.structure import Field
from agalign.values.alignment import JointResult, Prediction, Residual
from agalign.values.issues import Issue, IssueKind
from agalign.values.pixel_units import FixedPx, PixelScale


class AlignedImages(Protocol):
    """The two images of a result on one grid, for checks that need pixels."""

    @property
    def reduced_scale(self) -> PixelScale:
        """Scale of the reduced images relative to the fixed image."""

    def reduced_spectra(self) -> tuple[Field, Field]:
        """Windowed spectra (height, width) of the structure of the reduced fixed image, and of the moving image."""

    def is_expected(self, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """True where tags, flight or user expect the mapping after a shift (x, y), px of the fixed image."""


@dataclass(frozen=True)
class Evidence(Generic[FixedPx]):
    """Everything that checks may look at, on the grid of the images or of the files (`FixedPx`)."""

    joint: JointResult[FixedPx]
    residual: Residual[FixedPx]
    """The windows under the result."""
    size_px: tuple[int, int]
    """(width, height) of the fixed image."""
    images: AlignedImages | None = None
    """None leaves out the checks that need pixels."""
    prediction: Prediction | None = None
    """With `off_px`, how far the result is from it; None without a rig."""
    file_px: float = 1.0
    """Length of a pixel of the reference's file on this grid: residual shifts are limited in px of the file."""


@dataclass(frozen=True)
class Check:
    """One check: the kinds of issues that it defines and the function that finds them."""

    kinds: tuple[IssueKind, ...]
    issues: Callable[[Evidence[Any]], Iterable[Issue]]
    is_costly: bool = False
    """Runs only where no other check has found an issue."""
