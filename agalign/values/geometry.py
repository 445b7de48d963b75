"""Homographies on pixel coordinates.

Every matrix is a 3x3 float64 array that maps homogeneous column vectors (x, y, 1): x right, y down, and
(0, 0) is the CENTRE of the top-left pixel (OpenCV's convention). Names state the direction: `fixed_to_moving`
maps a pixel of the fixed (reference) image to a pixel of the moving image.
"""

from dataclasses import dataclass
from reprlib import repr as shortened_repr

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import GeometryError
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size

Matrix = NDArray[np.float64]
"""(3, 3) homography."""
Points = NDArray[np.float64]
"""(..., 2) positions (x, y), px unless stated otherwise."""


def identity() -> Matrix:
    """The 3x3 identity homography."""
    return np.eye(3)


def translation(dx_px: float, dy_px: float) -> Matrix:
    """The homography that adds (dx_px, dy_px) to a pixel position."""
    matrix = np.eye(3)
    matrix[:2, 2] = dx_px, dy_px
    return matrix


def normalised(matrix: ArrayLike) -> Matrix:
    """The same homography with its bottom-right element equal to 1.

    Raises GeometryError where the matrix is not 3x3, not finite, singular, or sends the origin to infinity.
    """
    try:
        h = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise GeometryError(f"a homography is a finite 3x3 matrix, not {shortened_repr(matrix)}") from None
    if h.shape != (3, 3) or not np.isfinite(h).all():
        text = shortened_repr(h.tolist())
        raise GeometryError(f"a homography is a finite 3x3 matrix, not one of shape {h.shape}: {text}")
    if _is_singular(h) or abs(h[2, 2]) < 1e-12 * np.abs(h[2]).max():
        raise GeometryError(f"the homography is singular: {h.tolist()}")
    return np.asarray(h / h[2, 2])


def _is_singular(h: Matrix) -> bool:
    """True for a singular matrix; rows and columns are normalised first, so that units of pixels do not matter."""
    for axis in (0, 1, 0, 1):
        lengths = np.linalg.norm(h, axis=axis, keepdims=True)
        if not lengths.all():
            return True
        h = h / lengths
    return bool(abs(np.linalg.det(h)) < 1e-12)


def apply(matrix: Matrix, points_px: ArrayLike) -> Points:
    """Map points of shape (..., 2) in pixels through a homography; points on its horizon become inf or nan."""
    xy = np.asarray(points_px, dtype=np.float64)
    mapped = xy @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[..., :2] / mapped[..., 2:])


def compose(*matrices: Matrix) -> Matrix:
    """The homography that applies the LAST argument first, as the matrix product does."""
    product = np.eye(3)
    for matrix in matrices:
        product = product @ matrix
    return normalised(product)


def invert(matrix: Matrix) -> Matrix:
    """The inverse homography. Raises GeometryError where it is singular."""
    return normalised(np.linalg.inv(normalised(matrix)))


def rescale(fixed_to_moving: Matrix, fixed_scale: PixelScale, moving_scale: PixelScale) -> Matrix:
    """The same mapping between images that are resized by `fixed_scale` and `moving_scale`."""
    return compose(moving_scale.matrix, fixed_to_moving, invert(fixed_scale.matrix))


def overlay(fixed_size_px: Size, moving_size_px: Size) -> Matrix:
    """fixed_to_moving that maps the outline of one image (width, height) onto the other's: identity for equal sizes."""
    return PixelScale.between(fixed_size_px, moving_size_px).matrix


def corners(width_px: int, height_px: int) -> Points:
    """Centres of the four corner pixels, (4, 2), clockwise from the top left."""
    right, bottom = width_px - 1.0, height_px - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])


def lattice(width_px: int, height_px: int, columns: int, rows: int) -> Points:
    """A regular lattice over an image, (rows * columns, 2), row by row, corner pixels included."""
    x, y = np.meshgrid(np.linspace(0, width_px - 1, columns), np.linspace(0, height_px - 1, rows))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def fit_homography(points_px: ArrayLike, mapped_px: ArrayLike) -> Matrix:
    """The homography that maps points (n, 2) to mapped points (n, 2) with the least squared error.

    Raises GeometryError where there is none: fewer than four points, points on one line, or values that are not finite.
    """
    points, mapped = (np.asarray(p, dtype=np.float64) for p in (points_px, mapped_px))
    enough = len(points) >= 4 and bool(np.isfinite(points).all() and np.isfinite(mapped).all())
    result = cv2.findHomography(points, mapped, 0)[0] if enough else None
    if result is None:
        raise GeometryError(f"no homography can be fitted to {len(points)} pairs of points that are degenerate")
    return normalised(result)


def corner_error_px(one: Matrix, other: Matrix, width_px: int, height_px: int) -> float:
    """Largest distance in px between the images of the four corners under two homographies."""
    points = corners(width_px, height_px)
    distance = np.linalg.norm(apply(one, points) - apply(other, points), axis=1)
    return float(np.nan_to_num(distance, nan=np.inf).max())


def local_scale(matrix: Matrix, width_px: int, height_px: int) -> Points:
    """Square root of the mapping's area change at the corners and the centre, (5,); negative where it folds.

    The determinant of the Jacobian of a homography H at p is det(H) / (h31 x + h32 y + h33)^3.
    """
    points = np.vstack([corners(width_px, height_px), [[(width_px - 1) / 2, (height_px - 1) / 2]]])
    denominator = points @ matrix[2, :2] + matrix[2, 2]
    with np.errstate(divide="ignore"):
        area = np.linalg.det(matrix) / denominator**3
    return np.asarray(np.sign(area) * np.sqrt(np.abs(area)))


def magnification(matrix: Matrix, width_px: int, height_px: int) -> float:
    """Pixels of the moving image per pixel of the reference (width, height) at its centre."""
    return abs(float(local_scale(matrix, width_px, height_px)[-1]))


def over_corners(points_px: ArrayLike, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Return the Jacobian (n, 2, 8) of points (n, 2) over the displacements of the image's corners, for a homography
    close to the identity: (dx, dy) of each corner, clockwise from the top left (DeTone et al. 2016, Sec. 3).
    """
    of_corners = _over_elements(corners(width_px, height_px), width_px, height_px).reshape(8, 8)
    return np.asarray(_over_elements(np.asarray(points_px), width_px, height_px) @ np.linalg.inv(of_corners))


def moving_corners(displacements_px: ArrayLike, width_px: int, height_px: int) -> Matrix:
    """Return the homography that displaces an image's corners by (8,) px, in the order of `over_corners`.

    OpenCV rounds their positions to 32 bits, 3e-5 px for 1,000 px. Raises GeometryError.
    """
    points = corners(width_px, height_px)
    return fit_homography(points, points + np.reshape(displacements_px, (4, 2)))


def _over_elements(points_px: Points, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Return the Jacobian (n, 2, 8) of points over the first eight elements of a homography of normalised positions."""
    u, v = points_px[:, 0] / width_px, points_px[:, 1] / height_px
    zero, one = np.zeros_like(u), np.ones_like(u)
    along_x = np.stack([u, v, one, zero, zero, zero, -u * u, -u * v], axis=1) * width_px
    along_y = np.stack([zero, zero, zero, u, v, one, -u * v, -v * v], axis=1) * height_px
    return np.stack([along_x, along_y], axis=1)


@dataclass(frozen=True)
class PairScales:
    """The sizes of the two images of a band pair, each relative to its file."""

    fixed: PixelScale = SAME_PIXELS
    moving: PixelScale = SAME_PIXELS

    @classmethod
    def of(cls, files_px: tuple[Size, Size], images_px: tuple[Size, Size]) -> "PairScales":
        """The scales for the sizes (width, height) of the two files and of their images."""
        return cls(*map(PixelScale.between, files_px, images_px))

    def between_files(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the images as one between their files."""
        return rescale(fixed_to_moving, self.fixed.inverse, self.moving.inverse)

    def between_images(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the files as one between the images."""
        return rescale(fixed_to_moving, self.fixed, self.moving)


SAME_SCALES = PairScales()
"""Both images have the pixels of their files."""
