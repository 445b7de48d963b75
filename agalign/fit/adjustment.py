"""The adjustment of all bands of a capture to the shifts of windows, with the parallax that they have in common.

The model is that of `window_fit`, where the parallax z of each window is unknown too: a rank-1 factorisation (Irani
2002). `adjust` fits it by alternating least squares: z is determined before f, so that f only contains what no common
parallax explains.

Two ambiguities are removed. A plane a + b x + c y added to z is equivalent to other homographies of all bands: z is 0
on the plane that contains most windows. The scale of z is free: the longest baseline has length 1. If the lens layout
is known, positive parallax is nearer to the camera. Else its mean is positive, as most objects are nearer than the
plane, until occlusions show the opposite (`dense.nearer_sign`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.fit.window_fit import CAUCHY_SCALES, CORNER_STD_PX, BaselinePrior, WindowFit, with_parallax
from agalign.values.geometry import Points
from agalign.values.least_squares import MIN_SHIFT_SCALE_PX, Robust, cauchy_weights, least_squares, shift_scale_px
from agalign.values.lens_shapes import CORNERS, jacobian, shift_variance_px2
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Relief
from agalign.values.pixel_units import PixelScale
from agalign.values.residual import Residual, peak_weights

Array = NDArray[np.float64]

_RELIEF_STEP_PX = 32
"""Spacing of a relief by windows."""
_ALTERNATIONS = 12
"""Enough for the baselines to converge to a relative change of 0.001."""
_NOISE_PX = 0.1
"""Scale of the residuals of windows before the first fit."""
_MIN_INFORMATION = 0.01
"""Weight of zero parallax, relative to one window of one band; matters only where no window contributes."""


@dataclass(frozen=True)
class WindowShifts:
    """The shifts of the same windows in all bands, undistorted px of the reference."""

    centres_px: Points
    """(n, 2) of the windows, raw px."""
    points_px: Points
    """(n, 2) of the windows, undistorted px."""
    shifts_px: Array
    """(n, bands, 2) relative to the planes and the lenses of the tags or the rig, NaN where not measured."""
    weights: Array
    """(n, bands), median 1; 0 where not measured."""

    @classmethod
    def of(
        cls, residuals: Sequence[Residual], mappings: Sequence[PixelMapping], *, with_lens_shapes: bool = False
    ) -> "WindowShifts":
        """Collect the windows of each band, measured with its mapping; all bands have the same grid of windows.

        The displacements by the relief of the mappings are part of the shifts, and `with_lens_shapes` those by their
        fields.
        """
        cells = np.concatenate([r.cells for r in residuals])
        _, first, index = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        centres_px = np.concatenate([r.centres_px for r in residuals])[first]
        index_of_band = np.split(index.reshape(-1), np.cumsum([len(r.cells) for r in residuals])[:-1])
        shifts, peaks = np.full((len(first), len(residuals), 2), np.nan), np.zeros((len(first), len(residuals)))
        for band, (residual, mapping) in enumerate(zip(residuals, mappings, strict=True)):
            measured = residual.is_measured
            if not measured.any():
                continue
            xy, rows = residual.centres_px[measured], index_of_band[band][measured]
            shifts[rows, band] = mapping.undistorted(xy + residual.shifts_px[measured]) - mapping.undistorted(xy)
            if mapping.parallax is not None:
                shifts[rows, band] += mapping.parallax.relief(xy)[:, None] * np.array(mapping.parallax.baseline)
            if with_lens_shapes and mapping.field is not None:
                shifts[rows, band] += mapping.field(xy)
            peaks[rows, band] = residual.peaks_sigma[measured]
        points = mappings[0].without_parallax.undistorted(centres_px)
        return cls(centres_px, points, shifts, peak_weights(peaks))

    def __len__(self) -> int:
        return len(self.points_px)

    def are_enough(self, minimum: int) -> bool:
        """Return True if at least `minimum` windows are measured in each band."""
        return len(self) > 0 and int((self.weights > 0).sum(axis=0).min()) >= minimum

    def relief(self, parallax_px: Array, size_px: tuple[int, int]) -> Relief:
        """Return the parallax (n,) of the windows as a relief of a reference (width, height): that of the nearest."""
        shape = size_px[1] // _RELIEF_STEP_PX, size_px[0] // _RELIEF_STEP_PX
        scale = PixelScale.between(size_px, shape[::-1])
        centres_px = scale.inverse.positions(np.indices(shape)[::-1].reshape(2, -1).T.astype(np.float64))
        nearest = parallax_px[cKDTree(self.centres_px).query(centres_px)[1]].reshape(shape).astype(np.float32)
        return Relief(nearest, np.ones_like(nearest), scale)

    def shifts_of(self, residual: Residual, shifts_px: Array) -> Array:
        """Select from the shifts (n, 2) of all windows those of the windows of a band."""
        return np.asarray(shifts_px[cKDTree(self.centres_px).query(residual.centres_px)[1]])

    def of_bands(self, bands: Sequence[int]) -> "WindowShifts":
        """Select bands by index."""
        return replace(self, shifts_px=self.shifts_px[:, bands], weights=self.weights[:, bands])


@dataclass(frozen=True)
class Adjustment:
    """The adjusted model of a capture."""

    fits: Sequence[WindowFit]
    """Of each band; the longest baseline has length 1."""
    parallax_px: Array
    """(n,) parallax of the windows."""
    scales_px: Array
    """(bands,) robust scales of the residuals, `shift_scale_px`."""

    @property
    def baselines(self) -> Array:
        """(bands, 2) t_b."""
        return np.array([fit.baseline for fit in self.fits])


def adjust(
    windows: WindowShifts, size_px: tuple[int, int], layout: Array | None = None, lens_std_px: Array | None = None
) -> Adjustment | None:
    """Fit the model to the windows of a capture; None if the baselines are unknown.

    `size_px` is (width, height) of the reference. `layout` (bands, 2) are the known directions, in any unit, in which
    points move in the bands when the scene comes nearer; they initialise the baselines and determine their sign.
    Without a layout, two windows for each band that are measured in all bands initialise them.
    Lens shapes are fitted with the standard deviations `lens_std_px` (4,).
    """
    initial = _initial_baselines(windows) if layout is None else layout
    if initial is None or not np.linalg.norm(initial, axis=1).max() > 0:
        return None
    baselines = initial / np.linalg.norm(initial, axis=1).max()
    smooth_std_px = np.r_[np.full(CORNERS, CORNER_STD_PX), [] if lens_std_px is None else lens_std_px]
    count = len(smooth_std_px)
    design = jacobian(windows.points_px, size_px, count)
    prior = np.diag(np.r_[smooth_std_px, [BaselinePrior().std] * 2] ** -2)
    # (n, 3) = (1, u, v) with u and v from -1 to 1 across the image.
    plane = np.column_stack([np.ones(len(windows)), 2 * windows.points_px / np.asarray(size_px) - 1])
    shifts, weights = np.nan_to_num(windows.shifts_px), windows.weights
    smooth, scales = np.zeros((len(baselines), count)), np.full(len(baselines), _NOISE_PX)
    for _ in range(_ALTERNATIONS):
        relative = shifts - np.einsum("nki,bi->nbk", design, smooth)
        # A band worse than the median has the weight of its variance, so that it does not determine the parallax.
        precisions = np.minimum(1, (np.median(scales) / scales) ** 2)
        parallax, of_windows = _parallax(relative, baselines, weights * precisions)
        parallax = parallax - plane @ _reference_plane(parallax, plane, of_windows)
        absolute = weights.T / shift_variance_px2(scales)[:, None]
        by_band = least_squares(with_parallax(design, parallax), shifts.swapaxes(0, 1), absolute, prior)
        smooth, baselines = by_band.mean[:, :count], by_band.mean[:, count:]
        longest = np.linalg.norm(baselines, axis=1).max()
        if not longest > 0:
            return None
        baselines, parallax = baselines / longest, parallax * longest
        residuals = np.where(windows.weights.T > 0, by_band.residuals, np.nan)
        scales = np.array([shift_scale_px(r[np.isfinite(r)]) for r in residuals])
        weights = windows.weights * np.nan_to_num(cauchy_weights(residuals.T, CAUCHY_SCALES * scales))
    if (parallax.mean() if layout is None else np.sum(baselines * layout)) < 0:
        baselines, parallax = -baselines, -parallax
    of_bands = zip(np.hstack([smooth, baselines]), residuals, by_band.covariance, strict=True)
    fits = [WindowFit.of(mean, r, size_px, covariance, count) for mean, r, covariance in of_bands]
    return Adjustment(fits, parallax, scales)


def are_of_lenses(baselines: Array, layout: Array | None) -> bool:
    """Return True if baselines (bands, 2) are plausible for lenses with a layout (bands, 2), None if unknown.

    Noise of the reference shifts the windows of all bands equally. It resembles parallax that is common to the bands,
    but all baselines are nearly equal, which those of different lenses are not. Equal baselines resemble the layout of
    lenses on one side of the reference, but it must be more similar to them than their mean is.
    """
    if layout is not None:
        min_cosine = 0.8  # measured: 0.998 for scenes with depth, up to 0.55 for noise
        of_mean = _cosine(baselines, np.broadcast_to(baselines.mean(axis=0), baselines.shape))
        return _cosine(baselines, layout) >= max(min_cosine, of_mean)
    lengths = np.linalg.norm(baselines, axis=1)
    from_mean = np.linalg.norm(baselines - baselines.mean(axis=0), axis=1)
    min_spread = 0.3  # at least 0.5 for real cameras, at most 0.2 for a blurred reference
    return bool(from_mean.max() >= min_spread * lengths.max() > 0)


def _cosine(baselines: Array, others: Array) -> float:
    """Return the cosine similarity of baselines (bands, 2) and others; 0 if either are all zero."""
    norms = np.linalg.norm(baselines) * np.linalg.norm(others)
    return float(np.sum(baselines * others) / norms) if norms > 0 else 0.0


def are_on_a_line(baselines: Array) -> bool:
    """Return True if baselines (bands, 2) have one direction.

    Those of lenses in a row do too, but edges of shadows and leaves in blurred bands, or rows in the wind, also move
    along one direction, by a different length in each band.
    """
    longest, shortest = np.linalg.svd(baselines, compute_uv=False)[[0, -1]]
    min_ratio = 0.15  # of baselines that are not on one line: 0.22 to 0.5 for cameras
    return bool(shortest < min_ratio * longest)


def parallax_of(residual_px: Array, baselines: Array, weights: Array) -> Array:
    """Return the parallax (n,) of windows from their shifts (n, bands, 2) relative to the homographies.

    `baselines` are (bands, 2), `weights` (n, bands). The parallax is 0 for windows without information.
    """
    return _parallax(np.nan_to_num(residual_px), baselines, weights)[0]


def _initial_baselines(windows: WindowShifts) -> Array | None:
    """Return (bands, 2) the first right singular vector of the shifts of windows that are measured in all bands."""
    complete = (windows.weights > 0).all(axis=1)
    if complete.sum() < 2 * windows.weights.shape[1]:
        return None
    shifts = windows.shifts_px[complete].reshape(int(complete.sum()), -1)
    shifts = shifts - np.median(shifts, axis=0)
    max_medians = 5.0  # larger shifts are clipped, so that outliers do not determine the initial estimate
    limit = max_medians * np.median(np.abs(shifts)) + MIN_SHIFT_SCALE_PX
    _, _, right = np.linalg.svd(np.clip(shifts, -limit, limit), full_matrices=False)
    return np.asarray(right[0].reshape(-1, 2))


def _parallax(residual_px: Array, baselines: Array, weights: Array) -> tuple[Array, Array]:
    """Return the parallax (n,) by weighted least squares along the baselines, and its information (n,)."""
    projection = (weights * np.einsum("nbk,bk->nb", residual_px, baselines)).sum(axis=1)
    information = (weights * (baselines**2).sum(axis=1)).sum(axis=1)
    return projection / (information + _MIN_INFORMATION), information


def _reference_plane(parallax: Array, plane: Array, information: Array) -> Array:
    """Return the coefficients (3,) in (1, u, v) of the plane of most windows: an M-estimate from their median."""
    min_information = 0.2  # sum of weights times squared baselines for the parallax of a window to be known
    half_weight_px = 0.5  # distance from the plane at which the robust weight of a window is one half
    known = (information > min_information).astype(float)
    median, damping = np.array([np.median(parallax), 0.0, 0.0]), 1e-6 * np.eye(3)
    near_median = known * cauchy_weights(parallax - median[0], half_weight_px)
    by_window = plane[:, None], parallax[:, None], known
    return least_squares(*by_window, damping, median, robust=Robust(half_weight_px), first_weights=near_median).mean
