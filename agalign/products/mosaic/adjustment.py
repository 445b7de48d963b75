"""Tie points between overlapping captures, and the adjustment of the cameras' poses to them on a horizontal plane.

With u the position of a point on the ground relative to the camera and h the height, a tilt d (radians), then a
similarity (log scale s, angle a), then a shift t move it to

    camera + t + e^s R(a) (u + h d) / (1 - u . d / h)

The six parameters of each capture minimise the distances of tie points on the ground, px, with Cauchy's loss, and
their own squares over the variances of the georeference.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from agalign.pixels.landmarks import Landmarks, landmarks, matches, robust_homography
from agalign.pixels.raster import without_warnings
from agalign.products.mosaic.placement import Placement
from agalign.products.run.captures import BandReader
from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.image import Raster, Tile
from agalign.values.least_squares import cauchy_weights, shift_scale_px
from agalign.values.processes import usable_cores

_INLIER_PX = 5.0
"""Maximum residual, px, of a tie point from the homography of its pair: relief moves points by some pixels."""
_MAX_KEYPOINTS = 2000
"""Of a capture: limits the time of matching."""
_MIN_TIE_POINTS = 16
"""Of a pair. Unrelated images have up to 8 inliers of a homography, repetitive crops more."""
_TIE_STD_PX = 1.5
"""Standard error of a tie point, with relief and the errors of the lens model."""
_STEP = 1e-6
"""Of numerical derivatives, in standard errors."""
_PARAMETERS = 6
_Ties = tuple[NDArray[np.intp], NDArray[np.float64]]
"""Captures (n, 2) and undistorted px (n, 2, 2) of tie points."""


@dataclass(frozen=True)
class TiePair:
    """Tie points of two captures, given by their positions in a list, undistorted px of the aligned rasters."""

    first: int
    second: int
    first_px: Points
    second_px: Points

    def __len__(self) -> int:
        return len(self.first_px)

    def split(self) -> tuple["TiePair", "TiePair"]:
        """Return the tie points of the adjustment, and those that check it."""
        check_every = 5  # every fifth tie point of a pair takes no part in the adjustment
        check = np.arange(len(self)) % check_every == 0
        # Of a pair in the adjustment: the residuals of more of them, from relief and lens, are correlated.
        max_tie_points = 50
        used = np.flatnonzero(~check)[:: -(-np.count_nonzero(~check) // max_tie_points)]
        one, other = (replace(self, first_px=self.first_px[k], second_px=self.second_px[k]) for k in (used, check))
        return one, other

    def distances_m(self, captures: Sequence[Placement]) -> Points:
        """Return the vectors (n, 2) from the second to the first position of each tie point on the ground, m."""
        first, second = captures[self.first].to_ground, captures[self.second].to_ground
        return geometry.apply(first, self.first_px) - geometry.apply(second, self.second_px)


def misfit_m(pairs: Sequence[TiePair], captures: Sequence[Placement]) -> tuple[float, float]:
    """Return median and p95 of the distances on the ground between the two positions of tie points; nan without any."""
    lengths = [np.linalg.norm(pair.distances_m(captures), axis=1) for pair in pairs]
    median_m, p95_m = np.percentile(np.concatenate(lengths), (50, 95)) if lengths else (np.nan, np.nan)
    return float(median_m), float(p95_m)


def tie_pairs(captures: Sequence[Placement]) -> list[TiePair]:
    """Match neighbouring captures by the landmarks of their reference bands. Raises InputError for an unreadable file.

    A pair is left out if its homography contradicts the georeference.
    """
    with without_warnings(), ThreadPoolExecutor(usable_cores()) as threads:
        found = list(threads.map(_landmarks_of, captures))
        results = threads.map(lambda pair: _matched(pair[0], pair[1], captures, found), _neighbours(captures))
        return [pair for pair in results if pair is not None]


def tied_groups(captures: int, pairs: Sequence[TiePair]) -> list[list[int]]:
    """Return the positions of captures that tie points join, directly or by others, in groups: the largest first."""
    edges = np.ones(len(pairs)), ([pair.first for pair in pairs], [pair.second for pair in pairs])
    number, group = connected_components(coo_array(edges, (captures, captures)), directed=False)
    return sorted((np.flatnonzero(group == k).tolist() for k in range(number)), key=len, reverse=True)


def _landmarks_of(capture: Placement) -> Landmarks:
    with BandReader() as reader:
        pixels = reader.values(capture.reference, Tile(0, 0, *capture.size_px))
    raster = Raster(np.nan_to_num(pixels), np.isfinite(pixels))
    return landmarks(raster, "image", _MAX_KEYPOINTS).undistorted(capture.lens)


def _neighbours(captures: Sequence[Placement]) -> list[tuple[int, int]]:
    """Pairs of captures that may overlap: each one with the nearest in each direction."""
    centres = np.array([c.on_ground(np.subtract(c.size_px, 1)[None] / 2)[0] for c in captures])
    reach_m = np.array([np.ptp(c.outline_m, axis=0).max() / 2 + c.pose_std[0] for c in captures])
    pairs = set()
    sectors = 8  # a capture is matched with the nearest one in each of these directions: along and across the strips
    for i, centre in enumerate(centres):
        east, north = (centres - centre).T
        distance_m, sector = np.hypot(east, north), np.floor(np.arctan2(north, east) / (2 * np.pi) * sectors)
        distance_m[i] = np.inf
        for k in np.unique(sector):
            nearest = int(np.where(sector == k, distance_m, np.inf).argmin())
            if distance_m[nearest] < reach_m[i] + reach_m[nearest]:
                pairs.add((min(i, nearest), max(i, nearest)))
    return sorted(pairs)


def _matched(i: int, j: int, captures: Sequence[Placement], found: Sequence[Landmarks]) -> TiePair | None:
    """The tie points of two captures; None with too few of them, or if they contradict the georeference."""
    rows, columns = matches(found[i], found[j])
    if len(rows) < _MIN_TIE_POINTS:
        return None
    one, other = found[i].xy[rows], found[j].xy[columns]
    homography = robust_homography(one, other, _INLIER_PX, _MIN_TIE_POINTS)
    if homography is None or geometry.local_scale(homography, *captures[i].size_px).min() <= 0:
        return None
    inliers = np.flatnonzero(np.linalg.norm(geometry.apply(homography, one) - other, axis=1) < _INLIER_PX)
    # SIFT describes a keypoint with two orientations twice.
    inliers = inliers[np.unique(one[inliers], axis=0, return_index=True)[1]]
    pair = TiePair(i, j, one[inliers], other[inliers])
    max_prior_errors = 3.0  # maximum distance of a pair of captures from its georeference, in standard errors
    limit_m = max_prior_errors * np.hypot(captures[i].accuracy_m, captures[j].accuracy_m)
    return pair if np.linalg.norm(pair.distances_m(captures).mean(axis=0)) < limit_m else None


def adjusted(captures: Sequence[Placement], pairs: Sequence[TiePair]) -> list[Placement]:
    """Return the captures with the poses that fit the tie points best, by Gauss-Newton steps with Cauchy's weights.

    One without tie points is not changed.
    """
    if not pairs:
        return list(captures)
    parameters = np.zeros((len(captures), _PARAMETERS))
    tied = np.concatenate([np.tile((p.first, p.second), (len(p), 1)) for p in pairs])
    ties = tied, np.concatenate([np.stack([p.first_px, p.second_px], axis=1) for p in pairs])
    scale = np.inf
    max_iterations = 40
    converged = 1e-3  # of a parameter, in its standard errors
    for _ in range(max_iterations):
        residuals, derivatives = _linearised(captures, parameters, ties)
        lengths = np.linalg.norm(residuals, axis=1)
        # A small scale at the start would make outliers of all tie points where the georeference is inaccurate.
        scale = max(_TIE_STD_PX, min(scale / 2, shift_scale_px(lengths)))
        weighted = derivatives.T @ diags_array(np.repeat(cauchy_weights(lengths, scale), 2) / scale**2)
        normal = (weighted @ derivatives + eye_array(parameters.size)).tocsc()
        step = spsolve(normal, -(weighted @ residuals.ravel() + parameters.ravel()))
        parameters += step.reshape(parameters.shape)
        if scale == _TIE_STD_PX and np.abs(step).max() < converged:
            break
    return [_corrected(c, p) for c, p in zip(captures, parameters, strict=True)]


def _linearised(captures: Sequence[Placement], parameters: Points, ties: _Ties) -> tuple[Points, Any]:
    """The distances (n, 2) of tie points on the ground, in px of their current size, and their sparse derivatives
    (2 n, 6 captures).
    """
    ground_m, gsd_m = _on_ground(captures, parameters, ties)
    unit_m, signs = np.sqrt(gsd_m.prod(axis=1))[:, None, None], np.array([[1.0], [-1.0]])
    residuals = (signs * ground_m / unit_m).sum(axis=1)
    entries = np.empty((len(ground_m), 2, 2, _PARAMETERS))  # tie point, east and north, capture, parameter
    for k, step in enumerate(_STEP * np.eye(_PARAMETERS)):
        moved_m, moved_gsd_m = _on_ground(captures, parameters + step, ties)
        by_unit = 0.5 * np.log(moved_gsd_m / gsd_m)[:, None] * residuals[:, :, None]
        entries[..., k] = (np.swapaxes(signs * (moved_m - ground_m) / unit_m, 1, 2) - by_unit) / _STEP
    columns = (_PARAMETERS * ties[0][:, None, :, None] + np.arange(_PARAMETERS)).repeat(2, axis=1).ravel()
    rows = np.repeat(np.arange(residuals.size), 2 * _PARAMETERS)
    return residuals, coo_array((entries.ravel(), (rows, columns)), (residuals.size, parameters.size)).tocsr()


def _on_ground(captures: Sequence[Placement], parameters: Points, ties: _Ties) -> tuple[Points, Points]:
    """Positions (n, 2, 2) on the ground, m, and ground sample distances (n, 2) of the captures."""
    tied, points_px = ties
    corrected = [_corrected(c, p) for c, p in zip(captures, parameters, strict=True)]
    matrices = np.array([c.to_ground for c in corrected])[tied]
    mapped = np.einsum("ncij,ncj->nci", matrices[..., :2], points_px) + matrices[..., 2]
    return mapped[..., :2] / mapped[..., 2:], np.array([c.gsd_m for c in corrected])[tied]


def _corrected(capture: Placement, parameters: Points) -> Placement:
    """The capture with corrections of its pose, in units of their standard errors."""
    east_m, north_m, log_scale, angle, *tilt = parameters * capture.pose_std
    to_camera, tilted = geometry.translation(*-capture.camera_m), geometry.identity()
    if capture.height_m is not None:
        tilted[:2, 2], tilted[2, :2] = np.multiply(tilt, capture.height_m), -np.divide(tilt, capture.height_m)
    similarity = geometry.identity()
    similarity[:2, :2] = np.exp(log_scale) * np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))))
    back = geometry.translation(capture.camera_m[0] + east_m, capture.camera_m[1] + north_m)
    return replace(capture, to_ground=back @ similarity @ tilted @ to_camera @ capture.to_ground)
