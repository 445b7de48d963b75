"""Dense parallax of the reference by multi-baseline stereo, coarse to fine.

For each candidate parallax z, every band is resampled along its baseline, and its structure is correlated with that of
the reference in small windows. The costs of all bands are summed (Okutani & Kanade 1993) and truncated, so that an
occluded or noisy band adds a constant. The structure is the double-angle gradient field of `pixels.structure`, which
does not depend on the sign of contrast.

Three levels: a wide search at a quarter of the resolution determines the range of z, semi-global matching at half the
resolution preserves edges, and a local search at full resolution refines z per pixel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.resample import shrink
from agalign.pixels.structure import structure_field
from agalign.relief.semi_global import aggregated, sub_label_minimum
from agalign.values import geometry, lens
from agalign.values.image import FloatImage, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale
from agalign.values.relief import Relief

Costs = NDArray[np.uint8]
"""(levels, height, width): 1 - correlation of one band, in units of 1 / 255."""

_MAX_REFINED_PX = 3_000_000
"""Larger references are reduced to this many pixels, which limits memory and time."""
_SEARCH_SCALE, _MATCH_SCALE = 0.25, 0.5
"""Resolution of the wide search and of semi-global matching, relative to the final resolution."""
_SEARCH_NEARER, _SEARCH_FARTHER = 0.06, 0.03
"""Searched parallax as a share of the longer side: for lenses 3 cm apart and a reference plane 1 m away, an object at
half that range, and the floor."""
_SEARCH_STEP_PX = 2.0
"""Half a pixel of the reduced images; the correlation peak is about one pixel wide."""
_MIN_SEARCH_CORRELATION = 0.6
"""Pixels with a lower correlation in the wide search (occlusions, noise) do not extend the range."""
_MIN_PIXEL_SHARE = 0.003
"""Fewer pixels at an extreme parallax are taken for wrong matches."""
_MARGIN_PX = 4.0
"""Added to the range of the wide search: twice its resolution."""
_MAX_LEVELS, _STEPS_PX = 96, (0.5, 1.0)
"""Maximum number of parallax levels, and the spacings between which _MAX_FINE_LEVELS decides."""
_MAX_FINE_LEVELS = 48
"""The smaller spacing is used if it gives at most this many levels."""
_WINDOW_PX, _FINE_WINDOW_PX = 7, 11
"""Sides of the correlation windows in semi-global matching and at full resolution."""
_UNIT_COST = 255
"""Integer cost of zero correlation."""
_MAX_COST = 0.9
"""Truncation of the cost: correlations below 0.1 are treated as occlusion."""
_SMALL_STEP, _LARGE_STEP = 0.06, 0.4
"""Penalties of semi-global matching relative to the cost of zero correlation in all bands."""
_FINE_STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Candidates around the result of semi-global matching, in units of its step."""
_MEDIAN_PX = 5
"""Window of the median filters, which remove isolated wrong pixels."""
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

    def __init__(self, reference: Raster, views: Sequence[View], window_range_px: tuple[float, float]) -> None:
        """Compute the costs; `reference` has one channel, `window_range_px` is the parallax range of the windows."""
        self.reference, self.views = reference, views
        self.scale = min(1.0, (_MAX_REFINED_PX / reference.valid.size) ** 0.5)
        low, high = self._range_px(window_range_px)
        count = (high - low) / _STEPS_PX[0]
        self.step_px = max(_STEPS_PX[0] if count <= _MAX_FINE_LEVELS else _STEPS_PX[1], (high - low) / _MAX_LEVELS)
        self.levels_px = np.arange(low, high + self.step_px, self.step_px)
        self.matcher = _Matcher(reference, views, self.scale * _MATCH_SCALE, _WINDOW_PX, (low, high))
        self.costs = [self.matcher.costs(band, self.levels_px) for band in range(len(views))]

    def matched(self, bands: Sequence[int]) -> Relief:
        """Return the relief from some bands at the resolution of semi-global matching."""
        parallax_px, confidence = _semi_global_match(self.costs, bands, self.levels_px)
        return Relief(parallax_px, confidence, self.matcher.scale)

    def refined(self, views: Sequence[View], selections: Sequence[Sequence[int]]) -> list[Relief]:
        """Return the relief of each selection of bands at full resolution, with refitted views."""
        margin = 2 * self.step_px
        limits = self.levels_px[0] - margin, self.levels_px[-1] + margin
        matcher = _Matcher(self.reference, views, self.scale, _FINE_WINDOW_PX, limits)
        return [self._refined(matcher, bands) for bands in selections]

    def _refined(self, matcher: "_Matcher", bands: Sequence[int]) -> Relief:
        start = cv2.resize(self.matched(bands).parallax_px, matcher.size_px, interpolation=cv2.INTER_LINEAR)
        steps_px = [step * self.step_px for step in _FINE_STEPS]
        costs = np.zeros((len(steps_px), *start.shape), np.float32)
        for band in bands:
            for k, correlation in enumerate(matcher.correlations(band, start, steps_px)):
                costs[k] += np.minimum(1 - correlation, np.float32(_MAX_COST))
        labels = sub_label_minimum(costs)
        confidence = np.clip(1 - costs.min(axis=0) / len(bands), 0, 1)
        parallax_px = start + np.float32(steps_px[0]) + labels * np.float32(steps_px[1] - steps_px[0])
        return Relief(np.asarray(cv2.medianBlur(parallax_px, _MEDIAN_PX)), confidence, matcher.scale)

    def _range_px(self, windows_px: tuple[float, float]) -> tuple[float, float]:
        """Return the range of parallax in the windows and the wide search."""
        longer_side_px = max(self.reference.size_px)
        low = min(-_SEARCH_FARTHER * longer_side_px, windows_px[0])
        high = max(_SEARCH_NEARER * longer_side_px, windows_px[1])
        levels = np.arange(low, high + _SEARCH_STEP_PX, _SEARCH_STEP_PX)
        scale = self.scale * _SEARCH_SCALE
        matcher = _Matcher(self.reference, self.views, scale, _WINDOW_PX, (low, levels[-1]))
        bands = range(len(self.views))
        parallax_px, confidence = _semi_global_match([matcher.costs(band, levels) for band in bands], bands, levels)
        reliable = parallax_px[confidence >= _MIN_SEARCH_CORRELATION]
        counts = np.bincount(np.rint((reliable - low) / _SEARCH_STEP_PX).astype(int), minlength=len(levels))
        frequent = levels[np.flatnonzero(counts >= _MIN_PIXEL_SHARE * parallax_px.size)]
        occurring = np.array([*windows_px, *frequent])
        return float(occurring.min() - _MARGIN_PX), float(occurring.max() + _MARGIN_PX)


def _semi_global_match(
    costs: Sequence[Costs], bands: Sequence[int], levels_px: NDArray[np.float64]
) -> tuple[FloatImage, FloatImage]:
    """Return the parallax by semi-global matching and its mean correlation, each (height, width)."""
    total = np.zeros(costs[0].shape, np.int16)
    maximum = np.uint8(round(_MAX_COST * _UNIT_COST))
    for band in bands:
        total += np.minimum(costs[band], maximum)
    unit = _UNIT_COST * len(bands)
    labels = sub_label_minimum(aggregated(total, round(_SMALL_STEP * unit), round(_LARGE_STEP * unit)))
    nearest = np.rint(labels).astype(np.intp)[None]
    confidence = 1 - np.take_along_axis(total, nearest, axis=0)[0].astype(np.float32) / unit
    step_px = levels_px[1] - levels_px[0]
    parallax_px = cv2.medianBlur(np.float32(levels_px[0]) + labels * np.float32(step_px), _MEDIAN_PX)
    return np.asarray(parallax_px), confidence


class _Matcher:
    """Structure images and mappings of the reference and the views at one resolution and parallax range."""

    def __init__(
        self, reference: Raster, views: Sequence[View], scale: float, window_px: int, range_px: tuple[float, float]
    ) -> None:
        self.window_px = window_px
        self.full_px = width, height = reference.size_px
        self.size_px = max(1, round(width * scale)), max(1, round(height * scale))
        self.scale = PixelScale.between(reference.size_px, self.size_px)
        self.fixed = cv2.split(self._structure(shrink(reference, self.size_px)))
        self.middle_px, self.half_px = sum(range_px) / 2, max((range_px[1] - range_px[0]) / 2, _SEARCH_STEP_PX)
        self.moving, self.parabolas = [], []
        for view in views:
            size_px = self._moving_size_px(view)
            self.moving.append(self._structure(shrink(view.image, size_px)))
            mapping = view.plane.rescaled(self.scale, PixelScale.between(view.image.size_px, size_px))
            self.parabolas.append(self._parabola(mapping, self.scale.displacements(view.baseline)))

    def costs(self, band: int, levels_px: NDArray[np.float64]) -> Costs:
        """Return the costs of one band at each level, constant over the image."""
        result = np.empty((len(levels_px), *self.fixed[0].shape), np.uint8)
        for k, level in enumerate(levels_px):
            correlation = self._correlation(band, *self._positions(band, np.float32(level)))
            result[k] = cv2.convertScaleAbs(np.maximum(1 - correlation, 0), alpha=_UNIT_COST)
        return result

    def correlations(self, band: int, parallax_px: FloatImage, steps_px: Sequence[float]) -> Iterator[FloatImage]:
        """Yield the correlation (height, width) of one band at the parallax of each pixel plus each of the steps."""
        positions, derivative = self._positions(band, parallax_px[..., None])
        for step in steps_px:
            yield self._correlation(band, positions, derivative, step)

    def _positions(
        self, band: int, parallax_px: NDArray[np.float32] | np.float32
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return positions in a band at a parallax and their derivative per px of it, each (height, width, 2)."""
        a, b, c = self.parabolas[band]
        u = (parallax_px - np.float32(self.middle_px)) / np.float32(self.half_px)
        uc = u * c
        secant = b + uc
        return a + u * secant, (secant + uc) / np.float32(self.half_px)

    def _correlation(
        self, band: int, positions: NDArray[np.float32], derivative: NDArray[np.float32], step_px: float = 0.0
    ) -> FloatImage:
        """Return the normalised correlation of the structures in windows, (height, width), at a parallax step."""
        if step_px:
            positions = cv2.scaleAdd(derivative, step_px, positions)
        warped = cv2.remap(self.moving[band], positions, None, cv2.INTER_LINEAR)
        real, imaginary, energy = cv2.split(warped)
        product = cv2.add(cv2.multiply(self.fixed[0], real), cv2.multiply(self.fixed[1], imaginary))
        norm = cv2.max(cv2.multiply(self.fixed[2], energy), _MIN_ENERGY)
        return np.asarray(cv2.divide(cv2.boxFilter(product, -1, (self.window_px, self.window_px)), norm))

    def _moving_size_px(self, view: View) -> tuple[int, int]:
        """Return the size at which the pixels of a moving image are as large as those of the reduced reference."""
        magnification = abs(float(geometry.local_scale(view.plane.fixed_to_moving, *self.full_px)[-1]))
        ratio = min(1.0, self.scale.mean / magnification)
        width, height = view.image.size_px
        return max(1, round(width * ratio)), max(1, round(height * ratio))

    def _structure(self, raster: Raster) -> FloatImage:
        """Return (height, width, 3): real and imaginary part of the structure field, square root of its energy in
        windows.
        """
        field = structure_field(raster)
        energy = cv2.boxFilter(field.real**2 + field.imag**2, -1, (self.window_px, self.window_px))
        return np.dstack([field.real, field.imag, np.sqrt(energy + np.float32(_MIN_ENERGY))]).astype(np.float32)

    def _parabola(
        self, mapping: PixelMapping, baseline: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return (a, b, c), each (height, width, 2): positions in a moving image are a + b u + c u^2.

        u is from -1 to 1 over the range of parallax. Interpolated linearly on a grid; the error is below 0.01 px.
        """
        width, height = self.size_px
        nodes = np.stack(np.meshgrid(_nodes_px(width), _nodes_px(height)), axis=-1)
        undistorted = mapping.undistorted(nodes)
        first, middle, last = (
            lens.distort(mapping.moving_lens, geometry.apply(mapping.fixed_to_moving, undistorted + z * baseline))
            for z in (self.middle_px - self.half_px, self.middle_px, self.middle_px + self.half_px)
        )
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = x / np.float32(_NODE_STEP_PX), y / np.float32(_NODE_STEP_PX)
        coefficients = middle, (last - first) / 2, (last + first) / 2 - middle
        a, b, c = (cv2.remap(f.astype(np.float32), x, y, cv2.INTER_LINEAR) for f in coefficients)
        return np.asarray(a), np.asarray(b), np.asarray(c)


def _nodes_px(length_px: int) -> NDArray[np.float64]:
    return np.arange(0.0, length_px + _NODE_STEP_PX, _NODE_STEP_PX)
