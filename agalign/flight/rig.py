"""The rig of a flight: a linear model of the mappings of all bands with few parameters (factors) per capture.

A plane induces the homography H_b = A_b + e_b nu^T between two cameras of a rig (Hartley & Zisserman, Eq. 13.2). A_b
and e_b are constants of the rig; nu = n / d, the plane's normal over its distance, differs between captures. If the
rig exposes its bands one after another, the image motion between exposures adds w times the delay of the band.
Linearised around the mean m_b of a flight, the mapping of band b in capture c at pixel x of the reference is

    H_b(c) x = m_b(x + t_b (nu_c . g(x)) + d_b w_c + residual)

t_b (2,) is the baseline direction of the band's lens and d_b its delay. The factors nu_c (3,) and w_c (2,) are common
to all bands of a capture. g = (1, u, v) are image coordinates, normalised to mean 0 and variance 1 over the image: a
change of distance shifts each band along its baseline, a tilt does so in proportion to the position in the image. All
t_b together have norm 1, as have all d_b, so the factors are in px. All lengths are px of the reference's file, so that
they do not depend on the size of a band's pixels.

The difference between two mappings of a band is expressed as coefficients (2, 3) of g, in px; their norm is the RMS
distance over the image. The model is bilinear: least squares alternate between the factors of captures and the
parameters of bands. Cross-validation selects the factors (`learn_rig`): each band of a capture is predicted from its
other bands by a rig learned without the capture. The RMS of these errors is the standard error of predictions
(`rig_prediction`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.least_squares import Estimate, Robust, least_squares
from agalign.values.mapping import DisplacementField

Array = NDArray[np.float64]
Factor = Literal["distance", "tilt", "motion", "reference"]

FACTORS = 5
"""Number of elements of nu and w together."""
NU, W = slice(0, 3), slice(3, 5)
"""Their elements among the factors of a capture."""
_COLUMNS: Mapping[Factor, tuple[int, ...]] = {
    "distance": (0,),
    "tilt": (1, 2),
    "motion": (3, 4),
    "reference": (3, 4),  # a motion of all moving bands relative to the reference
}
MIN_CAPTURES = 3
"""Fewer captures agree by chance too often: for a rig, for the variation of a factor over the flight, and for the
rectangle of a flight."""
FACTOR_STD_PX = (20.0, 3.0, 3.0, 20.0, 20.0)
"""Standard deviations of the prior of a capture's factors (5,); wide, to allow heights outside the learned range."""
MIN_STD_PX = 0.05
"""Added in quadrature to the standard error of a mapping, which does not contain all errors."""


@dataclass(frozen=True)
class Observation:
    """The mappings of one capture that were estimated from its images."""

    seconds: float | None
    """Capture time, from any origin; None if unknown."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving by band, undistorted px of the files."""
    std_px: Mapping[str, float]
    """Standard error of each mapping, RMS over the image, px of the reference's file."""
    altitude_m: float | None = None
    """Altitude in the tags, above any datum; None if unknown."""
    motion: tuple[float, float] | None = None
    """Velocity of the ground in the image (right, down), in any unit; None if unknown."""
    parallax_px: Mapping[str, float] = field(default_factory=dict)
    """RMS displacement by the relief of the capture, for bands that have one, px of the reference's file."""


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
    """The geometry of a flight's camera; lengths are in px of the reference's file."""

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
    from_bands_px: Mapping[str, float]
    """RMS error by band of predictions from the other bands, in captures that were left out."""
    extrapolation_px: Mapping[str, float] = field(default_factory=dict)
    """RMS error by band of the mean mapping, for bands with parts of the image that no window observes, into which the
    homography extrapolates unknown lens shapes."""
    parallax_px: Mapping[str, float] = field(default_factory=dict)
    """RMS displacement by band by the reliefs of the captures, which a homography does not contain."""
    fields: Mapping[str, DisplacementField] = field(default_factory=dict)
    """Displacement field by band that all captures have in common and no homography represents, raw px of the
    reference's file."""

    def design(self, band: str) -> Array:
        """Return (2, 3, 5) the derivative of a band's coefficients by the factors; 0 for unused factors."""
        return np.tensordot([*self.baselines[band], self.delays[band]], design_tensor(self.factors), 1)

    def baseline_design(self, band: str) -> Array:
        """Return (2, 1) or (2, 3) the derivative of the baseline of a band's lens by the length of all baselines, and
        with delays by the vector along which they are orthogonal to the delays.
        """
        baseline = np.array(self.baselines[band])[:, None]
        return np.hstack([baseline, self.delays[band] * np.eye(2)]) if has_delays(self.factors) else baseline

    def mapping(self, band: str, factors: Array) -> Matrix:
        """Return the mapping of a band for the factors (5,) of a capture."""
        return displaced(self.mean[band], self.design(band) @ factors, self.size_px)

    def magnification(self, band: str) -> float:
        """Return the pixels of a band per pixel of the reference."""
        return geometry.magnification(self.mean[band], *self.size_px)

    def covers(self, band: str) -> bool:
        """Return True if windows in all parts of the image determine the lens of the band."""
        return band in self.mean and band not in self.extrapolation_px


def has_delays(factors: Sequence[Factor]) -> bool:
    """Return True if the delays are part of the model."""
    return "motion" in factors or "reference" in factors


def design_tensor(factors: Sequence[Factor]) -> Array:
    """Return (3, 2, 3, 5) the bilinear model: coefficients of (t_x, t_y, d) times the factors (5,), 0 if not used."""
    result = np.zeros((3, 2, 3, FACTORS))
    result[0, 0, :, NU] = result[1, 1, :, NU] = np.eye(3)
    result[2, :, 0, W] = np.eye(2)
    return result * np.isin(range(FACTORS), [column for factor in factors for column in _COLUMNS[factor]])


def capture_factors(design: Array, differences: Array, weights: Array) -> Estimate:
    """Estimate the factors (n, 5) of n captures and their covariances (n, 5, 5), with few outliers among the mappings.

    `differences` (n, k, 2, 3) are the coefficients of the mappings of k bands minus the mean, px, and `design`
    (k, 2, 3, 5) their derivative with respect to the factors. `weights` (n, k) are from `mapping_weight`, 0 without a
    mapping. The residuals are divided by the errors of the mappings, relative to an accurate one.
    """
    # Residual of an accurate mapping at which its robust weight is one half; others are scaled by their errors.
    half_weight_px = 0.3
    scale = (1 + 1 / np.maximum(weights * half_weight_px**2, 1e-12)) ** -0.5
    by_mapping = design.reshape(len(design), 6, FACTORS), differences.reshape(*weights.shape, 6)
    scaled = scale[..., None, None] * by_mapping[0], scale[..., None] * by_mapping[1]
    information = np.diag(1 / np.square(FACTOR_STD_PX))
    return least_squares(*scaled, weights / scale**2, information, robust=Robust(half_weight_px))


def mapping_weight(std_px: ArrayLike, model_error_px: ArrayLike = 0.0) -> Array:
    """Return the weights (n,), 1 / px^2, of mappings from their standard errors (n,) and the error of the model, px.

    These are RMS lengths over the image; the largest variance of a coefficient is half of their square, if the whole
    error is a translation.
    """
    return np.asarray(2 / (np.square(std_px) + np.square(model_error_px) + MIN_STD_PX**2))


def expected_square(mean_square: ArrayLike, count: ArrayLike) -> Array:
    """Return the mean squares (n,) to expect of further errors from those of `count` (n,) ones: few may be small by
    chance. A single one, of which nothing is to be expected, has the factor of two errors, which is 3.
    """
    number = np.maximum(np.asarray(count, np.float64), 2)
    return np.asarray(np.asarray(mean_square) * (number + 1) / (number - 1))


def lattice(size_px: tuple[int, int]) -> tuple[Points, Array]:
    """Return the points (35, 2) of an image (width, height) at which mappings are compared, and g = (1, u, v), (35, 3).

    u and v have mean 0 and variance 1.
    """
    points = geometry.lattice(*size_px, 7, 5)
    return points, np.column_stack([np.ones(len(points)), (points - points.mean(axis=0)) / points.std(axis=0)])


def affine_difference(mean: Matrix, mapping: Matrix, size_px: tuple[int, int]) -> Array:
    """Return (2, 3) coefficients of the affine part of the displacement that precedes the mean in a mapping, px."""
    points, g = lattice(size_px)
    difference_px = geometry.apply(geometry.compose(geometry.invert(mean), mapping), points) - points
    return np.asarray(np.linalg.lstsq(g, difference_px, rcond=None)[0].T)


def displaced(mean: Matrix, coefficients: Array, size_px: tuple[int, int]) -> Matrix:
    """Return the mapping with a displacement of coefficients (2, 3); the inverse of `affine_difference`."""
    points, g = lattice(size_px)
    return geometry.fit_homography(points, geometry.apply(mean, points + g @ coefficients.T))


def distance_px(one: Matrix, other: Matrix, size_px: tuple[int, int]) -> float:
    """Return the RMS distance between two homographies over an image (width, height), px of the moving file."""
    points, _ = lattice(size_px)
    difference_px = geometry.apply(one, points) - geometry.apply(other, points)
    return float(np.sqrt((difference_px**2).sum(axis=1).mean()))


def median_mapping(matrices: Sequence[Matrix], size_px: tuple[int, int]) -> Matrix:
    """Return the homography fitted to the coordinatewise median of the mapped lattice points."""
    if len(matrices) == 1:
        return matrices[0]
    points, _ = lattice(size_px)
    return geometry.fit_homography(points, np.median([geometry.apply(m, points) for m in matrices], axis=0))
