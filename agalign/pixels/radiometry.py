"""Conversion of raw values to radiance and reflectance, as documented by the camera makers.

    signal = (raw - black) / full_scale * vignetting(r) / (1 + gradient y)
    value = gain * signal

y is the row and r the distance from the vignetting centre, px of the band's own file. The vignetting correction is
1 / (1 + k1 r + ... + k6 r^6) for MicaSense and 1 + k1 r + ... + k6 r^6 for DJI. Reflectance is radiance times a factor
from the light sensor or from a panel of known reflectance. Thermal bands are not converted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.values.capture import Capture, PanelFactor, Quantity, Radiometry, RadiometrySource
from agalign.values.choices import RadiometryChoice
from agalign.values.image import FloatImage


def is_physical(radiometry: Radiometry, size_px: tuple[int, int]) -> bool:
    """Return True if a calibration is plausible for an image of (width, height); damaged tags are not.

    It is finite, its gain is positive, the corrections of the corners and of the last row are below a factor of 1000,
    and the values of 16-bit sensors below 1e12, which is above any radiance or reflectance.
    """
    max_correction, max_raw, max_value = 1000.0, 65535.0, 1e12
    factor, _ = radiometry.by_sun or (1.0, None)
    positive = radiometry.gain, radiometry.full_scale, factor
    of_position = radiometry.row_gradient, *radiometry.vignetting, *radiometry.vignetting_centre_px
    if not np.isfinite([radiometry.black_level, *positive, *of_position]).all() or min(positive) <= 0:
        return False
    width, height = size_px
    cx, cy = radiometry.vignetting_centre_px
    r = np.linspace(0.0, max(np.hypot(x - cx, y - cy) for x in (0, width) for y in (0, height)), 32)
    with np.errstate(over="ignore", invalid="ignore"):
        falloff = np.polynomial.polynomial.polyval(r, (1.0, *radiometry.vignetting))
        by_row = 1.0 + radiometry.row_gradient * np.array([0.0, height])
        brightest = radiometry.gain / radiometry.full_scale * factor * max_raw
    return bool(
        (np.abs(np.log(np.clip(falloff, 1e-30, 1e30))) < np.log(max_correction)).all()
        and (by_row > 1 / max_correction).all()
        and brightest < max_value
    )


def with_radiometry(capture: Capture, choice: RadiometryChoice, by_panel: Mapping[str, PanelFactor]) -> Capture:
    """Return the capture with the conversion of each band to the chosen quantity; None if it is not available.

    `by_panel` has the factors of the bands that were measured on a panel. `auto` is by panel if available for all
    bands, else by light sensor, else by the camera's calibration. If both exist, but could not be combined, it is by
    light sensor. RGB companions are ignored.
    """
    if choice == "off":
        return capture
    candidates: Sequence[RadiometryChoice] = ("panel", "sun", "camera") if choice == "auto" else (choice,)
    if choice == "auto" and any(factor.source == "panel" for factor in by_panel.values()):
        candidates = "sun", "panel", "camera"
    for candidate in candidates:
        result = {b.name: _converted(b.radiometry, candidate, by_panel.get(b.name)) for b in capture.bands}
        if all(result[b.name] is not None for b in capture.bands if not b.companion):
            break
    return replace(capture, bands=tuple(replace(b, radiometry=result[b.name]) for b in capture.bands))


def _converted(
    of_camera: Radiometry | None, choice: RadiometryChoice, by_panel: PanelFactor | None
) -> Radiometry | None:
    if of_camera is None or not of_camera.is_of_light or choice == "camera":
        return of_camera
    if choice == "sun":
        return to_reflectance(of_camera)
    if by_panel is None:
        return None
    result = _reflectance(of_camera, by_panel.value, "reflectance", by_panel.source)
    return replace(result, panel_age_s=by_panel.age_s)


def to_reflectance(radiometry: Radiometry) -> Radiometry | None:
    """Return the conversion to reflectance: `radiometry` if it is one, else with the light sensor, else None."""
    if radiometry.quantity in ("reflectance", "relative reflectance"):
        return radiometry
    if not radiometry.is_of_light or radiometry.by_sun is None:
        return None
    return _reflectance(radiometry, *radiometry.by_sun, "light sensor")


def _reflectance(radiance: Radiometry, factor: float, quantity: Quantity, source: RadiometrySource) -> Radiometry:
    return replace(radiance, gain=radiance.gain * factor, quantity=quantity, source=source, factor=factor)


def calibrated(pixels: NDArray[np.generic], radiometry: Radiometry, x0: int, y0: int) -> FloatImage:
    """Calibrate raw pixels (H, W) to float32; the top left pixel is (x0, y0) of the file."""
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
