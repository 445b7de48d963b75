"""Checks of an alignment, which find its issues (`values.issues` has the kinds of issues).

A new check is one function, which yields issues, and one line in `issues_of`, or in `WarpedPair.issues` if it needs the
pixels of the images. The worst error is a wrong alignment called `aligned`. Negated comparisons also reject NaN.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.structure import Field, correlation_surfaces, inverse_transform, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import BY_WINDOWS, JointResult, Prediction
from agalign.values.geometry import Matrix, Points
from agalign.values.issues import (
    CLOSE_WINDOWS,
    CLUSTER,
    COVERAGE,
    FEW_WINDOWS,
    FOLDS,
    INACCURATE,
    OTHER_CONTENT,
    REPEATS,
    RETRIEVAL,
    SECOND_LAYER,
    UNEXPECTED_PX,
    UNMEASURED,
    Issue,
)
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size
from agalign.values.residual import Residual, noise_px

MAX_UNEXPECTED_PX = 3.0
"""Distance from the prediction by the rig, px of the moving file, that is always accepted, as relief may cause it."""
MAX_ALIAS_PEAK = 0.75
"""Ratio of the heights of the next correlation peak and that of the result, above which the scene is repetitive."""
_MIN_ALIAS_SIGMA = 5.0
"""Height of such a peak in standard deviations. Noise far from the result reaches 4.5; the result of a thermal band may
have 18, a quarter of which is the height of a scene that repeats three times."""

_MIN_COMMON_COVERAGE = 0.3
"""Minimum share of the windows with a measured shift; in a band of noise, a tenth has one by chance."""
_MIN_WINDOWS = 5
"""Minimum number of measured windows: some homography fits the two coordinates of any four."""
_MIN_VERIFYING_WINDOWS = 12
"""Held-out windows with a measured shift that verify a result without descriptors: in unrelated images, one in a
thousand is aligned."""
_MAX_ERROR_PX, _MIN_ACCURATE_SHARE = 0.5, 0.9
"""`aligned` means an expected error of at most this in this share of the common area; that of a relief counts at the
windows. If the RMS error is 0.5 px, 2 % of the pixels are off by more than 1 px."""
_MAX_LAYER_SHARE, _MAX_LAYER_NOISE = 0.07, 12.0
"""Largest share of a second layer, as such and relative to its noise. Bands of real flights have up to 0.03, with noise
up to 0.14 and 9; half saturated ones without tags, a tenth of which is off by more than 1 px, 0.07 to 0.23 and 12 to
20; synthetic rows of vines that are displaced from the soil by 1.5 to 5 px 0.10 to 0.46 and 17 to 41."""
MAX_SHIFT_PX = 1.0
"""Maximum residual shift of an aligned window: beyond it, a spectral index mixes neighbours."""
_MAX_NOISE_STD = 2.0
"""A window is misaligned if its shift is beyond MAX_SHIFT_PX and this multiple of its noise, added in quadrature; by
noise alone, 2 % are beyond the multiple."""
_MIN_CLOSE_SHARE = 0.9
"""Minimum share of aligned windows among the measured ones: a few wrong peaks are normal."""
_MIN_CLUSTER, _MAX_CLUSTER_SHARE = 5, 0.04
"""Size of a cluster of adjacent misaligned windows, as a count and as a share of the measured windows, from which it is
an issue; both must be reached. Wrong peaks are scattered, windows with parallax are adjacent."""
_MAX_UNEXPECTED_STD = 5.0
"""Distances from the prediction above MAX_UNEXPECTED_PX are accepted up to this multiple of its standard error."""


def issues_of(
    mapping: PixelMapping,
    error: MappingError,
    residual: Residual,
    joint: JointResult | None,
    common_px: Points,
    pixel_px: float,
) -> tuple[Issue, ...]:
    """Return every reason for not accepting a mapping of a reference, without its pixels; empty if it passes.

    The first issue is the reason in the sidecar. `residual` is measured with the mapping, `joint` is the evidence of
    descriptors, and `common_px` (n, 2) are points of the whole area that the moving image covers. `pixel_px` is the
    size of a pixel of the reference's file on this grid: limits of shifts and errors are in px of the file.
    """
    return (
        *_mapping_issues(mapping.fixed_to_moving, error.size_px),
        *_descriptor_issues(joint, residual),
        *_window_issues(residual, pixel_px),
        *_error_issues(error, residual, common_px, pixel_px),
    )


def _mapping_issues(fixed_to_moving: Matrix, size_px: Size) -> Iterator[Issue]:
    max_stretch = 4.0  # of the largest magnification relative to the smallest; beyond it, a homography is degenerate
    scale = geometry.local_scale(fixed_to_moving, *size_px)
    if not (scale.min() > 0 and scale.max() <= max_stretch * scale.min()):
        yield Issue(FOLDS, float(scale.max() / scale.min()), max_stretch)


def _descriptor_issues(joint: JointResult | None, residual: Residual) -> Iterator[Issue]:
    """Retrieval of held-out patches, or held-out windows of a result that is fitted to windows."""
    if joint is None:
        return
    count = len(residual.measured_px)
    if joint.is_retrieved or (joint.recipe == BY_WINDOWS and count >= _MIN_VERIFYING_WINDOWS):
        return
    if joint.recipe == BY_WINDOWS and joint.retrieval >= joint.min_retrieval:
        yield Issue(FEW_WINDOWS, count, _MIN_VERIFYING_WINDOWS)
    else:
        yield Issue(RETRIEVAL, joint.retrieval, joint.min_retrieval)


def _window_issues(residual: Residual, pixel_px: float) -> Iterator[Issue]:
    """Residual shifts of windows, each without its own part in the estimation."""
    measured = len(residual.measured_px)
    is_covered = residual.coverage >= _MIN_COMMON_COVERAGE
    if measured < _MIN_WINDOWS and (is_covered or len(residual.centres_px) < _MIN_WINDOWS):
        yield Issue(FEW_WINDOWS, measured, _MIN_WINDOWS)
        return
    if not is_covered:
        yield Issue(COVERAGE, residual.coverage, _MIN_COMMON_COVERAGE)
    count = max(measured, 1)
    is_far = is_misaligned(residual, pixel_px)
    close = 1 - float(is_far.sum()) / count
    if not close >= _MIN_CLOSE_SHARE:
        yield Issue(CLOSE_WINDOWS, close, _MIN_CLOSE_SHARE, f"{MAX_SHIFT_PX:g} px")
    cluster = _largest_cluster(residual.cells[is_far])
    limit = max(_MIN_CLUSTER, round(_MAX_CLUSTER_SHARE * measured))
    if not cluster < limit:
        yield Issue(CLUSTER, cluster / count, limit / count)


def is_misaligned(residual: Residual, pixel_px: float) -> NDArray[np.bool_]:
    """Return True (n,) for windows with a shift that neither the limit nor its noise explain.

    `pixel_px` is the size of a pixel of the reference's file on this grid.
    """
    lengths_px = np.linalg.norm(np.nan_to_num(residual.shifts_px), axis=1)
    noise = noise_px(np.maximum(residual.peaks_sigma, 1e-6))
    return np.asarray(lengths_px > np.hypot(MAX_SHIFT_PX * pixel_px, _MAX_NOISE_STD * noise))


def _error_issues(error: MappingError, residual: Residual, common_px: Points, pixel_px: float) -> Iterator[Issue]:
    """Check the expected error over the common area.

    No image shows the error of a relief at a pixel without texture. Under a relief, the smooth part of the error is
    checked over the area, and all of it at the windows. A relief comes from other bands, so its error is small even
    where this band shows a different scene: the band must have a measured shift in the windows.
    """
    if not len(common_px):
        return
    errors_px = [np.sqrt(np.sum(error.parts_px2(common_px), axis=0))]
    if error.parallax is not None and len(residual.centres_px):
        errors_px.append(error.error_px(residual.centres_px))
    share = min(float((px <= _MAX_ERROR_PX * pixel_px).mean()) for px in errors_px)
    if not share >= _MIN_ACCURATE_SHARE:
        yield Issue(INACCURATE, 1 - share, 1 - _MIN_ACCURATE_SHARE, f"{_MAX_ERROR_PX:g} px")
    if error.parallax is not None and not residual.coverage >= _MIN_ACCURATE_SHARE:
        yield Issue(UNMEASURED, 1 - residual.coverage, 1 - _MIN_ACCURATE_SHARE)


class Layer(NamedTuple):
    """Structure that is displaced from where the mapping expects it, in parts that are smaller than the windows."""

    shift_px: tuple[float, float]
    """(x, y), px of the fixed image."""
    share: float
    """About how much of the structure."""
    max_share: float
    """Largest share that may be noise."""

    @property
    def rms_px(self) -> float:
        """RMS error of the mapping by the layer."""
        return math.sqrt(min(self.share, 1.0)) * math.hypot(*self.shift_px)


def second_layer(surface: NDArray[np.float32]) -> Layer | None:
    """Return a second layer, as of vines beside the soil, that the mean correlation surface (side, side) of windows
    shows; its zero shift is at [0, 0].

    The surface of one layer is symmetric, also if the scene repeats. What it is higher by at a shift d than at -d,
    relative to the peak, is the share of a layer that is displaced by d. Its noise is that at larger shifts.
    """
    side, at_zero = len(surface), float(surface[0, 0])
    reach = min(10, side // 4)  # px; larger shifts have peaks of their own
    if not at_zero > 0:
        return None
    # Rows and columns from -reach to reach in the middle.
    every = np.arange(1 - side % 2 - side // 2, side // 2 + 1)
    centred = surface[np.ix_(every, every)] / at_zero
    excess = centred - surface[np.ix_(-every, -every)] / at_zero
    x, y = np.meshgrid(every, every)
    min_px = 1.5  # nearer, the excess may be a small error of the mapping
    distance_px = np.hypot(x, y)
    is_near = (np.abs(x) <= reach) & (np.abs(y) <= reach)
    noise = float(excess[~is_near].std())
    candidates = np.where(is_near & (distance_px >= min_px), excess, 0)
    row, column = np.unravel_index(int(candidates.argmax()), candidates.shape)
    share = float(candidates[row, column])
    max_share = max(_MAX_LAYER_SHARE, _MAX_LAYER_NOISE * noise)
    return Layer((float(x[row, column]), float(y[row, column])), share, max_share) if share > max_share else None


def layer_issues(layer: Layer | None, pixel_px: float) -> Iterator[Issue]:
    """A second layer, by its share of the structure; its shift is in px of the file, `pixel_px` each."""
    if layer is not None:
        shift_px = math.hypot(*layer.shift_px) / pixel_px
        yield Issue(SECOND_LAYER, layer.share, layer.max_share, f"{shift_px:.0f} px")


def content_issues(residual: Residual, pixel_px: float) -> Iterator[Issue]:
    """An area with texture in both bands and no common peak shows something else. Single windows are normal.

    The windows must cover the image once.
    """
    is_lost = ~residual.is_measured | is_misaligned(residual, pixel_px)
    area = _solid_area(residual.cells, is_lost)
    if area:
        yield Issue(OTHER_CONTENT, area / len(is_lost), 0.0)


def _solid_area(cells: NDArray[np.int64], is_lost: NDArray[np.bool_]) -> int:
    """Return the number of lost windows in rectangles of only lost ones that scattered ones do not fill.

    `cells` are the columns and rows (n, 2) of the windows. How many windows are scattered is their share outside of a
    rectangle, as an area of another content may be a large part of the image, and a strip as well as a block.
    """
    max_chance = 0.0025  # that scattered windows fill a rectangle of one shape somewhere
    # Smaller areas without a peak are normal, also strips: noise hides the structure where there is least of it.
    min_side, min_windows, min_share_of_strip = 2, 8, 0.15
    count, lost = len(cells), int(is_lost.sum())
    if lost < min_windows:
        return 0
    occupied = np.zeros(cells.max(axis=0) + 1, np.uint8)
    occupied[tuple(cells[is_lost].T)] = 1
    sizes = np.arange(min_windows, min(lost, count - 1) + 1)  # at least one window is outside
    shares = (lost - sizes) / (count - sizes)
    enough = sizes[count * shares**sizes <= max_chance]  # larger rectangles are less likely
    solid = np.zeros_like(occupied)
    for across in range(min_side, len(occupied) + 1 if len(enough) else 0):
        along = max(min_side, -(-int(enough[0]) // across))
        if min(across, along) == min_side and across * along < min_share_of_strip * count:
            along = max(min_side + 1, math.ceil(min_share_of_strip * count / across))
        rectangle, last = np.ones((across, along), np.uint8), (along - 1, across - 1)
        origins = cv2.erode(occupied, rectangle, anchor=(0, 0), borderValue=0)
        solid |= cv2.dilate(origins, rectangle, anchor=last)
    return int(solid.sum())


def _largest_cluster(cells: NDArray[np.int64]) -> int:
    """Return the size of the largest group of adjacent windows, also diagonally, with columns and rows (n, 2)."""
    if len(cells) == 0:
        return 0
    occupied = np.zeros(cells.max(axis=0) + 1, np.uint8)
    occupied[tuple(cells.T)] = 1
    _, _, statistics, _ = cv2.connectedComponentsWithStats(occupied, connectivity=8)
    return int(statistics[1:, cv2.CC_STAT_AREA].max())


def rig_issues(prediction: Prediction) -> Iterator[Issue]:
    """Distance of a result from the prediction by the rig, which detects aliasing in repetitive scenes."""
    if prediction.off_px is not None and not prediction.off_px <= (limit_px := max_expected_px(prediction.std_px)):
        yield Issue(UNEXPECTED_PX, prediction.off_px, limit_px)


def max_expected_px(std_px: float) -> float:
    """Return the distance up to which a mapping with this standard error does not contradict another one, px."""
    return max(MAX_UNEXPECTED_PX, _MAX_UNEXPECTED_STD * std_px)


class AliasPeak(NamedTuple):
    """A correlation peak away from the result: its shift (x, y), px of the fixed image, and its relative height."""

    shift_px: tuple[float, float]
    ratio: float


def alias_peaks(fixed: Field, moving: Field, scale: PixelScale = SAME_PIXELS) -> list[AliasPeak]:
    """Return the peaks above MAX_ALIAS_PEAK except that at zero shift, the highest first; `fixed` and `moving` are
    windowed spectra (height, width).

    They are of images that are reduced by `scale`. Without a peak at zero shift, the highest one is returned.
    """
    height, width = fixed.shape
    correlation = np.fft.fftshift(correlation_surfaces(fixed, moving))
    surface = correlation / _height_of_repetition(height, width)
    row, column = height // 2, width // 2
    radius_px = 3  # of a correlation peak
    centre = np.s_[row - radius_px : row + radius_px + 1, column - radius_px : column + radius_px + 1]
    centre_peak = float(surface[centre].max())
    surface[centre] = -np.inf
    ratios = surface / centre_peak if centre_peak > 0 else np.where(surface == surface.max(), np.inf, 0.0)
    is_highest = surface == cv2.dilate(surface, np.ones((2 * radius_px + 1,) * 2, np.uint8))
    is_noise = (correlation < _MIN_ALIAS_SIGMA * correlation.std()) & (centre_peak > 0)
    rows, columns = np.nonzero(is_highest & (ratios > MAX_ALIAS_PEAK) & ~is_noise)
    found = zip((columns - column) / scale.x, (rows - row) / scale.y, ratios[rows, columns], strict=True)
    return sorted((AliasPeak((float(x), float(y)), float(ratio)) for x, y, ratio in found), key=lambda a: -a.ratio)


@cache
def _height_of_repetition(height: int, width: int) -> NDArray[np.float32]:
    """Return the height (height, width) of the correlation peaks of a scene that repeats, by shift, relative to the
    peak in the middle.

    It is about the square of the overlap of the windowed images: of three, four, five and six repetitions 0.27, 0.52,
    0.67 and 0.75, where they overlap by 0.50, 0.67, 0.77 and 0.83.
    """
    min_height = 0.25  # smaller ones would amplify noise: peaks of real flights with noise would reach 0.7
    one = windowed_spectra(np.ones((1, height, width), np.complex64))
    overlap = np.fft.fftshift(inverse_transform(np.conj(one) * one).real[0])
    return np.asarray(np.maximum(np.square(overlap / overlap.max()), min_height), np.float32)


def repetition_issues(
    aliases: Sequence[AliasPeak], is_expected: Callable[[tuple[float, float]], bool], pixel_px: float
) -> Iterator[Issue]:
    """Another shift fits nearly as well in an orchard or on solar panels, and no prior information excludes it.

    `is_expected` returns True if the mapping shifted by (x, y), px of the fixed image, agrees with tags, flight or
    user.
    """
    is_known = is_expected((0.0, 0.0))
    for alias in aliases:
        if not is_known or is_expected(alias.shift_px):
            yield Issue(REPEATS, math.hypot(*alias.shift_px) / pixel_px)
            return


def seed_fits(residual: Residual) -> bool:
    """Return True if the residual of a seed is small enough for the status `seed_only`."""
    max_median_px = 8.0  # rig tags of flights have median errors of 2 to 9 px (benchmarks/seeds.py)
    if len(residual.measured_px) < min(_MIN_WINDOWS, len(residual.centres_px)):
        return False
    return residual.coverage >= _MIN_COMMON_COVERAGE and residual.median_px <= max_median_px


def is_unchanged(joint: JointResult, given: Matrix, size_px: tuple[int, int], scale: float = 1.0) -> bool:
    """Return True if a result on an image (width, height) is so near the mapping `given` by the files that resampling
    would cost more than it gains.

    `scale` is the size of the image relative to its file.
    """
    change = geometry.compose(geometry.invert(given), joint.fixed_to_moving)
    change_px = float(geometry.corner_error_px(change, geometry.identity(), *size_px))
    # Px of the file, and standard errors of the least certain corner. Resampling would cost more sharpness than such a
    # small correction gains.
    max_unchanged_px, max_unchanged_std = 0.25, 3.0
    return change_px <= min(max_unchanged_px * scale, joint.corner_std_px * max_unchanged_std)
