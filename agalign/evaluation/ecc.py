"""Registration by the enhanced correlation coefficient (Evangelidis and Psarakis 2008), as MicaSense's library and
OpenDroneMap use it: on gradient magnitudes, over an image pyramid.
"""

import cv2
import numpy as np

from agalign.method.learned_matches import to_8_bit
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import FloatImage, Raster
from agalign.values.pixel_units import PixelScale

_HALVINGS = 3, 2, 1, 0
"""Levels of the pyramid: how often the images are halved."""
_CRITERIA = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6


def homography_by_ecc(fixed: Raster, moving: Raster, start: Matrix) -> Matrix | None:
    """Return fixed_to_moving, refined from `start`; None if the iteration diverges at full resolution.

    A coarser level at which it diverges, for lack of edges, is skipped.
    """
    edges, matrix = [_gradient_magnitude(raster) for raster in (fixed, moving)], start
    for halvings in _HALVINGS:
        scale = PixelScale(0.5**halvings, 0.5**halvings)
        template, image = (cv2.resize(e, None, fx=scale.x, fy=scale.y, interpolation=cv2.INTER_AREA) for e in edges)
        initial = geometry.rescale(matrix, scale, scale).astype(np.float32)
        try:
            _, result = cv2.findTransformECC(template, image, initial, cv2.MOTION_HOMOGRAPHY, _CRITERIA, None, 1)
        except cv2.error:
            if halvings == 0:
                return None
            continue
        matrix = geometry.rescale(np.asarray(result, float), scale.inverse, scale.inverse)
    return matrix


def _gradient_magnitude(raster: Raster) -> FloatImage:
    smooth = cv2.GaussianBlur(to_8_bit(raster).astype(np.float32), (0, 0), 1.0)
    return np.asarray(cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
