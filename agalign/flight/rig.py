"""The rig of a flight: a linear model of the mappings of all bands with few parameters (factors) per capture.

A plane induces the homography H_b = A_b + e_b nu^T between two cameras of a rig (Hartley & Zisserman, Eq. 13.2). A_b
and e_b are constants of the rig; nu = n / d, the plane's normal over its distance, differs between captures. If the
rig exposes its bands one after another, the image motion between exposures adds w times the delay of the band.
Linearised around the mean m_b of a flight, the mapping of band b in capture c at pixel x of the reference is

    H_b(c) x = m_b(x) + t_b (nu_c . g(x)) + d_b w_c + residual

t_b (2,) is the baseline direction of the band's lens and d_b its delay. The factors nu_c (3,) and w_c (2,) are common
to all bands of a capture. g = (1, u, v) are image coordinates, normalised to mean 0 and variance 1 over the image: a
change of distance shifts each band along its baseline, a tilt does so in proportion to the position in the image. All
t_b together have norm 1, as have all d_b, so the factors are in px.

Cross-validation selects the factors (`learn_rig`): each band of a capture is predicted from its other bands by a rig
learned without the capture. The RMS of these errors is the standard error of predictions (`rig_prediction`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import MovingFilePx

Factor = Literal["distance", "tilt", "motion", "reference"]

FACTORS = 5
"""Number of elements of nu and w together."""
MIN_CAPTURES = 3
"""Fewer captures agree by chance too often."""


@dataclass(frozen=True)
class Observation:
    """The mappings of one capture that were estimated from its images."""

    seconds: float | None
    """Capture time, from any origin; None if unknown."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving by band, undistorted px of the files."""
    std_px: Mapping[str, MovingFilePx]
    """Standard error of each mapping."""
    altitude_m: float | None = None
    """Altitude in the tags, above any datum; None if unknown."""
    motion: tuple[float, float] | None = None
    """Velocity of the ground in the image (right, down), in any unit; None if unknown."""


@dataclass(frozen=True)
class CaptureFactors:
    """The factors of a capture from which a rig was learned."""

    seconds: float | None
    altitude_m: float | None
    motion: tuple[float, float] | None
    factors: tuple[float, ...]
    """(5,) nu and w, px."""


@dataclass(frozen=True)
class Rig:
    """The geometry of a flight's camera; lengths of a band are in px of its own file."""

    size_px: tuple[int, int]
    """(width, height) of the reference's file."""
    mean: Mapping[str, Matrix]
    """Mean fixed_to_moving by band, undistorted px of the files."""
    baselines: Mapping[str, tuple[float, float]]
    """t_b by band."""
    delays: Mapping[str, float]
    """d_b by band."""
    baseline_std: Mapping[str, float]
    """Standard error of each coordinate of t_b, by band."""
    factors: tuple[Factor, ...]
    """The factors that cross-validation selected."""
    captures: tuple[CaptureFactors, ...]
    """The captures from which the rig was learned, in their order."""
    from_bands_px: Mapping[str, MovingFilePx]
    """RMS error by band of predictions from the other bands, in captures that were left out."""
    extrapolation_px: Mapping[str, MovingFilePx] = field(default_factory=dict)
    """RMS error by band of the mean mapping, for bands without an observed quarter of the image, into which the
    homography extrapolates differences of lens distortion."""
    fields: Mapping[str, DisplacementField] = field(default_factory=dict)
    """Displacement field by band that all captures have in common and no homography represents, raw px of the
    reference's file."""

    def covers(self, band: str) -> bool:
        """Return True if the mapping of the band was observed in all parts of the image."""
        return band in self.mean and band not in self.extrapolation_px
