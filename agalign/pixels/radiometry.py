"""Conversion of raw values to radiance and reflectance, as documented by the camera makers.

    signal = (raw - black) / full_scale * vignetting(r) / (1 + gradient y)
    value = gain * signal

y is the row and r the distance from the vignetting centre, px of the band's own file. The vignetting correction is
1 / (1 + k1 r + ... + k6 r^6) for MicaSense and 1 + k1 r + ... + k6 r^6 for DJI. Reflectance is radiance times a factor
from the light sensor or from a panel of known reflectance. Thermal bands are not converted.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import InputError
from agalign.pixels.raster import ReadTile, read_for_alignment
from agalign.values.capture import Band, Capture
from agalign.values.choices import RadiometryChoice
from agalign.values.image import FloatImage, Raster, Tile
from agalign.values.pixel_units import PixelScale, Size
from agalign.values.radiometric_errors import FACTORY_CALIBRATION, PANEL_AND_SENSOR, too_bright
from agalign.values.radiometry import MAX_REFLECTANCE, Radiometry, ReflectanceFactor

_PLAUSIBLE: Mapping[str, tuple[float, float]] = {
    "exposure time (s)": (1e-6, 1.0),  # images of a moving camera are blurred from 0.01 s
    "sensor gain": (0.1, 100.0),  # ISO / 100; cameras have 1 to 16
    "gain adjustment": (0.1, 10.0),  # between the bands of a camera: 0.8 to 2.2 on two Phantom 4
    "calibration coefficient": (1e-6, 1e-2),  # 0.9e-4 to 3.7e-4 on six RedEdge
    "black level": (0.0, 2.0**14),  # a quarter of 16 bits; cameras write 4,096 to 5,800
    "vignetting": (0.05, 20.0),  # anywhere in the image; a wide lens leaves a third of the light in the corners
    "vignetting centre (share of the image)": (0.3, 0.7),  # cameras have 0.42 to 0.58
    "row gradient": (0.1, 10.0),  # first or last row; up to 1.3
    "irradiance (W / m^2 / nm)": (0.005, 3.0),  # from sunset (0.6 % of a clear noon) to 1.5 times a clear noon
    "relative irradiance": (10.0, 1e6),  # 7,000 to 17,000 in the sun
}
"""Ranges of the values that radiance and reflectance are calculated from; others are of damaged tags. A factor without
a range must be a finite number.
"""
_MAX_BELOW_BLACK = 0.01
"""Minimum median of a band above the black level, negative, relative to the full scale. Water in the near infrared is
at the black level, which drifts by 0.5 % of the full scale.
"""
_MAX_SHARE_OFF_STEPS = 0.05
"""Of the pixels: retouched hot pixels and edges of masks are fewer."""
_MIN_FLOOR, _MIN_FLOOR_SHARE = 0.04, 0.25
"""Of the darkest pixels without a black level, relative to the full scale and the median: sensors have a black level of
0.06 of the full scale, and scenes have shadows.
"""
_MIN_SIGNAL = 0.1
"""Median of a band above the black level, relative to the full scale: 0.12 to 0.5 in captures of land. Darker ones,
such as of water, differ by what the surface reflects of the sky.
"""
_CELLS = 16, 12
"""Columns and rows. Two captures of the same ground, shifted by whole cells, differ by 1 to 3 % in each band; twice as
many cells do not change that.
"""
_STRIP_PX = 1 << 15
"""Pixels that are calibrated at once: their intermediate results fit into the CPU's cache, which takes half the time.
"""


def plausible(radiometry: Radiometry, size_px: tuple[int, int]) -> tuple[Radiometry | None, str]:
    """Return the calibration of an image (width, height), and the tag that is implausible, in words; empty if none is.

    It is without `by_sun` if only the irradiance is implausible, and None if another tag is.
    """
    (width, height), (cx, cy) = size_px, radiometry.vignetting_centre_px
    r = np.linspace(0.0, max(np.hypot(x - cx, y - cy) for x in (0, width) for y in (0, height)), 32)
    with np.errstate(over="ignore", invalid="ignore"):
        falloff = np.polynomial.polynomial.polyval(r, (1.0, *radiometry.vignetting))
    values: dict[str, ArrayLike] = {**radiometry.tags, "black level": radiometry.black_level, "vignetting": falloff}
    if radiometry.vignetting:
        values["vignetting centre (share of the image)"] = np.divide((cx, cy), size_px)
    values["row gradient"] = 1.0 + radiometry.row_gradient * np.array([0.0, height])
    if radiometry.by_sun is not None:
        kind = "irradiance (W / m^2 / nm)" if radiometry.by_sun.quantity == "reflectance" else "relative irradiance"
        values.setdefault(kind, radiometry.irradiance or 0.0)
    for name, value in values.items() if radiometry.is_of_light else ():
        low, high = _PLAUSIBLE.get(name, (-sys.float_info.max, sys.float_info.max))
        for wrong in (v for v in np.ravel(value).tolist() if not low <= v <= high):
            rest = replace(radiometry, by_sun=None) if "irradiance" in name else None
            return rest, f"the {name} of {wrong:g} is not within {low:g} to {high:g}"
    return radiometry, ""


def with_checked_pixels(band: Band, read: ReadTile) -> Band:
    """Return the band with the means of the cells of its image, and with the doubt about its calibration if half of
    its pixels have a reflectance above 1.

    Raises InputError if the pixels do not fit the calibration, UnreadableFileError if they cannot be read. The
    corrections by position are left out, which are within a factor of 2. `read` reads the pixels of the file.
    """
    if band.radiometry is None or band.radiometry.quantity == "temperature":
        return band
    longest_side_px, radiometry = 256, band.radiometry
    if problem := _processed(band, read):
        raise InputError(f"{band.path}: {problem}; give the original image, or leave --radiometry out")
    image = read_for_alignment(band, longest_side_px, read)
    raw = float(np.median(image.pixels[image.valid])) if image.valid.any() else radiometry.black_level
    signal = (raw - radiometry.black_level) / radiometry.full_scale
    if signal < -_MAX_BELOW_BLACK:
        problem = f"its black level of {radiometry.black_level:g} is above its pixels (median {raw:.0f})"
    elif radiometry.quantity == "reflectance" and signal * radiometry.gain > MAX_REFLECTANCE:
        problem = f"its median reflectance of {signal * radiometry.gain:.3g} is above {MAX_REFLECTANCE:g}"
    elif radiometry.quantity == "reflectance" and signal * radiometry.gain > 1.0:
        radiometry = replace(radiometry, errors=(*radiometry.errors, too_bright(signal * radiometry.gain)))
    if not problem:
        means = _cell_means(radiometry, band.size_px, image) if signal > _MIN_SIGNAL else ()
        return replace(band, radiometry=replace(radiometry, cell_means=means))
    raise InputError(f"{band.path}: {problem}; take the capture out, or leave --radiometry out")


def _cell_means(radiometry: Radiometry, size_px: Size, image: Raster) -> tuple[tuple[float, ...], ...]:
    """The means of the calibrated values of a raw image (width, height), which is reduced to `image`."""
    reduced = radiometry.rescaled(PixelScale.between(size_px, image.size_px))
    values = np.where(image.valid, calibrated(image.pixels, reduced, 0, 0), 0.0)
    sums, valid = (cv2.resize(one, _CELLS, interpolation=cv2.INTER_AREA) for one in (values, np.float64(image.valid)))
    means = np.divide(sums, valid, out=np.full_like(sums, np.nan), where=valid > 0)
    return tuple(tuple(float(f"{mean:.4g}") for mean in row) for row in means.tolist())


def _processed(band: Band, read: ReadTile) -> str:
    """Return in words how the pixels of a band differ from raw numbers, which its tags are for; empty if they do not.

    Raises UnreadableFileError.
    """
    radiometry = band.radiometry
    if radiometry is None or not (radiometry.raw_step > 1 or radiometry.black_level == 0):
        return ""
    pixels, valid = read(band, Tile(0, 0, *band.size_px))
    values = pixels[valid]
    if not values.size:
        return ""
    if radiometry.raw_step > 1 and (share := np.mean(values % radiometry.raw_step != 0)) > _MAX_SHARE_OFF_STEPS:
        what = f"{share:.0%} of its pixels are not multiples of {radiometry.raw_step}"
        return f"{what}, as raw numbers of this camera are: a program has calibrated or changed them"
    floor, median = np.percentile(values.astype(np.float64), (0.1, 50.0)).tolist()
    if radiometry.black_level == 0 and floor > max(_MIN_FLOOR * radiometry.full_scale, _MIN_FLOOR_SHARE * median):
        return f"its darkest pixels ({floor:.0f}) are far above its black level of 0: a program has changed one of them"
    return ""


def with_radiometry(capture: Capture, choice: RadiometryChoice, by_panel: Mapping[str, ReflectanceFactor]) -> Capture:
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
        if all(result[b.name] is not None for b in capture.bands if not b.is_from_photograph):
            break
    bands = []
    for b in capture.bands:
        why = b.missing_calibration or ("no tags for radiance" if b.radiometry is None else "")
        bands.append(replace(b, radiometry=result[b.name], missing_calibration=why))
    return replace(capture, bands=tuple(bands))


def _converted(
    of_camera: Radiometry | None, choice: RadiometryChoice, by_panel: ReflectanceFactor | None
) -> Radiometry | None:
    if of_camera is None or not of_camera.is_of_light or choice == "camera":
        return of_camera
    factor = of_camera.by_sun if choice == "sun" else by_panel
    if factor is None:
        return None
    is_by_panel = factor.source != "light sensor"
    of_radiance = [e for e in of_camera.errors if not (is_by_panel and e == FACTORY_CALIBRATION)]  # it is calibrated
    of_panel = [e for e in by_panel.errors if e.name == PANEL_AND_SENSOR] if by_panel and factor is not by_panel else []
    return replace(
        of_camera,
        gain=of_camera.gain * factor.value,
        quantity=factor.quantity,
        source=factor.source,
        factor=factor.value,
        panel_age_s=factor.panel_age_s,
        errors=(*of_radiance, *factor.errors, *of_panel),
    )


def calibrated(pixels: NDArray[np.generic], radiometry: Radiometry, x0: int, y0: int) -> FloatImage:
    """Calibrate raw pixels (H, W) to float32; the top left pixel is (x0, y0) of the file."""
    height, width = pixels.shape
    result = np.empty((height, width), np.float32)
    x = np.arange(x0, x0 + width, dtype=np.float64)
    strip_px = max(1, _STRIP_PX // max(width, 1))
    for top in range(0, height, strip_px):
        strip = pixels[top : top + strip_px]
        y = np.arange(y0 + top, y0 + top + len(strip), dtype=np.float64)
        signal = np.subtract(strip, radiometry.black_level, dtype=np.float64)
        signal *= radiometry.gain / radiometry.full_scale
        if any(radiometry.vignetting):
            cx, cy = radiometry.vignetting_centre_px
            r = np.sqrt(((x - cx) ** 2)[None, :] + ((y - cy) ** 2)[:, None])  # a third of the time of np.hypot
            falloff = np.polynomial.polynomial.polyval(r, (1.0, *radiometry.vignetting))
            (np.divide if radiometry.vignetting_divides else np.multiply)(signal, falloff, out=signal)
        if radiometry.row_gradient:
            signal /= 1.0 + radiometry.row_gradient * y[:, None]
        result[top : top + strip_px] = signal
    return result
