"""From raw numbers to radiance and reflectance, as the cameras' makers document it.

    signal = (raw - black) / full_scale * vignetting(r) / (1 + gradient y)
    value = gain * signal

y is the row and r the distance from the vignetting's centre, px of the band's own file. Vignetting multiplies by
1 / (1 + k1 r + ... + k6 r^6) with MicaSense and by 1 + k1 r + ... + k6 r^6 with DJI. Reflectance is radiance times
what the light sensor says of the sun, or times what a panel of known reflectance says. Temperatures are temperatures
whatever is chosen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.values.capture import Capture, Quantity, Radiometry
from agalign.values.choices import RadiometryChoice
from agalign.values.image import FloatImage


def with_radiometry(capture: Capture, choice: RadiometryChoice, by_panel: Mapping[str, float]) -> Capture:
    """The capture with, of every band, what turns its numbers into what was chosen; None where it cannot be had.

    `by_panel` is, of bands that a panel was seen in, what radiance is to be multiplied by for reflectance. `auto` is by
    panel where all bands can be, else by the sun where all can be, else by the camera alone; a colour photograph, of
    which nothing is known, stands in nobody's way.
    """
    if choice == "off":
        return capture
    in_turn: Sequence[RadiometryChoice] = ("panel", "sun", "camera") if choice == "auto" else (choice,)
    for one in in_turn:
        found = {b.name: _chosen(b.radiometry, one, by_panel.get(b.name)) for b in capture.bands}
        if all(found[b.name] is not None for b in capture.bands if not b.companion):
            break
    return replace(capture, bands=tuple(replace(b, radiometry=found[b.name]) for b in capture.bands))


def _chosen(of_camera: Radiometry | None, choice: RadiometryChoice, by_panel: float | None) -> Radiometry | None:
    if of_camera is None or not of_camera.is_of_light or choice == "camera":
        return of_camera
    told: tuple[float, Quantity] | None = of_camera.by_sun
    if choice == "panel":
        told = None if by_panel is None else (by_panel, "reflectance")
    if told is None:
        return None
    factor, quantity = told
    return replace(of_camera, gain=of_camera.gain * factor, quantity=quantity, by_sun=None)


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
