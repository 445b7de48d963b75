"""The interface of a check: its input and its result."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol

from agalign.pixels.structure import Field
from agalign.values.alignment import JointResult, Prediction, Residual
from agalign.values.issues import Issue, IssueKind
from agalign.values.pixel_units import FixedPx, PixelScale


class AlignedImages(Protocol):
    """The two images of a result on one grid, for checks that use pixels."""

    @property
    def reduced_scale(self) -> PixelScale:
        """Scale of the reduced images relative to the fixed image."""

    def reduced_spectra(self) -> tuple[Field, Field]:
        """Windowed spectra (height, width) of the structures of the reduced fixed and moving images."""

    def is_expected(self, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """Return True if the mapping shifted by (x, y), px of the fixed image, agrees with tags, flight or user."""


@dataclass(frozen=True)
class Evidence(Generic[FixedPx]):
    """The input of the checks, on the grid of the images or of the files (`FixedPx`)."""

    joint: JointResult[FixedPx]
    residual: Residual[FixedPx]
    """Residual shifts of windows after alignment."""
    size_px: tuple[int, int]
    """(width, height) of the fixed image."""
    images: AlignedImages | None = None
    """None omits the checks that use pixels."""
    prediction: Prediction | None = None
    """Prediction by the rig, with the distance `off_px` of the result; None without a rig."""
    file_px: float = 1.0
    """Size of a pixel of the reference's file on this grid; the limits of residual shifts are in px of the file."""


@dataclass(frozen=True)
class Check:
    """One check: the kinds of issues that it defines and the function that returns them."""

    kinds: tuple[IssueKind, ...]
    issues: Callable[[Evidence[Any]], Iterable[Issue]]
    is_costly: bool = False
    """Run only if no other check returns an issue."""
