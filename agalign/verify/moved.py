"""Areas that moved between the exposures of two bands, or that are nearer than the mapping assumes.

The structures of the two images agree there under another shift, and contradict the mapping. The search has four steps:

1. The agreement of the images under the mapping, in boxes of 28 px; candidates have texture in both images and little
   agreement.
2. The best other shift of each window of candidates, at half the resolution. It must be unique: edges, stripes and
   blurred blobs fit many.
3. The agreement under this shift at full resolution, for adjacent windows with the same shift. It must be high, and the
   two images must contradict each other also where the band shows what moved.
4. The outline of the pixels that agree better under this shift than under the mapping.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from agalign.pixels.structure import Field, paraboloid_peaks
from agalign.values.image import FloatImage, Mask
from agalign.values.moved_area import MovedArea
from agalign.verify.checks import MAX_ALIAS_PEAK

_CELL_PX = 4
"""Agreement varies slowly: at every fourth pixel it costs a tenth."""
_BOX_CELLS = 7
"""Side of the boxes of agreement: 28 px, less than the smallest objects (40 px); in smaller boxes, unrelated
structures agree by chance."""
_WINDOW_PX, _STEP_PX = 32, 16
"""Side of the windows that are searched, and their spacing: at least two are mostly in an object of 40 px."""
_SEARCH_PX = 80
"""Largest shift along each axis: a landing leg half a metre from the lenses of a RedEdge moves by up to 72 px."""
_MIN_ENERGY = 0.02
"""Mean square of the structure field, at most 1, below which a box has no texture; sharp fields have 0.5."""
_MIN_TYPICAL = 0.3
"""Median agreement of a pair, 1 in equal images, below which low agreement is noise or blur and claims nothing. Pairs
of ten real flights have 0.4 to 0.95, waves on water 0.26."""
_LOW = 0.6
"""Agreement under the mapping, relative to the typical one, below which an area may have moved: a shift of 2 px halves
the agreement of sharp and of soft textures."""
_AGREES = 0.5
"""Minimum agreement of a box under the other shift, relative to the typical one."""
_GAIN = 0.25
"""Minimum difference of the agreements of a box, relative to the typical one."""
_GROWS = 0.3
"""The same for boxes at the edge of an area, half of which show what moved."""
_MIN_WINDOWS, _MIN_CELLS = 2, 25
"""Windows with the same shift, and cells that agree under it (20 x 20 px), from which an area is reported: none of ten
objects of 24 px, six of 28 px, eight of 32 px and all of 36 px, at random places with shifts of 3 to 40 px."""
_SAME_PX = 2
"""Shifts of windows that differ by up to this are the same: they are measured at every second pixel."""
MIN_MOVED_PX = 1.5
"""Shifts below it are errors of mapping and noise, which the expected error describes."""
_MIN_RATIO = 4.0
"""Minimum ratio of the shift of an area to those of the windows elsewhere, which are errors of the mapping too: the
expected error contains windows in the areas."""


class _Windows(NamedTuple):
    """The top left pixels (n, 2) of windows, and the shifts (n, 2), px, under which they agree."""

    origins_px: NDArray[np.int64]
    shifts_px: NDArray[np.int64]


@dataclass(frozen=True)
class _Pair:
    """Two structure fields and their agreement under the mapping; maps of cells are (rows, columns)."""

    fixed: FloatImage
    """(height, width, 2), both sides multiples of a cell."""
    moving: FloatImage
    energy: FloatImage
    """Mean square of the fixed field, where both images are valid."""
    agreement: FloatImage
    typical: float
    """Median agreement of the boxes with texture."""
    is_candidate: Mask

    @classmethod
    def of(cls, fixed: Field, moving: Field, valid: Mask) -> "_Pair | None":
        """Measure the agreement of two fields (height, width); None if that of the whole pair is low."""
        height, width = (n - n % _CELL_PX for n in valid.shape)
        inside = cv2.erode(valid[:height, :width].astype(np.uint8), np.ones((3, 3), np.uint8))
        known = cv2.copyTo(moving[:height, :width].view(np.float64), inside)  # 64 bits: both parts of a pixel
        planes = _planes(fixed[:height, :width]), known.view(np.float32).reshape(height, width, 2)
        is_known = _cells(inside.astype(np.float32))
        energy, of_moving = (_box(_product(one, one) * is_known) for one in planes)
        agreement = _relative(_box(_product(planes[0], planes[1])), energy, of_moving)
        has_texture = (np.minimum(energy, of_moving) > _MIN_ENERGY) & (_box(is_known) > 0.5)
        typical = float(np.median(agreement[has_texture])) if has_texture.any() else 0.0
        if typical < _MIN_TYPICAL:
            return None
        return cls(planes[0], planes[1], energy, agreement, typical, has_texture & (agreement < _LOW * typical))

    def under(self, shift_px: tuple[int, int], area: tuple[slice, slice]) -> FloatImage:
        """Return the agreement of an area of the reference, px, with the moving image at a shift (x, y)."""
        fixed = self.fixed[area]
        moving = cv2.warpAffine(
            self.moving,
            np.array([[1, 0, -shift_px[0] - area[1].start], [0, 1, -shift_px[1] - area[0].start]], np.float64),
            (fixed.shape[1], fixed.shape[0]),
            flags=cv2.INTER_NEAREST,
        )
        return _relative(_box(_product(fixed, moving)), self.energy[_in_cells(area)], _box(_product(moving, moving)))

    def agreement_at(self, shift_px: NDArray[np.float64]) -> FloatImage:
        """Return the agreement under the mapping at all cells displaced by a shift (x, y), 1 outside the image."""
        x, y = (-shift_px / _CELL_PX).tolist()
        size = self.agreement.shape[::-1]
        return np.asarray(
            cv2.warpAffine(self.agreement, np.array([[1, 0, x], [0, 1, y]]), size, borderValue=1.0), np.float32
        )


def moved_areas(fixed: Field, moving: Field, valid: Mask, median_px: float = 0.0) -> tuple[MovedArea, ...]:
    """Return the areas in which two images agree under another shift, and contradict the mapping between them.

    Parameters
    ----------
    fixed, moving
        (height, width): structure fields of the reference, and of the moving image under the mapping, in which invalid
        pixels may have any value.
    valid
        (height, width): True where both images have pixels that are not saturated.
    median_px
        Median shift of the windows under the mapping, px of the fixed image.

    Returns
    -------
    tuple of MovedArea
        Px of the fixed image; empty for a pair without texture, or whose images agree nowhere.
    """
    pair = _Pair.of(fixed, moving, valid)
    if pair is None:
        return ()
    areas = (area for group in _groups(_found(pair, _candidates(pair))) for area in _areas(pair, group))
    return tuple(area for area in areas if area.length_px >= _MIN_RATIO * median_px)


def _candidates(pair: _Pair) -> NDArray[np.int64]:
    """Return the top left pixels (n, 2) of windows half of which are candidates; inside of large areas every second."""
    side, step = _WINDOW_PX // _CELL_PX, _STEP_PX // _CELL_PX
    share = cv2.blur(pair.is_candidate.astype(np.float32), (side, side), anchor=(0, 0))
    rows, columns = (n - side + 1 for n in share.shape)
    wanted = share[: max(rows, 0) : step, : max(columns, 0) : step] >= 0.5
    if not wanted.any():
        return np.empty((0, 2), np.int64)
    inner = cv2.erode(wanted.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    inner[::2, ::2] = False
    y, x = np.nonzero(wanted & ~inner)
    return np.stack([x, y], axis=1) * _STEP_PX


def _found(pair: _Pair, origins_px: NDArray[np.int64]) -> _Windows:
    """Return the shifted windows: first those on the black fields of a chessboard, and the white ones without a black
    neighbour; then the neighbours of those that are found. Areas have several windows, so that none is lost.
    """
    if not len(origins_px):
        return _Windows(origins_px, origins_px)
    is_black = (origins_px // _STEP_PX).sum(axis=1) % 2 == 0
    is_first = is_black | ~_are_near(origins_px, origins_px[is_black], _STEP_PX)
    first = _shifted_windows(pair, origins_px[is_first])
    second = _shifted_windows(pair, origins_px[~is_first & _are_near(origins_px, first.origins_px, _WINDOW_PX)])
    return _Windows(*(np.concatenate(both) for both in zip(first, second, strict=True)))


def _are_near(points: NDArray[np.int64], others: NDArray[np.int64], distance: int) -> Mask:
    """Return True (n,) for points (n, 2) up to a distance from any others (m, 2), in the maximum norm."""
    if not len(others):
        return np.zeros(len(points), bool)
    return np.asarray(cKDTree(others).query(points, p=np.inf)[0] <= distance)


def _shifted_windows(pair: _Pair, origins_px: NDArray[np.int64]) -> _Windows:
    """Return the windows of the reference that agree with the moving image under one shift only."""
    side, reach = _WINDOW_PX // 2, _SEARCH_PX // 2  # at half the resolution
    if not len(origins_px):
        return _Windows(origins_px, origins_px)
    fixed = _half(pair.fixed)
    moving = cv2.copyMakeBorder(_half(pair.moving), reach, reach, reach, reach, cv2.BORDER_CONSTANT)
    of_moving = cv2.blur(_squares(moving), (side, side), anchor=(0, 0))
    shifts_px, is_found = np.empty_like(origins_px), np.zeros(len(origins_px), bool)
    placements = np.s_[: 2 * reach + 1, : 2 * reach + 1]
    for i, (x, y) in enumerate((origins_px // 2).tolist()):
        window, searched = fixed[y : y + side, x : x + side], moving[y : y + side + 2 * reach, x : x + side + 2 * reach]
        surface = _correlation(window, searched)[placements] / np.float32(side**2)
        surface = _relative(surface, _squares(window).mean(), of_moving[y:, x:][placements])
        row, column = divmod(int(surface.argmax()), 2 * reach + 1)
        peak = float(surface[row, column])
        near = 3  # px in which the structure of a sharp image still agrees with itself
        surface[max(0, row - near) : row + near + 1, max(0, column - near) : column + near + 1] = 0
        shifts_px[i] = 2 * (column - reach), 2 * (row - reach)
        is_found[i] = float(surface.max()) <= MAX_ALIAS_PEAK * peak
    is_found &= np.hypot(*shifts_px.T) >= MIN_MOVED_PX
    return _Windows(origins_px[is_found], shifts_px[is_found])


def _correlation(window: FloatImage, searched: FloatImage) -> FloatImage:
    """Return the sum of Re(conj(z) w) for each placement of a window z (side, side, 2) in a larger field w."""
    height, width = searched.shape[:2]
    padded = cv2.copyMakeBorder(
        window, 0, height - len(window), 0, width - window.shape[1], cv2.BORDER_CONSTANT | cv2.BORDER_ISOLATED
    )
    of_window, of_searched = cv2.dft(padded), cv2.dft(np.ascontiguousarray(searched))
    cross = cv2.mulSpectrums(of_searched, of_window, 0, conjB=True)
    return np.asarray(cv2.idft(cross, flags=cv2.DFT_SCALE)[..., 0], np.float32)


def _groups(windows: _Windows) -> Iterator[_Windows]:
    """Yield the groups of adjacent windows with the same shift, as far as they are large enough."""
    if not len(windows.origins_px):
        return
    places = np.hstack([windows.origins_px / _WINDOW_PX, windows.shifts_px / _SAME_PX])
    pairs = cKDTree(places).query_pairs(1.0, p=np.inf, output_type="ndarray")
    adjacent = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    count, labels = connected_components(adjacent, directed=False)
    for label in range(count):
        group = _Windows(windows.origins_px[labels == label], windows.shifts_px[labels == label])
        if len(group.origins_px) >= _MIN_WINDOWS:
            yield group


def _areas(pair: _Pair, group: _Windows) -> Iterator[MovedArea]:
    """Yield the areas that agree under the shift of a group of windows."""
    height, width = pair.fixed.shape[:2]
    left, top = np.maximum(group.origins_px.min(axis=0) - _WINDOW_PX, 0).tolist()
    right, bottom = np.minimum(group.origins_px.max(axis=0) + 2 * _WINDOW_PX, (width, height)).tolist()
    area = np.s_[top:bottom, left:right]
    cells = _in_cells(area)
    is_measured = np.zeros(pair.agreement.shape, bool)
    for x, y in (group.origins_px // _CELL_PX).tolist():
        is_measured[y : y + _WINDOW_PX // _CELL_PX, x : x + _WINDOW_PX // _CELL_PX] = True
    shift_px, moved = _refined(pair, group, area, (is_measured & pair.is_candidate)[cells])
    still, typical = pair.agreement[cells], pair.typical
    # Where the band shows what moved, the reference shows something else.
    is_strong = pair.is_candidate[cells] & (pair.agreement_at(shift_px)[cells] < _LOW * typical)
    is_strong &= (moved >= _AGREES * typical) & (moved - still >= _GAIN * typical)
    if np.count_nonzero(is_strong) < _MIN_CELLS or float(np.hypot(*shift_px)) < MIN_MOVED_PX:
        return
    _, labels = cv2.connectedComponents((moved > np.maximum(still, _GROWS * typical)).astype(np.uint8), connectivity=4)
    is_moved = np.isin(labels, np.unique(labels[is_strong]))
    yield from _outlined(is_moved, (left, top), shift_px, (width, height))


def _refined(
    pair: _Pair, group: _Windows, area: tuple[slice, slice], where: Mask
) -> tuple[NDArray[np.float64], FloatImage]:
    """Return the shift (x, y) with the highest mean agreement in a mask of the cells of an area, and the agreement."""
    x, y = np.median(group.shifts_px, axis=0).round().astype(int).tolist()
    known: dict[tuple[int, int], FloatImage] = {}
    steps = -1, 0, 1
    while True:  # few steps, from a shift measured at every second pixel
        is_at_end = max(abs(x), abs(y)) > _SEARCH_PX
        for shift in ((x + dx, y + dy) for dy in steps for dx in steps):
            if shift not in known:
                known[shift] = pair.under(shift, area)
        means = np.array([[known[x + dx, y + dy][where].mean() for dx in steps] for dy in steps], np.float64)
        if is_at_end or not means.max() > means[1, 1]:
            return np.array([x, y]) + paraboloid_peaks(means[None])[0], known[x, y]
        row, column = divmod(int(means.argmax()), 3)
        x, y = x + column - 1, y + row - 1


def _outlined(
    is_moved: Mask, origin_px: tuple[int, int], shift_px: NDArray[np.float64], size_px: tuple[int, int]
) -> Iterator[MovedArea]:
    """Yield the outlines of cells of the reference together with where the band shows them, in an image of `size_px`.

    A cell more on each side belongs to them: a box at an edge agrees with what has more texture, and pixels there are
    interpolated from both. What has no texture inside of an outline belongs to it.
    """
    wider = cv2.dilate(np.pad(is_moved, 1).astype(np.uint8), np.ones((3, 3), np.uint8))
    x, y = (first - _CELL_PX for first in origin_px)
    mask = np.kron(wider, np.ones((_CELL_PX, _CELL_PX), np.uint8))
    both = np.zeros(size_px[::-1], np.uint8)
    for dx, dy in np.rint([np.zeros(2), shift_px]).tolist():
        place = np.array([[1.0, 0.0, x + dx], [0.0, 1.0, y + dy]])
        both |= cv2.warpAffine(mask, place, size_px, flags=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(both, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    for outline in outlines:
        yield MovedArea(outline[:, 0].astype(np.float64), (float(shift_px[0]), float(shift_px[1])))


def _planes(field: Field) -> FloatImage:
    """Return the real and the imaginary part of a field (height, width), (height, width, 2)."""
    return np.ascontiguousarray(field).view(np.float32).reshape(*field.shape, 2)


def _cells(image: FloatImage) -> FloatImage:
    """Return the mean in each cell of an image (height, width) or (height, width, 2)."""
    height, width = image.shape[:2]
    size = width // _CELL_PX, height // _CELL_PX
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _product(one: FloatImage, other: FloatImage) -> FloatImage:
    """Return the mean of Re(conj(z) w) in each cell, (rows, columns), of two fields (height, width, 2)."""
    products = _cells(cv2.multiply(one, other))
    return np.asarray(products[..., 0] + products[..., 1], np.float32)  # faster than sum(axis=2)


def _box(cells: FloatImage) -> FloatImage:
    """Return the mean of the box around each cell."""
    return np.asarray(cv2.blur(cells, (_BOX_CELLS, _BOX_CELLS), borderType=cv2.BORDER_REFLECT), np.float32)


def _relative(product: FloatImage, energy: FloatImage | np.float32, other_energy: FloatImage) -> FloatImage:
    """Return a product relative to the energies: 1 for equal fields; less without texture."""
    return np.asarray(product / np.sqrt(np.maximum(energy * other_energy, np.float32(_MIN_ENERGY**2))), np.float32)


def _half(planes: FloatImage) -> FloatImage:
    """Return a field (height, width, 2) at half the resolution."""
    height, width = planes.shape[:2]
    return np.asarray(cv2.resize(planes, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)


def _squares(planes: FloatImage) -> FloatImage:
    """Return |z|^2 (height, width) of a field (height, width, 2)."""
    squares = cv2.multiply(planes, planes)
    return np.asarray(squares[..., 0] + squares[..., 1], np.float32)  # faster than sum(axis=2)


def _in_cells(area: tuple[slice, slice]) -> tuple[slice, slice]:
    """Return an area in px as one in cells."""
    rows, columns = (slice(s.start // _CELL_PX, s.stop // _CELL_PX) for s in area)
    return rows, columns
