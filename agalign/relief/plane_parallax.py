"""Plane + parallax from the residual shifts of windows: a homography and a baseline for each band, a parallax for each
window.

The shift of window i in band b, in undistorted px of the reference, is

    s_ib = D(x_i) delta_b + t_b z_i + noise

with delta_b (8,) a correction of the band's homography by its corners, t_b (2,) its baseline, and z_i the parallax of
the window, which all bands share: a factorisation of rank 1 (Irani 2002). It is solved by alternating least squares
with Cauchy weights against wrong peaks and windows across an edge.

Two ambiguities are removed. Adding a plane a + b x + c y to z changes the homographies of all bands: z is 0 on the
plane that most windows are on. The longest baseline has length 1; where the layout of the lenses is known,
positive parallax is nearer.
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
from agalign.values.robust import MAD_TO_STD, cauchy_weights

Array = NDArray[np.float64]

_ITERATIONS = 12
"""A fixed number, enough for baselines to settle to a thousandth."""
_MIN_SPREAD_PX = 0.05
"""Smaller misfits are the noise of shifts."""
_SPREADS = 2.0
"""A window has half its weight at twice the typical misfit."""
_PLANE_PX = 0.5
"""Windows farther than this from the reference plane hardly take part in finding it."""
_MAX_WEIGHT = 2.0
"""Weights grow with the height of the peak up to here: textured parts must not outvote the rest."""
_DAMPING = 1e-3
"""Weight of no correction and no parallax, relative to one window: it decides only what no window determines."""
_MIN_INFORMATION = 0.2
"""Sum of weights times squared baselines from which a window's parallax is known."""
_CLIP_MEDIANS = 5.0
"""Shifts beyond so many medians do not decide the first guess of the baselines."""


@dataclass(frozen=True)
class PlaneParallax:
    """What the windows of a capture show."""

    baselines: Array
    """(bands, 2) t_b, the longest of length 1."""
    corners_px: Array
    """(bands, 8) corrections of the homographies, px of the reference."""
    parallax_px: Array
    """(n,) of each window."""
    misfits_px: Array
    """(n, bands) lengths of what remains; nan where a window was not measured in a band."""

    def shifts_px(self, points_px: Points, size_px: tuple[int, int], band: int) -> Array:
        """(n, 2) what the correction of a band's homography alone displaces at points (n, 2)."""
        return np.asarray(geometry.over_corners(points_px, *size_px) @ self.corners_px[band])


@dataclass(frozen=True)
class WindowShifts:
    """The shifts of the same windows in all bands, undistorted px of the reference."""

    centres_px: Points
    """(n, 2) of the windows, raw px."""
    points_px: Points
    """(n, 2) the same, undistorted."""
    shifts_px: Array
    """(n, bands, 2), nan where not measured."""
    weights: Array
    """(n, bands), 1 in the median, 0 where not measured."""

    @classmethod
    def of(cls, residuals: Sequence[Residual[FixedImagePx]], mappings: Sequence[PixelMapping]) -> "WindowShifts":
        """From the windows of each band, measured under its mapping. Windows are identified by their centres."""
        centres = sorted({tuple(c) for r in residuals for c in r.centres_px.tolist()})
        index = {centre: i for i, centre in enumerate(centres)}
        shifts, peaks = np.full((len(centres), len(residuals), 2), np.nan), np.zeros((len(centres), len(residuals)))
        for band, (residual, mapping) in enumerate(zip(residuals, mappings, strict=True)):
            measured = np.isfinite(residual.shifts_px[:, 0])
            if not measured.any():
                continue
            at = residual.centres_px[measured]
            rows = [index[tuple(c)] for c in at.tolist()]
            shifts[rows, band] = mapping.undistorted(at + residual.shifts_px[measured]) - mapping.undistorted(at)
            peaks[rows, band] = residual.peaks_sigma[measured]
        some = peaks[peaks > 0]
        weights = np.minimum((peaks / np.median(some)) ** 2, _MAX_WEIGHT) if some.size else peaks
        centres_px = np.array(centres).reshape(-1, 2)
        points = mappings[0].of_the_plane.undistorted(centres_px)
        return cls(centres_px, points, shifts, np.where(np.isfinite(shifts[..., 0]), weights, 0.0))

    def __len__(self) -> int:
        return len(self.points_px)

    def plus(self, parallax: Array, baselines: Array) -> "WindowShifts":
        """The shifts from the reference plane of windows measured under a relief. Its parallax (n,) has moved them
        along the baselines (bands, 2) already.
        """
        return replace(self, shifts_px=self.shifts_px + parallax[:, None, None] * baselines)


def fit_plane_parallax(
    windows: WindowShifts, size_px: tuple[int, int], layout: Array | None = None
) -> PlaneParallax | None:
    """The model that explains the windows of a capture, on a reference (width, height).

    `layout` (bands, 2) are the directions in which the bands move as the scene comes nearer, where they are known, in
    any unit: it starts the baselines and decides their sign. None where too few windows are measured in all bands.
    """
    start = _first_baselines(windows) if layout is None else layout
    if start is None or not np.linalg.norm(start, axis=1).max() > 0:
        return None
    baselines = start / np.linalg.norm(start, axis=1).max()
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
        explained = np.einsum("nki,bi->nbk", design, corners) + parallax[:, None, None] * baselines
        misfits = np.where(windows.weights > 0, np.linalg.norm(shifts - explained, axis=2), np.nan)
        spreads = _spreads_px(misfits)
        weights = windows.weights * np.nan_to_num(cauchy_weights(misfits, _SPREADS * spreads))
        # Inverse variances, of bands worse than the median: one that shows something else must not decide the parallax
        # of the others.
        weights *= np.minimum(1, (np.median(spreads) / spreads) ** 2)
    if layout is not None and np.sum(baselines * layout) < 0:
        baselines, parallax = -baselines, -parallax
    return PlaneParallax(baselines, corners, parallax, misfits)


def parallax_of(residual_px: Array, baselines: Array, weights: Array) -> Array:
    """(n,) parallax of windows by their shifts (n, bands, 2) beyond the homographies, 0 where nothing determines it."""
    return _parallax(np.nan_to_num(residual_px), baselines, weights)[0]


def _first_baselines(windows: WindowShifts) -> Array | None:
    """(bands, 2): the first right singular vector of the shifts of the windows that all bands show."""
    complete = (windows.weights > 0).all(axis=1)
    if complete.sum() < 2 * windows.weights.shape[1]:
        return None
    shifts = windows.shifts_px[complete].reshape(int(complete.sum()), -1)
    shifts = shifts - np.median(shifts, axis=0)
    limit = _CLIP_MEDIANS * np.median(np.abs(shifts)) + _MIN_SPREAD_PX
    _, _, right = np.linalg.svd(np.clip(shifts, -limit, limit), full_matrices=False)
    return np.asarray(right[0].reshape(-1, 2))


def _plane_coordinates(points_px: Points, size_px: tuple[int, int]) -> Array:
    """(n, 3): 1, u, v with u and v from -1 to 1 across the image."""
    return np.column_stack([np.ones(len(points_px)), 2 * points_px / np.asarray(size_px) - 1])


def _parallax(residual_px: Array, baselines: Array, weights: Array) -> tuple[Array, Array]:
    """((n,) weighted least squares along the baselines, (n,) its information)."""
    along = (weights * np.einsum("nbk,bk->nb", residual_px, baselines)).sum(axis=1)
    information = (weights * (baselines**2).sum(axis=1)).sum(axis=1)
    return along / (information + 10 * _DAMPING), information


def _reference_plane(parallax: Array, plane: Array, information: Array) -> Array:
    """(3,) the plane in (1, u, v) that most windows are on: an M-estimate that starts at their median."""
    known = (information > _MIN_INFORMATION).astype(float)
    result = np.array([np.median(parallax), 0.0, 0.0])
    for _ in range(8):
        weight = known * cauchy_weights(parallax - plane @ result, _PLANE_PX)
        normal = plane.T @ (weight[:, None] * plane) + 1e-6 * np.eye(3)
        result = np.linalg.solve(normal, plane.T @ (weight * parallax))
    return np.asarray(result)


def _bands(shifts: Array, parallax: Array, design: Array, weights: Array) -> tuple[Array, Array]:
    """(corrections (bands, 8), baselines (bands, 2)) by weighted least squares, band by band."""
    full = np.concatenate([design, parallax[:, None, None] * np.eye(2)], axis=2)
    normal = np.einsum("nb,nki,nkj->bij", weights, full, full, optimize=True)
    normal += _DAMPING * np.diag([1.0] * 8 + [1e-3] * 2)
    right = np.einsum("nb,nki,nbk->bi", weights, full, shifts, optimize=True)
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    return solution[:, :8], solution[:, 8:]


def _spreads_px(misfits: Array) -> Array:
    """(bands,) robust standard deviations of the misfits (n, bands)."""
    medians = np.array([np.median(m[np.isfinite(m)]) if np.isfinite(m).any() else 0.0 for m in misfits.T])
    return np.maximum(MAD_TO_STD * medians, _MIN_SPREAD_PX)
