"""The relief of a capture: one parallax for each pixel, which displaces all bands along their baselines.

Plane + parallax (Irani & Anandan 1996; Hartley & Zisserman 2004, Sec. 13.2): an undistorted pixel x of the reference
maps to

    H_b (x + t_b z(x))

in band b. H_b is the homography that the reference plane induces. The parallax z is one number for each pixel, and the
same in all bands: it is proportional to 1 / range minus that of the plane. t_b is the baseline of the band's lens, as a
displacement in the reference.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from agalign.values.image import FloatImage, Mask
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size

RELIEF_STEP = 0.01
"""Step of the parallax, its standard error (px) and the confidence in files: below their errors."""


@dataclass(frozen=True)
class Relief:
    """Parallax relative to the reference plane, at every raw pixel of the reference."""

    parallax_px: FloatImage
    """(height, width) z: px along a baseline of length 1; positive where the scene is nearer than the plane."""
    confidence: FloatImage
    """(height, width) mean correlation, 0 to 1, of the bands' structure with that of the reference at this parallax."""
    scale: PixelScale = SAME_PIXELS
    """Size of this raster relative to the image on which the relief is evaluated."""
    unit: float = 1.0
    """Px of the image on which the relief is evaluated for a px of `parallax_px`."""
    std_px: FloatImage | None = None
    """(height, width) standard error of `parallax_px`, in its unit; None if it is not known."""

    def __call__(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Parallax (...) at points (..., 2), px of the image on which it is evaluated.

        Outside the raster that of its edge.
        """
        points = self.scale.positions(points_px)
        rows_columns = points.reshape(-1, 2)[:, ::-1].T
        values = map_coordinates(self.parallax_px, rows_columns, order=1, mode="nearest")
        return np.asarray(values * self.unit, np.float64).reshape(points.shape[:-1])

    def at_crossings(self, x_px: NDArray[np.float64], y_px: NDArray[np.float64]) -> FloatImage:
        """Parallax (m, n) at all crossings of columns x (n,) and rows y (m,), faster than at points."""
        if self.scale == SAME_PIXELS and self._are_pixels(x_px, 1) and self._are_pixels(y_px, 0):
            values = self.parallax_px[int(y_px[0]) : int(y_px[-1]) + 1, int(x_px[0]) : int(x_px[-1]) + 1]
        else:
            (x, _), (_, y) = (self.scale.positions(np.column_stack([v, v])).astype(np.float32).T for v in (x_px, y_px))
            at_x, at_y = np.meshgrid(x, y)
            values = np.asarray(
                cv2.remap(self.parallax_px, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
            )
        return values if self.unit == 1.0 else np.asarray(values * np.float32(self.unit))

    def _are_pixels(self, positions_px: NDArray[np.float64], axis: int) -> bool:
        """True for consecutive pixels of the raster along an axis."""
        first, last = positions_px[0], positions_px[-1]
        inside = first >= 0 and last < self.parallax_px.shape[axis]
        return bool(inside and first == int(first) and last - first == len(positions_px) - 1)

    @property
    def rms_px(self) -> float:
        """Root mean square of the parallax, px of the image on which it is evaluated."""
        return float(np.sqrt(np.mean(np.square(self.parallax_px)))) * self.unit

    @property
    def negated(self) -> "Relief":
        """The relief with the opposite sign."""
        return replace(self, parallax_px=-self.parallax_px)

    def on_pixels(self, size_px: Size) -> "Relief":
        """The same at the pixels of the image on which it is evaluated, of (width, height), as it is written."""
        x_px, y_px = (np.arange(n, dtype=np.float64) for n in size_px)

        def written(layer: FloatImage, unit: float) -> FloatImage:
            return rounded(replace(self, parallax_px=layer, unit=unit).at_crossings(x_px, y_px))

        std_px = None if self.std_px is None else written(self.std_px, self.unit)
        return Relief(written(self.parallax_px, self.unit), written(self.confidence, 1.0), std_px=std_px)

    def rescaled(self, scale: PixelScale) -> "Relief":
        """The same on an image that is resized by `scale`."""
        return replace(self, scale=self.scale.over(scale), unit=self.unit * scale.mean)


@dataclass(frozen=True)
class Parallax:
    """The relief as it displaces one band."""

    relief: Relief
    baseline: tuple[float, float]
    """t_b (x, y): displacement in undistorted px of the reference for a parallax of 1 px."""
    hidden: Mask | None = None
    """On the raster of the relief: pixels that nearer parts of the scene occlude in this band. None hides nothing."""

    def with_occlusions(self) -> "Parallax":
        """The same with the pixels hidden where a nearer one, of larger parallax, is displaced to the same position.

        Surfaces that are displaced by less than `min_width_px` relative to each other do not hide one another. Gaps
        between hidden pixels are closed, and then areas smaller than `min_area_px` are not hidden. These are px of the
        raster: on a larger one, smaller parts of the scene are hidden.
        """
        min_width_px = 1.5  # smaller differences of parallax are slopes of one surface, or noise
        min_area_px = 16  # smaller areas are single pixels with wrong parallax
        z_px, (t_x, t_y) = self.relief.parallax_px, np.multiply(self.baseline, self.relief.scale) * self.relief.unit
        min_step_px = min_width_px / max(math.hypot(t_x, t_y), 1e-9)
        parallax_px = z_px - z_px.min()
        height, width = parallax_px.shape
        x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        moved_x, moved_y = (np.rint(at + np.float32(t) * z_px).astype(np.int32) for at, t in ((x, t_x), (y, t_y)))
        inside = (moved_x >= 0) & (moved_x < width) & (moved_y >= 0) & (moved_y < height)
        cell = np.where(inside, moved_y * np.int32(width) + moved_x, np.int32(height * width))
        nearest = np.zeros(height * width + 1, np.float32)
        # The bits of floats that are not negative have their order, and `maximum.at` is much faster for integers.
        np.maximum.at(nearest.view(np.int32), cell.ravel(), parallax_px.ravel().view(np.int32))
        nearest[-1] = 0  # Pixels outside share the last cell, which is ignored.
        hidden = nearest.take(cell) > parallax_px + np.float32(min_step_px)
        # Closing fills the gaps between the pixels of a magnified nearer surface.
        closed = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        _, labels, statistics, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
        is_large = statistics[:, cv2.CC_STAT_AREA] >= min_area_px
        is_large[0] = False  # the background
        return replace(self, hidden=np.asarray(is_large[labels]))

    def hides(self, x_px: NDArray[np.float64], y_px: NDArray[np.float64]) -> Mask:
        """True where raw points of the reference are occluded in the band.

        x and y are broadcast to one shape, such as (height, width).
        """
        if self.hidden is None:
            return np.zeros(np.broadcast_shapes(x_px.shape, y_px.shape), dtype=bool)
        (x, _), (_, y) = (
            np.moveaxis(np.rint(self.relief.scale.positions(np.stack([v, v], axis=-1))), -1, 0).astype(np.intp)
            for v in (x_px, y_px)
        )
        height, width = self.hidden.shape
        return np.asarray(self.hidden[y.clip(0, height - 1), x.clip(0, width - 1)])

    def rescaled(self, scale: PixelScale) -> "Parallax":
        """The same on a reference that is resized by `scale`."""
        baseline = (self.baseline[0] * scale.x / scale.mean, self.baseline[1] * scale.y / scale.mean)
        return replace(self, relief=self.relief.rescaled(scale), baseline=baseline)

    def variance_px2(self, points_px: ArrayLike, baseline_std: float = 0.0) -> NDArray[np.float64]:
        """Variance (...) of the displacement at raw points (..., 2): by the error of the relief, 0 if unknown, and by
        that of the baseline, in its unit.
        """
        relief, variance = self.relief, np.zeros(np.shape(points_px)[:-1])
        if relief.std_px is not None:
            std_px = replace(relief, parallax_px=relief.std_px)(points_px)
            variance = np.asarray((std_px * np.hypot(*self.baseline)) ** 2)
        return variance + np.square(baseline_std * relief(points_px)) if baseline_std else variance

    def variance_at_crossings(
        self, x_px: NDArray[np.float64], y_px: NDArray[np.float64], baseline_std: float = 0.0
    ) -> FloatImage:
        """Return the same (m, n) at all crossings of columns x (n,) and rows y (m,), faster than at points."""
        relief, variance = self.relief, np.zeros((len(y_px), len(x_px)), np.float32)
        if relief.std_px is not None:
            std_px = replace(relief, parallax_px=relief.std_px).at_crossings(x_px, y_px)
            variance = np.asarray(np.square(std_px * np.float32(np.hypot(*self.baseline))))
        if baseline_std:
            variance = variance + np.square(np.float32(baseline_std) * relief.at_crossings(x_px, y_px))
        return variance

    def displacements(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """t_b z (..., 2) at raw points (..., 2), undistorted px."""
        return np.asarray(self.relief(points_px)[..., None] * np.array(self.baseline))


def rounded(values: NDArray[np.floating]) -> FloatImage:
    """Return values (height, width) of a relief as they are written: multiples of RELIEF_STEP, which compress."""
    return np.asarray(np.round(values / np.float64(RELIEF_STEP)) * RELIEF_STEP, np.float32)
