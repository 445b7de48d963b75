"""A calibration panel by its look: a homogeneous bright square, and the QR code printed next to it."""

import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.values.image import FloatImage, Mask, Raster
from agalign.values.pixel_units import PixelScale

_LONGEST_PX = 1600
_SHOWN_PERCENTILES = 1.0, 99.5
_SMOOTHING_PX = 2.0
_LEVELS = 12
"""Brightnesses at which outlines are looked for,"""
_LEVEL_PERCENTILES = 5.0, 99.5
"""between these of the image."""
_CORNER_TOLERANCE = 0.04
"""Distance from a quadrilateral at which a contour counts as one, as a share of its length."""
_INNER = 0.5
"""Side of the measured area, relative to that of the panel."""
_RING = 1.15, 1.4
"""Inner and outer side of the ring around it for comparison, relative to that of the panel."""
_CODE_AREAS = 0.3, 6.0
"""Area of the panel, relative to that of its code."""
_CODE_REACH = 3.0
"""Maximum distance between their centres, in sides of the code."""
_SHARE_OF_IMAGE = 0.004, 0.3
"""Of a panel without a code."""
_MIN_FILLED = 0.02
"""Share of the image that a panel fills from a metre above it: 0.03 on a RedEdge-M."""
_MAX_OFF_CENTRE = 1 / 6
"""Of a panel that the camera is aimed at: its centre is in the middle third of the image."""
_MAX_SPREAD = 0.06
"""Standard deviation within the area, relative to its mean."""
_MIN_CONTRAST = 1.5
"""How much brighter it is than its surroundings."""
_MAX_SLANT, _MAX_TAPER = 1.4, 1.15
"""Longest side over shortest, and either side over the one across."""
_ALBEDO_IN_CODE = re.compile(r"_(\d{4})(\d{3})(\d{4})(\d{3})$")

Corners = NDArray[np.float64]
"""(4, 2) px, one after another around."""


@dataclass(frozen=True)
class DetectedPanel:
    """What was seen of a panel."""

    code: str
    """What its QR code says; empty where there is none."""
    area_px: tuple[tuple[float, float], ...]
    """(x, y) of the corners of an area well within it; none where only the code was found."""
    in_scene: bool = False
    """The panel is small and away from the middle: the camera was aimed at something else."""


def find_panel(image: Raster, *, without_code: bool = False) -> DetectedPanel | None:
    """The panel in a band; None where there is none.

    Roofs and sheets are homogeneous squares too: one without a code counts only `without_code`.
    """
    shown, scale = _shown(image)
    code, at = _code(shown)
    if not code and not without_code:
        return None
    shown = np.asarray(cv2.GaussianBlur(shown, (0, 0), _SMOOTHING_PX), np.uint8)  # a dark panel's noise is no structure
    largest = _largest_panel(shown, at)
    if largest is None:
        return None if at is None else DetectedPanel(code, (), _is_in_scene(at, shown))
    area = PixelScale(scale, scale).inverse.positions(_shrunk(largest))
    return DetectedPanel(code, tuple((float(x), float(y)) for x, y in area), _is_in_scene(largest, shown))


def _is_in_scene(square: Corners, shown: NDArray[np.uint8]) -> bool:
    """True where a panel, or its code, is small and its centre outside the middle of the image."""
    size = np.array(shown.shape[::-1], np.float64)
    off_centre = np.abs((square.mean(axis=0) - (size - 1) / 2) / size).max()
    return bool(off_centre > _MAX_OFF_CENTRE and _area(square) < _MIN_FILLED * shown.size)


def _largest_panel(shown: NDArray[np.uint8], code: Corners | None) -> Corners | None:
    """The largest square that looks like a panel, near the code where there is one; None where there is none."""
    limits = _SHARE_OF_IMAGE if code is None else tuple(share * _area(code) / shown.size for share in _CODE_AREAS)
    squares = _outlines(shown, limits[0] * shown.size, limits[1] * shown.size)
    squares = [s for s in squares if (code is None or _is_beside(s, code)) and _is_panel(shown, s)]
    return max(squares, key=_area, default=None)


def albedo_of(code: str, wavelength_nm: float | None) -> float | None:
    """Reflectance in the code of a panel, 0 to 1: RP04-…_04005111000507 is 51.1 % at 400 nm and 50.7 % at
    1000 nm, with a straight line between them, as the cameras' firmware takes it too.
    """
    result = _ALBEDO_IN_CODE.search(code)
    if result is None or wavelength_nm is None:
        return None
    first_nm, first, last_nm, last = (float(n) for n in result.groups())
    if not first_nm <= wavelength_nm <= last_nm or last_nm == first_nm:
        return None
    return (first + (last - first) * (wavelength_nm - first_nm) / (last_nm - first_nm)) / 1000


def inside(corners_px: ArrayLike, shape: tuple[int, int]) -> Mask:
    """(height, width): the pixels of an area with corners (n, 2)."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.round(np.asarray(corners_px)).astype(np.int32)], 1)
    return mask.astype(bool)


def _shown(image: Raster) -> tuple[NDArray[np.uint8], float]:
    """(8 bits, how much smaller)."""
    pixels: FloatImage = image.pixels if image.pixels.ndim == 2 else image.pixels.mean(axis=0)
    scale = min(1.0, _LONGEST_PX / max(pixels.shape))
    if scale < 1:
        pixels = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    low, high = np.percentile(pixels, _SHOWN_PERCENTILES)
    stretched = (pixels - low) * (255.0 / max(float(high - low), 1e-9))
    return np.clip(np.rint(stretched), 0, 255).astype(np.uint8), scale


def _code(shown: NDArray[np.uint8]) -> tuple[str, Corners | None]:
    """(text, corners) of a QR code; a decoded text is reliable, an outline alone often is not."""
    try:
        text, at, _ = cv2.QRCodeDetector().detectAndDecode(shown)
    except cv2.error:  # some outlines that are no codes make it divide by nothing
        return "", None
    return (text, np.asarray(at, np.float64).reshape(4, 2)) if text else ("", None)


def _outlines(shown: NDArray[np.uint8], minimum: float, maximum: float) -> list[Corners]:
    """Convex quadrilaterals that some brightness outlines, of areas between two."""
    result = []
    low, high = (float(v) for v in np.percentile(shown, _LEVEL_PERCENTILES))
    for level in np.linspace(low, high, _LEVELS + 2)[1:-1]:
        contours, _ = cv2.findContours((shown > level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        for contour in (c for c in contours if minimum <= cv2.contourArea(c) <= maximum):
            tolerance_px = _CORNER_TOLERANCE * cv2.arcLength(contour, closed=True)
            four = cv2.approxPolyDP(contour, tolerance_px, closed=True).reshape(-1, 2)
            if len(four) == 4 and cv2.isContourConvex(four):
                sides = np.linalg.norm(four - np.roll(four, 1, axis=0), axis=1)
                longer, shorter = np.maximum(sides[:2], sides[2:]), np.minimum(sides[:2], sides[2:])
                if sides.max() <= _MAX_SLANT * sides.min() and (longer <= _MAX_TAPER * shorter).all():
                    result.append(four.astype(np.float64))
    return result


def _is_panel(shown: NDArray[np.uint8], square: Corners) -> bool:
    """True where it is homogeneous, and brighter than a ring around it."""
    inner, edge, outer = (inside(_shrunk(square, share), shown.shape) for share in (_INNER, *_RING))
    within, around = shown[inner].astype(np.float64), shown[outer & ~edge]
    if not len(within) or not len(around):
        return False
    bright = within.mean() >= _MIN_CONTRAST * np.median(around)
    return bool(bright and within.std() <= _MAX_SPREAD * within.mean())


def _is_beside(square: Corners, code: Corners) -> bool:
    side, apart = _area(code) ** 0.5, float(np.linalg.norm(square.mean(axis=0) - code.mean(axis=0)))
    return bool(side <= apart <= _CODE_REACH * side)


def _area(corners: Corners) -> float:
    return float(cv2.contourArea(corners.astype(np.float32)))


def _shrunk(square: Corners, share: float = _INNER) -> Corners:
    middle = square.mean(axis=0)
    return np.asarray(middle + share * (square - middle))
