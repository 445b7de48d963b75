"""From raw numbers to radiance and reflectance, as the cameras' makers document it.

    signal = (raw - black) / full_scale * vignetting(r) / (1 + gradient y)
    value = gain * signal

y is the row and r the distance from the vignetting's centre, px of the band's own file. Vignetting multiplies by
1 / (1 + k1 r + ... + k6 r^6) with MicaSense and by 1 + k1 r + ... + k6 r^6 with DJI.
"""

import numpy as np
from numpy.typing import NDArray

from agalign.values.capture import Radiometry
from agalign.values.image import FloatImage


def calibrated(pixels: NDArray[np.generic], radiometry: Radiometry, x0: int, y0: int) -> FloatImage:
    """(H, W) float32 of raw pixels whose top left one is (x0, y0) of the file."""
    height, width = pixels.shape
    x, y = np.arange(x0, x0 + width, dtype=np.float64), np.arange(y0, y0 + height, dtype=np.float64)
    signal = (pixels.astype(np.float64) - radiometry.black_level) * (radiometry.gain / radiometry.full_scale)
    if any(radiometry.vignetting):
        cx, cy = radiometry.vignetting_centre_px
        r = np.hypot((x - cx)[None, :], (y - cy)[:, None])
        falloff = np.polynomial.polynomial.polyval(r, (1.0, *radiometry.vignetting))
        signal = signal / falloff if radiometry.vignetting_divides else signal * falloff
    if radiometry.row_gradient:
        signal /= 1.0 + radiometry.row_gradient * y[:, None]
    return np.asarray(signal, np.float32)
