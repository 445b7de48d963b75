"""The rig of a flight: what the mappings of all bands have in common from capture to capture.

A plane induces between two cameras of a rig the homography H_b = A_b + e_b nu^T, with A_b and e_b the rig's and
nu = n / d, the ground's normal over its distance, the capture's (Hartley & Zisserman, Eq. 13.2). A rig that exposes its
bands one after another sees the ground move in between, by w times the band's delay. Around the flight's mean m_b that
is, at the pixel x of the reference,

    H_b(c) x = m_b(x) + t_b (nu_c . g(x)) + d_b w_c + residual

with t_b (2,) the direction of the band's lens in the rig, d_b its delay, and the capture's factors, which ALL its bands
share: nu_c (3,), over g = (1, u, v), the image's coordinates, scaled so that each has mean 0 and variance 1 over the
image (the ground's distance moves each band along its own baseline, its tilt does so in proportion to the position in
the image), and w_c (2,). The t_b together have length 1, and so have the d_b: the factors are in px.

Which of them count is decided by cross-validation (`learn_rig`): each capture is predicted from rigs learned on the
others, band by band from its other bands. The errors are the standard errors of predictions (`rig_prediction`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from agalign.values.alignment import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import MovingFilePx

Factor = Literal["distance", "tilt", "motion", "reference"]

FACTORS = 5
"""nu and w together."""
NO_FACTORS: tuple[float, ...] = (0.0,) * FACTORS
MIN_CAPTURES = 3
"""Two captures agree on something by chance too often."""


@dataclass(frozen=True)
class Observation:
    """The mappings of one capture, as its images show them."""

    seconds: float | None
    """When it was taken, from any beginning; None where that is unknown."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving by band, undistorted px of the files."""
    std_px: Mapping[str, MovingFilePx]
    """Standard error of each."""
    altitude_m: float | None = None
    """As the camera has it, above anything."""
    motion: tuple[float, float] | None = None
    """How fast the ground passes, right and down in the image, in any unit."""


@dataclass(frozen=True)
class CaptureFactors:
    """The factors of a capture that a rig was learned on."""

    seconds: float | None
    altitude_m: float | None
    motion: tuple[float, float] | None
    factors: tuple[float, ...]
    """(5,) nu and w, px."""


@dataclass(frozen=True)
class Rig:
    """The geometry of a flight's camera, as some of its captures show it."""

    size_px: tuple[int, int]
    """(width, height) of the reference's file."""
    mean: Mapping[str, Matrix]
    """fixed_to_moving by band."""
    baselines: Mapping[str, tuple[float, float]]
    """t_b by band."""
    delays: Mapping[str, float]
    """d_b by band."""
    baseline_std: Mapping[str, float]
    """Of either coordinate of t_b."""
    centres: Mapping[str, tuple[float, ...]]
    """Mean factors (5,) of the captures that showed a band: there its mean is best known."""
    factors: tuple[Factor, ...]
    """Which of them a capture adds."""
    captures: tuple[CaptureFactors, ...]
    """The captures that it was learned on, in their order."""
    from_bands_px: Mapping[str, MovingFilePx]
    """Root mean square error of each band in captures left out, predicted from their other bands. Everything of a band
    is in px of its own file.
    """
    extrapolation_px: Mapping[str, MovingFilePx] = field(default_factory=dict)
    """Root mean square error of a band's mean where no capture shows a quarter of the image: of the lens differences
    that a homography extrapolates. Bands that are shown everywhere are left out."""
    fields: Mapping[str, DisplacementField] = field(default_factory=dict)
    """What no homography explains and all captures have in common, raw px of the reference's file, by band."""

    def covers(self, band: str) -> bool:
        """True where captures show the band's mapping over the whole image."""
        return band in self.mean and band not in self.extrapolation_px
