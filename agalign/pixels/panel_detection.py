"""Detection of a calibration panel: a homogeneous bright square, and the QR code printed next to it."""

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.values.image import FloatImage, Mask, Raster

_AREA_RATIO = 0.5
"""Side of the measured area, relative to that of the panel."""

Corners = NDArray[np.float64]
"""(4, 2) px, in order around the quadrilateral."""


# What distinguishes a panel from other bright squares.
_CORNER_TOLERANCE = 0.04
"""Maximum distance of a contour from a quadrilateral, relative to the length of the contour."""
_SIDE_RATIO = 1.4
"""Maximum ratio of the longest and the shortest side."""
_TAPER = 1.15
"""Maximum ratio of opposite sides."""
_RELATIVE_STD = 0.06
"""Maximum standard deviation within the measured area, relative to its mean."""
_LIT_TOLERANCE = 0.2
"""Maximum difference of an evenly lit pixel from the median of the panel, relative. If one is brighter, the median
may be in the shadow.
"""
_LIT_SHARE = 0.6
"""Minimum share of evenly lit pixels: of two halves, it is not known which one is in the light."""
_CONTRAST = 1.5
"""Minimum ratio of the brightness of a panel and its surroundings."""
_RING_RATIOS = (1.15, 1.4)
"""Inner and outer side of the surrounding ring used for comparison, relative to that of the panel."""
_CODE_AREA_RATIOS = (0.3, 6.0)
"""Minimum and maximum area of the panel, relative to that of its code."""
_CODE_DISTANCE = 3.0
"""Maximum distance between the centres of panel and code, in sides of the code."""
_TARGET_RATIO = 0.5
"""Minimum area of another square of a target, relative to the largest."""
_TARGET_CONTRAST = 1.2
"""Minimum ratio of the brightness of two squares of a target: evenly lit pixels of one panel differ by less."""
_IMAGE_SHARES = (0.004, 0.3)
"""Minimum and maximum area of a panel without a code, relative to the image."""
_AIMED_SHARE = 0.02
"""Minimum share of the image that a panel covers from 1 m above; 0.03 on a RedEdge-M."""
_OFF_CENTRE = 1 / 6
"""A camera that is aimed at a panel has its centre in the middle third of the image."""


@dataclass(frozen=True)
class DetectedPanel:
    """A panel that was detected in an image."""

    code: str
    """Text of its QR code; empty without one."""
    area_px: tuple[tuple[float, float], ...]
    """(x, y) of the corners of the area to measure, inside the panel; empty if only the code was detected."""
    in_scene: bool = False
    """The panel is small and far from the image centre: the camera was aimed at something else."""
    is_ambiguous: bool = False
    """Several squares of different brightness may be the panel, as of a target with several reflectances."""


def find_panel(image: Raster, *, without_code: bool = False) -> DetectedPanel | None:
    """Detect the panel in a band (height, width), of up to 1600 px a side; None without one.

    Roofs and sheets are homogeneous squares too, so panels without a code are detected only `without_code`.
    """
    stretched = _stretched(image)
    code, code_corners = _code(stretched)
    if not code and not without_code:
        return None
    smooth = np.asarray(cv2.GaussianBlur(stretched, (0, 0), 2.0), np.uint8)  # dark panels are noisy
    squares = _squares(smooth, code_corners)
    largest = next((s for s in squares if _is_panel(smooth, s)), None)
    if largest is None:
        return None if code_corners is None else DetectedPanel(code, (), _is_in_scene(code_corners, smooth))
    others = [s for s in squares if code_corners is None and _is_of_one_target(smooth, largest, s)]
    if any(_is_panel(smooth, other) for other in others):
        return DetectedPanel("", (), _is_in_scene(largest, smooth), is_ambiguous=True)
    area = tuple((x, y) for x, y in _scaled(largest).tolist())
    return DetectedPanel(code, area, _is_in_scene(largest, smooth))


def _is_in_scene(square: Corners, image: NDArray[np.uint8]) -> bool:
    """Return True if a panel or its code is small and outside the middle third of the image."""
    size = np.array(image.shape[::-1], np.float64)
    off_centre = np.abs((square.mean(axis=0) - (size - 1) / 2) / size).max()
    return bool(off_centre > _OFF_CENTRE and _area(square) < _AIMED_SHARE * image.size)


def _squares(image: NDArray[np.uint8], code: Corners | None) -> list[Corners]:
    """Return the squares of the size of a panel, the largest first, next to the code if there is one."""
    limits = _IMAGE_SHARES if code is None else tuple(share * _area(code) / image.size for share in _CODE_AREA_RATIOS)
    squares = _quadrilaterals(image, limits[0] * image.size, limits[1] * image.size)
    return sorted((s for s in squares if code is None or _is_next_to(s, code)), key=_area, reverse=True)


def _is_of_one_target(image: NDArray[np.uint8], largest: Corners, other: Corners) -> bool:
    """Return True for another square of similar size and different brightness beside the largest."""
    centres = np.array([largest.mean(axis=0), other.mean(axis=0)])
    dark, bright = sorted(float(image[y, x]) for x, y in np.rint(centres).astype(int))
    is_beside = np.linalg.norm(centres[1] - centres[0]) > _area(largest) ** 0.5
    return bool(is_beside and _area(other) > _TARGET_RATIO * _area(largest) and bright > _TARGET_CONTRAST * dark)


def albedo_of(code: str, wavelength_nm: float | None) -> float | None:
    """Return the reflectance, 0 to 1, that the code of a panel contains for a wavelength.

    RP04-…_04005111000507 is 51.1 % at 400 nm and 50.7 % at 1000 nm; it is interpolated linearly, as by the firmware of
    the cameras. None without a reflectance, without a wavelength or outside of the range.
    """
    match = re.search(r"_(\d{4})(\d{3})(\d{4})(\d{3})$", code)
    if match is None or wavelength_nm is None:
        return None
    first_nm, first, last_nm, last = (float(n) for n in match.groups())
    if not first_nm <= wavelength_nm <= last_nm or last_nm == first_nm:
        return None
    return (first + (last - first) * (wavelength_nm - first_nm) / (last_nm - first_nm)) / 1000


def inside(corners_px: ArrayLike, shape: tuple[int, int]) -> Mask:
    """Return (height, width) True inside the polygon with corners (n, 2)."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.round(np.asarray(corners_px)).astype(np.int32)], 1)
    return mask.astype(bool)


def _stretched(image: Raster) -> NDArray[np.uint8]:
    """Return the image in 8 bits."""
    low, high = np.percentile(image.pixels, (1.0, 99.5))
    stretched = (image.pixels - low) * (255.0 / max(float(high - low), 1e-9))
    return np.asarray(np.clip(np.rint(stretched), 0, 255), np.uint8)


def _code(image: NDArray[np.uint8]) -> tuple[str, Corners | None]:
    """Return the text and the corners of a QR code; codes that cannot be decoded are ignored."""
    if _is_noise(image):
        return "", None
    try:
        text, corners, _ = cv2.QRCodeDetector().detectAndDecode(image)
    except cv2.error:  # division by zero inside OpenCV for some false detections
        return "", None
    return (text, np.asarray(corners, np.float64).reshape(4, 2)) if text else ("", None)


def _is_noise(image: NDArray[np.uint8]) -> bool:
    """Return True if a code is not readable, as OpenCV sees the image: thresholded locally at 512 px.

    OpenCV would try to decode parts of the noise for seconds.
    """
    ratio = min(1.0, 512 / min(image.shape))
    reduced = cv2.resize(image, None, fx=ratio, fy=ratio)
    dark = cv2.adaptiveThreshold(reduced, 1, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY, 83, 2)
    # Maximum share of pixels at an edge in an image that is searched for a code: 0.48 in the sky, up to 0.36 in
    # captures of fields, water and panels.
    max_edge_share = 0.4
    return bool(np.count_nonzero(dark[:, 1:] != dark[:, :-1]) > max_edge_share * dark.size)


def _quadrilaterals(image: NDArray[np.uint8], min_area: float, max_area: float) -> list[Corners]:
    """Return the convex, nearly square contours at up to twelve thresholds, with areas within the limits."""
    result = []
    low, high = np.percentile(image, (5.0, 99.5)).tolist()
    for level in np.unique(np.linspace(low, high, 14)[1:-1].astype(int)):
        contours, _ = cv2.findContours((image > level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        for contour in (c for c in contours if min_area <= cv2.contourArea(c) <= max_area):
            tolerance_px = _CORNER_TOLERANCE * cv2.arcLength(contour, closed=True)
            polygon = cv2.approxPolyDP(contour, tolerance_px, closed=True).reshape(-1, 2)
            if len(polygon) == 4 and cv2.isContourConvex(polygon):
                sides = np.linalg.norm(polygon - np.roll(polygon, 1, axis=0), axis=1)
                longer, shorter = np.maximum(sides[:2], sides[2:]), np.minimum(sides[:2], sides[2:])
                if sides.max() <= _SIDE_RATIO * sides.min() and (longer <= _TAPER * shorter).all():
                    result.append(polygon.astype(np.float64))
    return result


def _is_panel(image: NDArray[np.uint8], square: Corners) -> bool:
    """Return True if a square is homogeneous and brighter than the ring around it."""
    ratios = _AREA_RATIO, *_RING_RATIOS
    around = _scaled(square, ratios[-1])
    # Even, so that halves of pixels are rounded as in the whole image.
    first = 2 * np.floor(around.min(axis=0).clip(0) / 2).astype(int)
    last = np.ceil(around.max(axis=0)).astype(int) + 1
    image, square = image[first[1] : last[1], first[0] : last[0]], square - first
    inner, edge, outer = (inside(_scaled(square, ratio), image.shape) for ratio in ratios)
    area, ring = image[inner].astype(np.float64), image[outer & ~edge]
    if not len(area) or not len(ring):
        return False
    return bool(area.mean() >= _CONTRAST * np.median(ring)) and is_homogeneous(area)


def is_homogeneous(values: NDArray[np.floating[Any]]) -> bool:
    """Return True if pixels (n,) vary as little as those of a panel."""
    return len(values) > 0 and bool(values.std() <= _RELATIVE_STD * values.mean())


def evenly_lit(image: FloatImage, within: Mask) -> Mask:
    """Return the pixels (height, width) of a panel without those in a shadow; none if they vary for another reason.

    `within` is True in the panel. Noise is averaged, which does not change the mean.
    """
    smooth = cv2.blur(image, (5, 5)).astype(np.float64)
    ratios = smooth / np.median(smooth[within])
    lit = within & (np.abs(ratios - 1) <= _LIT_TOLERANCE)
    is_bright = ratios[within].max(initial=0) > 1 + _LIT_TOLERANCE
    is_most = np.count_nonzero(lit) >= _LIT_SHARE * np.count_nonzero(within)
    return lit if is_most and not is_bright and is_homogeneous(smooth[lit]) else np.zeros_like(within)


def _is_next_to(square: Corners, code: Corners) -> bool:
    side, distance = _area(code) ** 0.5, float(np.linalg.norm(square.mean(axis=0) - code.mean(axis=0)))
    return bool(side <= distance <= _CODE_DISTANCE * side)


def _area(corners: Corners) -> float:
    return float(cv2.contourArea(corners.astype(np.float32)))


def _scaled(square: Corners, factor: float = _AREA_RATIO) -> Corners:
    centre = square.mean(axis=0)
    return np.asarray(centre + factor * (square - centre))
