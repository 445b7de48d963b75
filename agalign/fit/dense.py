"""Dense parallax of the reference by multi-baseline stereo, coarse to fine.

For each candidate parallax z, every band is resampled along its baseline, and its structure is correlated with that of
the reference in small windows. The costs of all bands are summed (Okutani & Kanade 1993) and truncated, so that an
occluded or noisy band adds a constant. The structure is the double-angle gradient field of `pixels.structure`, which
does not depend on the sign of contrast.

Three levels: a wide search at a quarter of the resolution determines the range of z, semi-global matching at half the
resolution preserves edges, and a local search at full resolution refines z per pixel. The wide search determines only
the range and no start for each pixel, because it smooths thin objects away: with real plants, one pixel in twenty is
more than 6 px from its result.

Semi-global matching (Hirschmuller 2008) gives each pixel the label with the minimum sum of costs over four paths.
OpenCV's StereoSGBM cannot be used: it computes the costs from two rectified images and accepts no cost volume.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.host.held_sizes import MAX_MATCHED_PX
from agalign.pixels.band_resampling import shrink
from agalign.pixels.structure import structure_field
from agalign.values import geometry, lens
from agalign.values.image import FloatImage, Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale

Costs = NDArray[np.uint8]
"""(levels, height, width): truncated 1 - correlation of one band, in units of 1 / _UNIT_COST, or _UNKNOWN."""
MAX_LARGE = 63
"""Maximum large penalty of semi-global matching. A path adds at most this much to the cost, so the sum over four paths
is at most 252; a cost plus both penalties is at most 255."""

_SEARCH_NEARER, _SEARCH_FARTHER = 0.06, 0.03
"""Searched parallax as a share of the longer side: for lenses 3 cm apart and a reference plane 1 m away, an object at
half that range, and the floor."""
_SEARCH_STEP_PX = 2.0
"""Half a pixel of the reduced images; the correlation peak is about one pixel wide."""
_MATCH_WINDOW_PX = 7
"""Side of the correlation windows at reduced resolution."""
_UNIT_COST = int(MAX_LARGE / 0.4)
"""Integer cost of zero correlation, as high as the range of semi-global matching permits: large steps of the parallax
have a penalty of 0.4 of it."""
_UNKNOWN = 255
"""Cost of a window with invalid, such as saturated, pixels of the moving band: the others determine the parallax."""
_REFINED_STEPS = -1.5, -0.5, 0.5, 1.5
"""Candidates of the refinement around the result of semi-global matching, in its steps. A range of 1 step instead of
1.5 increases the median error by 6 to 18 % (rendered boxes, plants and terraces)."""
_MAX_INVALID_SHARE = 0.25
"""Maximum share of invalid pixels in a window with a correlation."""
_MIN_CORRELATION = 0.1
"""Lower correlations are treated as occlusion and do not increase the cost further."""
_MEDIAN_PX = 5
"""Window of the median filters, which remove isolated wrong pixels."""
_STRIP_PX = 64
"""Height of the strips in which correlations are computed, so that the intermediate images fit in the CPU's cache."""
_NODE_STEP_PX = 8
"""Spacing of the grid on which lenses and homographies are evaluated."""
_MIN_ENERGY = 1e-3
"""Energy added to that of a window, so that windows without structure have no correlation."""


@dataclass(frozen=True)
class View:
    """A moving band and its mapping as a function of the parallax."""

    image: Raster
    """(height, width), one channel."""
    plane: PixelMapping
    """Mapping of the reference plane, without parallax."""
    baseline: tuple[float, float]
    """t_b, undistorted px of the reference per px of parallax."""


class DenseMatching:
    """Matching costs of all bands of one capture, from which the relief of any selection of bands is computed."""

    def __init__(
        self,
        reference: Raster,
        views: Sequence[View],
        window_range_px: tuple[float, float],
        *,
        is_sign_known: bool = True,
    ) -> None:
        """Compute the costs; `reference` has one channel, `window_range_px` is the parallax range of the windows.

        With `is_sign_known`, positive parallax is nearer to the camera; else either may be.
        """
        self.reference, self.views, self.is_sign_known = reference, views, is_sign_known
        self.scale = min(1.0, (MAX_MATCHED_PX / reference.valid.size) ** 0.5)
        low, high = self._range_px(window_range_px)
        # The time is proportional to the number of levels.
        fine_step_px, coarse_step_px, max_fine_levels, max_levels = 0.5, 1.0, 48, 96
        is_fine = (high - low) / fine_step_px <= max_fine_levels
        self.step_px = max(fine_step_px if is_fine else coarse_step_px, (high - low) / max_levels)
        self.levels_px = np.arange(low, high + self.step_px, self.step_px)
        relative_scale = 0.5  # of semi-global matching
        fixed = _FixedBand(reference, self.scale * relative_scale, _MATCH_WINDOW_PX)
        self.match_scale = fixed.scale
        self.costs = [_MovingBand(fixed, view, (low, high)).costs(self.levels_px) for view in views]
        self._matched: dict[tuple[int, ...], Relief] = {}

    @property
    def refined_px(self) -> float:
        """Maximum change of the parallax by the refinement."""
        return _REFINED_STEPS[-1] * self.step_px

    def matched(self, bands: Sequence[int]) -> Relief:
        """Return the relief from some bands at the resolution of semi-global matching; computed once."""
        key = tuple(bands)
        if key not in self._matched:
            self._matched[key] = Relief(*_semi_global_match(self.costs, bands, self.levels_px), self.match_scale)
        return self._matched[key]

    def refined(self, views: Sequence[View], selections: Sequence[Sequence[int]]) -> list[Relief]:
        """Return the relief of each selection of bands at full resolution, with refitted views.

        A relief depends only on the selected bands, but for its range, so that it can be verified with the others.
        """
        margin = 2 * self.step_px
        limits = self.levels_px[0] - margin, self.levels_px[-1] + margin
        window_px = 11
        fixed = _FixedBand(self.reference, self.scale, window_px)
        starts = [np.asarray(cv2.resize(self.matched(bands).parallax_px, fixed.size_px)) for bands in selections]
        steps_px = [step * self.step_px for step in _REFINED_STEPS]
        totals = [np.zeros((len(steps_px), *start.shape), np.float32) for start in starts]
        counts = [np.zeros(start.shape, np.float32) for start in starts]
        for band, view in enumerate(views):
            moving = _MovingBand(fixed, view, limits)
            for start, total, count, bands in zip(starts, totals, counts, selections, strict=True):
                if band in bands:
                    moving.subtract_correlations(start, steps_px, total, count)
        result = []
        for start, total, count in zip(starts, totals, counts, strict=True):
            offset_px = sub_label_minimum(total) * np.float32(steps_px[1] - steps_px[0]) + np.float32(steps_px[0])
            parallax_px = cv2.medianBlur(np.where(count > 0, start + offset_px, start), _MEDIAN_PX)
            result.append(Relief(np.asarray(parallax_px), -total.min(axis=0) / np.maximum(count, 1), fixed.scale))
        return result

    def _range_px(self, windows_px: tuple[float, float]) -> tuple[float, float]:
        """Return the range of parallax in the windows and the wide search."""
        longer_side_px = max(self.reference.size_px)
        farther = _SEARCH_FARTHER if self.is_sign_known else _SEARCH_NEARER
        low = min(-farther * longer_side_px, windows_px[0])
        high = max(_SEARCH_NEARER * longer_side_px, windows_px[1])
        levels = np.arange(low, high + _SEARCH_STEP_PX, _SEARCH_STEP_PX)
        relative_scale = 0.25  # of the wide search
        fixed = _FixedBand(self.reference, self.scale * relative_scale, _MATCH_WINDOW_PX)
        costs = [_MovingBand(fixed, view, (low, levels[-1])).costs(levels) for view in self.views]
        parallax_px, confidence = _semi_global_match(costs, range(len(costs)), levels)
        min_correlation = 0.6  # pixels with a lower one (occlusions, noise) do not extend the range
        reliable = parallax_px[confidence >= min_correlation]
        counts = np.bincount(np.rint((reliable - low) / _SEARCH_STEP_PX).astype(int), minlength=len(levels))
        min_pixel_share = 0.003  # fewer pixels at an extreme parallax are taken for wrong matches
        frequent = levels[np.flatnonzero(counts >= min_pixel_share * parallax_px.size)]
        occurring = np.array([*windows_px, *frequent])
        margin_px = 2 * _SEARCH_STEP_PX
        return float(occurring.min() - margin_px), float(occurring.max() + margin_px)


def nearer_sign(relief: Relief, baselines: NDArray[np.float64]) -> int:
    """Return 1 if positive parallax is nearer to the camera, or if that is unknown, and -1 if negative parallax is.

    Where two surfaces are displaced to the same position, only pixels of the nearer one match. With the wrong sign,
    pixels with a high correlation would be occluded. `baselines` (bands, 2): displacement (x, y) of each band, px, by a
    parallax of 1.
    """
    min_occluded_share = 0.0005  # fewer pixels may be wrong matches: 400 of a megapixel
    min_correlation_difference = 0.03  # smaller ones may be chance
    means = []
    for sign, signed_relief in ((1, relief), (-1, relief.negated)):
        hidden = np.zeros(relief.parallax_px.shape, bool)
        for x, y in (sign * baselines).tolist():
            hidden |= np.asarray(Parallax(signed_relief, (x, y)).with_occlusions().hidden)
        if np.count_nonzero(hidden) < min_occluded_share * hidden.size:
            return 1
        means.append(float(relief.confidence[hidden].mean()))
    return -1 if means[0] - means[1] > min_correlation_difference else 1


def _semi_global_match(
    costs: Sequence[Costs], bands: Sequence[int], levels_px: NDArray[np.float64]
) -> tuple[FloatImage, FloatImage]:
    """Return the parallax by semi-global matching and its mean correlation, each (height, width)."""
    mean = _mean_costs([costs[band] for band in bands])
    small_step = 0.06  # penalty relative to the cost of zero correlation
    labels = sub_label_minimum(aggregated(mean, round(small_step * _UNIT_COST), MAX_LARGE))
    nearest = np.rint(labels).astype(np.intp)[None]
    confidence = 1 - np.take_along_axis(mean, nearest, axis=0)[0] / np.float32(_UNIT_COST)
    step_px = levels_px[1] - levels_px[0]
    parallax_px = cv2.medianBlur(np.float32(levels_px[0]) + labels * np.float32(step_px), _MEDIAN_PX)
    return np.asarray(parallax_px), confidence


def aggregated(costs: Costs, small: int, large: int) -> NDArray[np.uint16]:
    """Return the sum of the path costs from the left, right, top and bottom, (labels, height, width).

    Along each path, with cost C(d) at label d and q the previous pixel,

        L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + small, min_k L(q, k) + large) - min_k L(q, k)

    `small` is the penalty of a step by one label, `large` that of a longer step.
    """
    vertical = _path_penalties(costs, np.uint8(small), np.uint8(large))
    horizontal = _path_penalties(np.stack([cv2.transpose(plane) for plane in costs]), np.uint8(small), np.uint8(large))
    result = np.multiply(costs, 4, dtype=np.uint16)
    for plane, down, across in zip(result, vertical, horizontal, strict=True):
        plane += cv2.add(down, cv2.transpose(across))
    return result


def _path_penalties(costs: Costs, small: np.uint8, large: np.uint8) -> Costs:
    """Return L - C (labels, length, lines) of the two paths along the second axis of the costs, added."""
    result = np.zeros_like(costs)
    length = costs.shape[1]
    for path in (range(length), range(length - 1, -1, -1)):
        previous = costs[:, path[0]].copy()
        current = np.empty_like(previous)
        for i in path[1:]:
            minimum = previous.min(axis=0)
            np.minimum(previous, minimum + large, out=current)
            previous += small
            np.minimum(current[1:], previous[:-1], out=current[1:])
            np.minimum(current[:-1], previous[1:], out=current[:-1])
            current -= minimum
            result[:, i] += current
            current += costs[:, i]
            previous, current = current, previous
    return result


def sub_label_minimum(costs: NDArray[np.uint16] | NDArray[np.float32]) -> FloatImage:
    """Return the label of minimum cost, (height, width), refined by the parabola through its neighbours.

    There are at least three labels.
    """
    last = len(costs) - 1
    minimum = costs.min(axis=0)
    label = np.zeros(minimum.shape, np.uint16)
    for k in range(last, -1, -1):  # `argmin` along the first axis is several times slower.
        np.copyto(label, k, where=costs[k] == minimum)
    inner = np.clip(label, 1, last - 1)
    at = inner * np.intp(minimum.size) + np.arange(minimum.size).reshape(minimum.shape)
    lower, centre, upper = (costs.reshape(-1).take(at + k * minimum.size).astype(np.float32) for k in (-1, 0, 1))
    curvature = lower - 2 * centre + upper
    offset = np.where(curvature > 0, (lower - upper) / (2 * np.maximum(curvature, 1e-9)), 0.0)
    return np.asarray(np.where(inner == label, inner + np.clip(offset, -0.5, 0.5), label), np.float32)


def _mean_costs(costs: Sequence[Costs]) -> Costs:
    """Return the mean over the bands. It has the range of one band, so that no number of bands overflows."""
    result = np.empty_like(costs[0])
    for k, plane in enumerate(result):
        total, count = np.zeros(plane.shape, np.float32), np.zeros(plane.shape, np.float32)
        for band in costs:
            known = (band[k] != _UNKNOWN).view(np.uint8)
            cv2.accumulate(band[k], total, known)
            cv2.accumulate(known, count)
        # Without any band, the cost is that of an occlusion, and the neighbours determine the parallax.
        np.copyto(total, (1 - _MIN_CORRELATION) * _UNIT_COST, where=count == 0)
        cv2.convertScaleAbs(total / np.maximum(count, 1), plane)
    return result


class _FixedBand:
    """Structure of the reference at one resolution."""

    def __init__(self, reference: Raster, scale: float, window_px: int) -> None:
        self.window_px = window_px
        self.full_px = width, height = reference.size_px
        self.size_px = max(1, round(width * scale)), max(1, round(height * scale))
        self.scale = PixelScale.between(reference.size_px, self.size_px)
        self.structure = _structure(shrink(reference, self.size_px), window_px)

    def strips(self) -> Iterator[tuple[slice, slice]]:
        """Yield the rows of strips, and these extended by the rows to which the windows extend."""
        height, margin = self.size_px[1], self.window_px // 2
        for start in range(0, height, _STRIP_PX):
            stop = min(start + _STRIP_PX, height)
            yield slice(start, stop), slice(max(start - margin, 0), min(stop + margin, height))

    def correlation(self, warped: FloatImage, rows: slice) -> tuple[FloatImage, Mask]:
        """Return the normalised correlation in windows with a structure (rows, width, 4), and where it is unknown.

        Both are (rows, width). It is from _MIN_CORRELATION to 1. Windows across a step of the parallax or the border
        may exceed 1 otherwise.
        """
        real, imaginary, energy = (plane[rows] for plane in self.structure)
        warped_real, warped_imaginary, warped_energy, invalid = cv2.split(warped)
        cv2.multiply(real, warped_real, warped_real)
        cv2.multiply(imaginary, warped_imaginary, warped_imaginary)
        product = cv2.add(warped_real, warped_imaginary, warped_real)
        norm = cv2.max(cv2.multiply(energy, warped_energy, warped_energy), _MIN_ENERGY, warped_energy)
        mean = cv2.boxFilter(product, -1, (self.window_px, self.window_px), warped_imaginary)
        correlation = np.asarray(cv2.divide(mean, norm, norm))
        np.clip(correlation, np.float32(_MIN_CORRELATION), np.float32(1), out=correlation)
        return correlation, np.asarray(invalid > _MAX_INVALID_SHARE)


class _MovingBand:
    """Structure of a view and its mapping as a function of the parallax, at the resolution of the reference."""

    def __init__(self, fixed: _FixedBand, view: View, range_px: tuple[float, float]) -> None:
        self.fixed = fixed
        self.middle_px, self.half_px = sum(range_px) / 2, max((range_px[1] - range_px[0]) / 2, _SEARCH_STEP_PX)
        size_px = self._size_px(view)
        image, window = shrink(view.image, size_px), (fixed.window_px, fixed.window_px)
        invalid = cv2.boxFilter((~image.valid).astype(np.float32), -1, window)
        self.structure = np.asarray(cv2.merge([*_structure(image, fixed.window_px), invalid]))
        mapping = view.plane.rescaled(fixed.scale, PixelScale.between(view.image.size_px, size_px))
        self.parabola = self._parabola(mapping, fixed.scale.displacements(view.baseline))

    def costs(self, levels_px: NDArray[np.float64]) -> Costs:
        """Return the costs at each level, constant over the image."""
        width, height = self.fixed.size_px
        result = np.empty((len(levels_px), height, width), np.uint8)
        for rows, extended in self.fixed.strips():
            for plane, level_px in zip(result[:, rows], levels_px.astype(np.float32), strict=True):
                correlation, unknown = self._correlation(self._positions(level_px, extended), rows, extended)
                cv2.convertScaleAbs(correlation, plane, -_UNIT_COST, _UNIT_COST)
                plane[unknown] = _UNKNOWN
        return result

    def subtract_correlations(
        self, parallax_px: FloatImage, steps_px: Sequence[float], total: FloatImage, count: FloatImage
    ) -> None:
        """Subtract the correlations at the parallax of each pixel plus each of the steps from `total`, and count them.

        `parallax_px` and `count` are (height, width), `total` is (steps, height, width).
        """
        for rows, extended in self.fixed.strips():
            start = self._positions(parallax_px[extended], extended)
            derivative = self._positions(parallax_px[extended] + np.float32(1), extended) - start
            at_steps = [self._correlation(start + np.float32(s) * derivative, rows, extended) for s in steps_px]
            known = ~np.logical_or.reduce([unknown for _, unknown in at_steps])
            count[rows] += known
            for plane, (correlation, _) in zip(total[:, rows], at_steps, strict=True):
                correlation *= known
                plane -= correlation

    def _positions(self, parallax_px: FloatImage | np.float32, rows: slice) -> FloatImage:
        """Return the positions (2, rows, width) in the moving image, x and y, at a parallax."""
        a, b, c = (coefficient[:, rows] for coefficient in self.parabola)
        u = (parallax_px - np.float32(self.middle_px)) / np.float32(self.half_px)
        return np.asarray(a + u * (b + u * c))

    def _correlation(self, positions: FloatImage, rows: slice, extended: slice) -> tuple[FloatImage, Mask]:
        """Return `_FixedBand.correlation` in some rows from the positions in these and the rows around."""
        outside_energy = 1e3  # of windows with centres outside, so that the part inside has no correlation
        border = (0.0, 0.0, outside_energy, 0.0)
        warped = np.asarray(cv2.remap(self.structure, positions[0], positions[1], cv2.INTER_LINEAR, borderValue=border))
        own = slice(rows.start - extended.start, rows.stop - extended.start)
        correlation, unknown = self.fixed.correlation(warped, extended)
        return correlation[own], unknown[own]

    def _size_px(self, view: View) -> tuple[int, int]:
        """Return the size at which the pixels of the moving image are as large as those of the reduced reference."""
        magnification = geometry.magnification(view.plane.fixed_to_moving, *self.fixed.full_px)
        ratio = min(1.0, self.fixed.scale.mean / magnification)
        width, height = view.image.size_px
        return max(1, round(width * ratio)), max(1, round(height * ratio))

    def _parabola(self, mapping: PixelMapping, baseline: NDArray[np.float64]) -> tuple[FloatImage, ...]:
        """Return (a, b, c), each (2, height, width): positions in the moving image are a + b u + c u^2.

        u is from -1 to 1 over the range of parallax. Interpolated linearly on a grid; the error is below 0.01 px.
        """
        width, height = self.fixed.size_px
        undistorted = mapping.undistorted(np.stack(np.meshgrid(_nodes_px(width), _nodes_px(height)), axis=-1))
        first, middle, last = (
            lens.distort(mapping.moving_lens, geometry.apply(mapping.fixed_to_moving, undistorted + z * baseline))
            for z in (self.middle_px - self.half_px, self.middle_px, self.middle_px + self.half_px)
        )
        coefficients = middle, (last - first) / 2, (last + first) / 2 - middle
        return tuple(_between_nodes(values, self.fixed.size_px) for values in coefficients)


def _structure(raster: Raster, window_px: int) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Return real and imaginary part of the structure field and the square root of its energy in windows."""
    field = structure_field(raster)
    real, imaginary = np.ascontiguousarray(field.real), np.ascontiguousarray(field.imag)
    energy = cv2.boxFilter(real * real + imaginary * imaginary, -1, (window_px, window_px))
    return real, imaginary, np.sqrt(energy + np.float32(_MIN_ENERGY))


def _nodes_px(length_px: int) -> NDArray[np.float64]:
    """Return the nodes along one axis, at which `_between_nodes` expects values."""
    return np.arange(-0.5 - _NODE_STEP_PX / 2, length_px + _NODE_STEP_PX, _NODE_STEP_PX)


def _between_nodes(at_nodes: NDArray[np.float64], size_px: tuple[int, int]) -> FloatImage:
    """Interpolate values (m, n, 2) at nodes linearly at all pixels, (2, height, width).

    The first node is half a step before the border of pixel 0, so that cv2.resize, which is faster than cv2.remap,
    puts pixel 0 at _NODE_STEP_PX.
    """
    rows, columns = (slice(_NODE_STEP_PX, _NODE_STEP_PX + length) for length in reversed(size_px))
    enlarged_px = at_nodes.shape[1] * _NODE_STEP_PX, at_nodes.shape[0] * _NODE_STEP_PX
    planes = (np.ascontiguousarray(at_nodes[..., k], np.float32) for k in (0, 1))
    return np.stack([cv2.resize(plane, enlarged_px)[rows, columns] for plane in planes])
