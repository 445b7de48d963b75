"""Areas of a band that contradict its mapping: what they show moved between the exposures, or is near the camera."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray  # the former in quotes: help() prints its name, not 1,000 characters
from pydantic import dataclasses as validated

from agalign.values.fields import RECORD, Array, Number, equal
from agalign.values.image import FloatImage, Mask
from agalign.values.pixel_units import PixelScale

_OUTLINE_DECIMALS, _SHIFT_DECIMALS = 1, 3
_MAX_MASK_SIDE = 4096
"""Of the mask of an area, which is coarser in a large mosaic: it is found in images of at most 2700 px."""


@validated.dataclass(frozen=True, config=RECORD)
class MovedArea:
    """An area in which band and reference agree under another shift, and contradict the mapping.

    It covers what moved both where the reference and where the band shows it.

    Examples
    --------
    >>> area = agalign.MovedArea(np.array([[10.0, 10.0], [49.0, 10.0], [49.0, 29.0], [10.0, 29.0]]), (3.0, 4.0))
    >>> area.length_px, area.centre_px.tolist(), area.contains([20, 60], [20, 20]).tolist()
    (5.0, [29.5, 19.5], [True, False])
    """

    __eq__ = equal

    outline_px: Annotated[NDArray[np.float64], Array((None, 2), _OUTLINE_DECIMALS)]
    """Corners of a polygon, raw px of the reference; the pixels on its edges belong to it."""
    shift_px: tuple[Number, Number]
    """(x, y) position in the band minus that in the reference, px of the reference, under the mapping."""

    def __post_init__(self) -> None:
        """Raise ValueError for an outline without corners."""
        if not len(self.outline_px):
            raise ValueError("its outline has no corners")

    @property
    def length_px(self) -> float:
        """Length of the shift: the error of the mapping in the area, px of the reference."""
        return math.hypot(*self.shift_px)

    @property
    def centre_px(self) -> NDArray[np.float64]:
        """(2,) mean of the corners, px of the reference."""
        return np.asarray(self.outline_px.mean(axis=0))

    def rescaled(self, scale: PixelScale) -> "MovedArea":
        """Return the same on a reference that is resized by `scale`, with the decimals of a sidecar: a mapping that is
        read from it flags the same pixels.
        """
        shift_x, shift_y = scale.displacements(self.shift_px).round(_SHIFT_DECIMALS).tolist()
        return replace(
            self, outline_px=scale.positions(self.outline_px).round(_OUTLINE_DECIMALS), shift_px=(shift_x, shift_y)
        )

    def contains(self, x_px: "ArrayLike", y_px: "ArrayLike") -> Mask:
        """Return True for positions in the area.

        Parameters
        ----------
        x_px
            Columns, raw px of the reference.
        y_px
            Rows, of a shape that can be broadcast with that of `x_px`.

        Returns
        -------
        array
            bool, of the broadcast shape.

        Examples
        --------
        >>> area = agalign.MovedArea(np.array([[10.0, 10.0], [49.0, 10.0], [49.0, 29.0], [10.0, 29.0]]), (3.0, 4.0))
        >>> inside = area.contains(np.arange(60), np.arange(40)[:, None])
        >>> inside.shape, int(inside.sum())
        ((40, 60), 800)
        """
        first_px, step_px, inside = self._inside
        height, width = inside.shape
        at_px = zip((x_px, y_px), first_px, strict=True)
        column, row = (np.rint((np.asarray(v) - first) / step_px).astype(np.int64) for v, first in at_px)
        is_near = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return np.asarray(is_near & inside[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])

    @cached_property
    def _inside(self) -> tuple[NDArray[np.float64], float, Mask]:
        """The first pixel (x, y) of the bounding box, the pixels per column of its mask, and the mask."""
        first_px = np.rint(self.outline_px.min(axis=0))
        step_px = max(1.0, float((self.outline_px.max(axis=0) - first_px).max()) / _MAX_MASK_SIDE)
        corners = np.rint((self.outline_px - first_px) / step_px).astype(np.int32)
        mask = np.zeros((corners.max(axis=0) + 1)[::-1], np.uint8)
        cv2.fillPoly(mask, [corners], 1)
        return first_px, step_px, mask > 0


def moved_px(areas: Sequence[MovedArea], x_px: ArrayLike, y_px: ArrayLike) -> FloatImage:
    """Return the length of the shift of the areas at positions, raw px of the reference, 0 outside them.

    `x_px` and `y_px` have shapes that can be broadcast to each other; where areas overlap, the longest shift counts.
    """
    result = np.zeros(np.broadcast_shapes(np.shape(x_px), np.shape(y_px)), np.float32)
    for area in areas:
        result[area.contains(x_px, y_px) & (result < area.length_px)] = area.length_px
    return result
