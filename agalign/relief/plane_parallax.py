"""Plane + parallax from the residual shifts of windows: homography and baseline per band, parallax per window.

The shift of window i in band b, in undistorted px of the reference, is

    s_ib = D(x_i) delta_b + t_b z_i + noise

delta_b (8,) corrects the band's homography at the image corners, t_b (2,) is the band's baseline, and z_i is the
parallax of the window, common to all bands: a rank-1 factorisation (Irani 2002). It is solved by alternating least
squares. Cauchy weights reduce the influence of wrong correlation peaks and of windows across depth edges.

Two ambiguities are removed. A plane a + b x + c y added to z is equivalent to other homographies of all bands: z is 0
on the plane that contains most windows. The scale of z is free: the longest baseline has length 1. If the lens layout
is known, positive parallax is nearer to the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px

Array = NDArray[np.float64]

_ITERATIONS = 12
"""Enough for the baselines to converge to a relative change of 0.001."""

_CAUCHY_SCALES = 2.0
"""Residual at which the robust weight is one half, in residual scales."""
_PLANE_PX = 0.5
"""Distance from the reference plane at which the robust weight of a window is one half."""
_MAX_WEIGHT = 2.0
"""Maximum weight by the peak height, so that well-textured parts do not dominate."""
_DAMPING = 1e-3
"""Weight of zero correction and zero parallax, relative to one window; matters only where no window contributes."""
_MIN_INFORMATION = 0.2
"""Minimum sum of weights times squared baselines for the parallax of a window to be known."""
_CLIP_MEDIANS = 5.0
"""Shifts are clipped at this multiple of the median for the initial estimate of the baselines."""
_MIN_LAYOUT_COSINE = 0.8
"""Minimum cosine similarity of the baselines and the lens layout: 0.998 for scenes with depth, up to 0.55 for noise."""
_MIN_SPREAD = 0.3
"""Minimum distance of a baseline from the mean, relative to the longest: at least 0.5 for real cameras, at most 0.2 for
a blurred reference."""


@dataclass(frozen=True)
class PlaneParallax:
    """The plane + parallax model of a capture."""

    baselines: Array
    """(bands, 2) t_b, the longest of length 1."""
    corners_px: Array
    """(bands, 8) corrections of the homographies at the corners, px of the reference."""
    parallax_px: Array
    """(n,) parallax of the windows."""
    residuals_px: Array
    """(n, bands) lengths of the residuals; NaN where a window was not measured in a band."""

    def shifts_px(self, points_px: Points, size_px: tuple[int, int], band: int) -> Array:
        """Return the shifts (n, 2) by the correction of a band's homography at points (n, 2), without parallax."""
        return np.asarray(geometry.over_corners(points_px, *size_px) @ self.corners_px[band])


@dataclass(frozen=True)
class WindowShifts:
    """The shifts of the same windows in all bands, undistorted px of the reference."""

    centres_px: Points
    """(n, 2) of the windows, raw px."""
    points_px: Points
    """(n, 2) of the windows, undistorted px."""
    shifts_px: Array
    """(n, bands, 2), NaN where not measured."""
    weights: Array
    """(n, bands), median 1; 0 where not measured."""

    @classmethod
    def of(cls, residuals: Sequence[Residual[FixedImagePx]], mappings: Sequence[PixelMapping]) -> "WindowShifts":
        """Collect the windows of each band, measured with its mapping. Windows are identified by their centres."""
        centres = sorted({tuple(c) for r in residuals for c in r.centres_px.tolist()})
        index = {centre: i for i, centre in enumerate(centres)}
        shifts, peaks = np.full((len(centres), len(residuals), 2), np.nan), np.zeros((len(centres), len(residuals)))
        for band, (residual, mapping) in enumerate(zip(residuals, mappings, strict=True)):
            measured = np.isfinite(residual.shifts_px[:, 0])
            if not measured.any():
                continue
            xy = residual.centres_px[measured]
            rows = [index[tuple(c)] for c in xy.tolist()]
            shifts[rows, band] = mapping.undistorted(xy + residual.shifts_px[measured]) - mapping.undistorted(xy)
            peaks[rows, band] = residual.peaks_sigma[measured]
        positive = peaks[peaks > 0]
        weights = np.minimum((peaks / np.median(positive)) ** 2, _MAX_WEIGHT) if positive.size else peaks
        centres_px = np.array(centres).reshape(-1, 2)
        points = mappings[0].of_the_plane.undistorted(centres_px)
        return cls(centres_px, points, shifts, np.where(np.isfinite(shifts[..., 0]), weights, 0.0))

    def __len__(self) -> int:
        return len(self.points_px)

    def plus(self, parallax: Array, baselines: Array) -> "WindowShifts":
        """Add the parallax (n,) of the relief with which the windows were measured, along the baselines (bands, 2).

        The results are shifts relative to the reference plane.
        """
        return replace(self, shifts_px=self.shifts_px + parallax[:, None, None] * baselines)


def fit_plane_parallax(
    windows: WindowShifts, size_px: tuple[int, int], layout: Array | None = None
) -> PlaneParallax | None:
    """Fit the model to the windows of a capture; None if too few windows are measured in all bands.

    `size_px` is (width, height) of the reference. `layout` (bands, 2) are the known directions, in any unit, in which
    points move in the bands when the scene comes nearer; they initialise the baselines and determine their sign.
    """
    initial = _initial_baselines(windows) if layout is None else layout
    if initial is None or not np.linalg.norm(initial, axis=1).max() > 0:
        return None
    baselines = initial / np.linalg.norm(initial, axis=1).max()
    design = geometry.over_corners(windows.points_px, *size_px)
    plane = _plane_coordinates(windows.points_px, size_px)
    shifts, weights = np.nan_to_num(windows.shifts_px), windows.weights
    corners = np.zeros((len(baselines), 8))
    for _ in range(_ITERATIONS):
        parallax, information = _parallax(shifts - np.einsum("nki,bi->nbk", design, corners), baselines, weights)
        parallax = parallax - plane @ _reference_plane(parallax, plane, information)
        corners, baselines = _bands(shifts, parallax, design, weights)
        longest = np.linalg.norm(baselines, axis=1).max()
        if not longest > 0:
            return None
        baselines, parallax = baselines / longest, parallax * longest
        predicted = np.einsum("nki,bi->nbk", design, corners) + parallax[:, None, None] * baselines
        residuals = np.where(windows.weights > 0, np.linalg.norm(shifts - predicted, axis=2), np.nan)
        scales = np.array([shift_scale_px(r[np.isfinite(r)]) for r in residuals.T])
        weights = windows.weights * np.nan_to_num(cauchy_weights(residuals, _CAUCHY_SCALES * scales))
        # Inverse variance of bands worse than the median, so that an inconsistent band does not determine the parallax.
        weights *= np.minimum(1, (np.median(scales) / scales) ** 2)
    if layout is not None and np.sum(baselines * layout) < 0:
        baselines, parallax = -baselines, -parallax
    return PlaneParallax(baselines, corners, parallax, residuals)


def are_of_lenses(baselines: Array, layout: Array | None) -> bool:
    """Return True if baselines (bands, 2) are plausible for lenses with a layout (bands, 2), None if unknown.

    Noise of the reference shifts the windows of all bands equally. It resembles parallax that is common to the bands,
    but all baselines are nearly equal, which those of different lenses are not.
    """
    if layout is not None:
        norms = np.linalg.norm(baselines) * np.linalg.norm(layout)
        return bool(np.sum(baselines * layout) >= _MIN_LAYOUT_COSINE * norms > 0)
    lengths = np.linalg.norm(baselines, axis=1)
    from_mean = np.linalg.norm(baselines - baselines.mean(axis=0), axis=1)
    return bool(from_mean.max() >= _MIN_SPREAD * lengths.max() > 0)


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
    limit = _CLIP_MEDIANS * np.median(np.abs(shifts)) + MIN_SHIFT_SCALE_PX
    _, _, right = np.linalg.svd(np.clip(shifts, -limit, limit), full_matrices=False)
    return np.asarray(right[0].reshape(-1, 2))


def _plane_coordinates(points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, 3) = (1, u, v) with u and v from -1 to 1 across the image."""
    return np.column_stack([np.ones(len(points_px)), 2 * points_px / np.asarray(size_px) - 1])


def _parallax(residual_px: Array, baselines: Array, weights: Array) -> tuple[Array, Array]:
    """Return the parallax (n,) by weighted least squares along the baselines, and its information (n,)."""
    projection = (weights * np.einsum("nbk,bk->nb", residual_px, baselines)).sum(axis=1)
    information = (weights * (baselines**2).sum(axis=1)).sum(axis=1)
    return projection / (information + 10 * _DAMPING), information


def _reference_plane(parallax: Array, plane: Array, information: Array) -> Array:
    """Return the coefficients (3,) in (1, u, v) of the plane of most windows: an M-estimate from their median."""
    known = (information > _MIN_INFORMATION).astype(float)
    result = np.array([np.median(parallax), 0.0, 0.0])
    for _ in range(8):
        weight = known * cauchy_weights(parallax - plane @ result, _PLANE_PX)
        normal = plane.T @ (weight[:, None] * plane) + 1e-6 * np.eye(3)
        result = np.linalg.solve(normal, plane.T @ (weight * parallax))
    return np.asarray(result)


def _bands(shifts: Array, parallax: Array, design: Array, weights: Array) -> tuple[Array, Array]:
    """Return the corrections (bands, 8) and baselines (bands, 2) by weighted least squares for each band."""
    full = np.concatenate([design, parallax[:, None, None] * np.eye(2)], axis=2)
    normal = np.einsum("nb,nki,nkj->bij", weights, full, full, optimize=True)
    normal += _DAMPING * np.diag([1.0] * 8 + [1e-3] * 2)
    right = np.einsum("nb,nki,nbk->bi", weights, full, shifts, optimize=True)
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    return solution[:, :8], solution[:, 8:]
