"""From raw numbers to radiance and reflectance, as the cameras' makers document it.

    signal = (raw - black) / full_scale * vignetting(r) / (1 + gradient y)
    value = gain * signal

y is the row and r the distance from the vignetting's centre, px of the band's own file. Vignetting multiplies by
1 / (1 + k1 r + ... + k6 r^6) with MicaSense and by 1 + k1 r + ... + k6 r^6 with DJI. Reflectance is radiance times
the irradiance of the light sensor, or times the factor from a panel of known reflectance. Temperatures are temperatures
whatever is chosen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.values.capture import Capture, Quantity, Radiometry, RadiometrySource
from agalign.values.choices import RadiometryChoice
from agalign.values.image import FloatImage

_MAX_FALLOFF = 1000.0
_MAX_LOG_FALLOFF = np.log(_MAX_FALLOFF)
_MAX_RAW = 65535.0
_MAX_VALUE = 1e12
"""Float32 holds more; no light does."""


def is_physical(radiometry: Radiometry, size_px: tuple[int, int]) -> bool:
    """True where a calibration is one that an image of (width, height) can have: finite, of a gain above nothing, and
    darkening neither its corners nor its last row beyond a thousandfold. Damaged tags give others.
    """
    factor, _ = radiometry.by_sun or (1.0, None)
    numbers = (
        radiometry.black_level, radiometry.full_scale, radiometry.gain, factor, radiometry.row_gradient,
        *radiometry.vignetting, *radiometry.vignetting_centre_px,
    )  # fmt: skip
    if not np.isfinite(numbers).all() or min(radiometry.gain, radiometry.full_scale, factor) <= 0:
        return False
    width, height = size_px
    cx, cy = radiometry.vignetting_centre_px
    r = np.linspace(0.0, max(np.hypot(x - cx, y - cy) for x in (0, width) for y in (0, height)), 32)
    with np.errstate(over="ignore", invalid="ignore"):
        falloff = np.polynomial.polynomial.polyval(r, (1.0, *radiometry.vignetting))
        along = 1.0 + radiometry.row_gradient * np.array([0.0, height])
        largest = radiometry.gain / radiometry.full_scale * factor * _MAX_RAW
    return bool(
        (np.abs(np.log(np.clip(falloff, 1e-30, 1e30))) < _MAX_LOG_FALLOFF).all()
        and (along > 1 / _MAX_FALLOFF).all() and largest < _MAX_VALUE
    )  # fmt: skip


def with_radiometry(capture: Capture, choice: RadiometryChoice, by_panel: Mapping[str, float]) -> Capture:
    """The capture with the conversion of each band's numbers to the chosen quantity; None where it is not available.

    `by_panel` has the factor from radiance to reflectance for each band that a panel was measured in. `auto` is by
    panel if available for all bands, else by light sensor, else by the camera's calibration; a colour photograph does
    not count.
    """
    if choice == "off":
        return capture
    in_turn: Sequence[RadiometryChoice] = ("panel", "sun", "camera") if choice == "auto" else (choice,)
    for one in in_turn:
        result = {b.name: _chosen(b.radiometry, one, by_panel.get(b.name)) for b in capture.bands}
        if all(result[b.name] is not None for b in capture.bands if not b.companion):
            break
    return replace(capture, bands=tuple(replace(b, radiometry=result[b.name]) for b in capture.bands))


def _chosen(of_camera: Radiometry | None, choice: RadiometryChoice, by_panel: float | None) -> Radiometry | None:
    if of_camera is None or not of_camera.is_of_light or choice == "camera":
        return of_camera
    if choice == "sun":
        return to_reflectance(of_camera)
    return None if by_panel is None else _reflectance(of_camera, by_panel, "reflectance", "panel")


def to_reflectance(radiometry: Radiometry) -> Radiometry | None:
    """What gives reflectance: the radiometry itself where it does, else with the light sensor; None for neither."""
    if radiometry.quantity in ("reflectance", "relative reflectance"):
        return radiometry
    if not radiometry.is_of_light or radiometry.by_sun is None:
        return None
    return _reflectance(radiometry, *radiometry.by_sun, "light sensor")


def _reflectance(radiance: Radiometry, factor: float, quantity: Quantity, source: RadiometrySource) -> Radiometry:
    return replace(radiance, gain=radiance.gain * factor, quantity=quantity, source=source, by_sun=None)


def calibrated(pixels: NDArray[np.generic], radiometry: Radiometry, x0: int, y0: int) -> FloatImage:
    """(H, W) float32 of raw pixels; the top left one is (x0, y0) of the file."""
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
