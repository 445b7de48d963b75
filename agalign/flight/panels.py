"""Detection of captures of calibration panels, and reflectance factors from them."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from agalign.errors import AgalignError
from agalign.flight.groups import camera_key, flights_of
from agalign.pixels.panel import DetectedPanel, albedo_of, find_panel, inside
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import open_raster, read_for_alignment, read_window, without_warnings
from agalign.values.capture import Band, Capture, Panel
from agalign.values.pixel_units import PixelScale

Albedos = Mapping[str, float]
"""Reflectance of the panel as the user gives it, by band in lower case; the empty name is the default."""
_MAX_CAPTURES_WITHOUT_PANEL = 3
"""The search from either end of a flight stops after this many: panels are recorded before and after a flight."""
_READERS = 4
"""Threads that read captures."""
_DETECTION_PX = 1600
"""Longer side of the images in which panels are searched."""
_MAX_TIME_DIFFERENCE_S = 6 * 3600.0
"""A panel does not represent the illumination many hours later."""
_MAX_SATURATED_SHARE = 0.01
"""Maximum share of saturated pixels, which bias the mean radiance."""
_PANEL_HEIGHT_M = 1.0
"""Height of the camera above a panel when it is recorded."""
_MIN_HEIGHT_M = 3.0
"""Lower heights are within the error of the altitudes."""


@dataclass(frozen=True)
class BandReading:
    """Measurement of a panel in one band."""

    band: Band
    """With its panel."""
    albedo: float | None
    radiance: float | None
    """Mean over the panel, in the unit of the camera's calibration."""
    problem: str = ""
    """Why it cannot be used; empty if it can."""

    @property
    def factor(self) -> float | None:
        """Reflectance per radiance; None if the reading cannot be used."""
        if self.problem or self.albedo is None or self.radiance is None:
            return None
        return self.albedo / self.radiance


@dataclass(frozen=True)
class PanelReading:
    """Measurement of a panel in all bands of a capture."""

    capture: Capture
    bands: tuple[BandReading, ...]

    @property
    def panel(self) -> Panel:
        """The panel in the first band that contains it."""
        assert self.capture.panel is not None
        return self.capture.panel


def with_panels(captures: Sequence[Capture], *, without_code: bool = False) -> list[Capture]:
    """Return the captures with their panels.

    Panels are known from the tags or detected in the first and last captures of each flight by their QR code; with
    `without_code` also by their appearance.
    """
    ends = [end for flight in flights_of(captures) for end in _from_both_ends(flight)]
    with without_warnings(), ThreadPoolExecutor(_READERS) as pool:
        results = pool.map(lambda end: _captures_of_panels(end, without_code), ends)
        of_panels = {c.label: c for result in results for c in result}
    return [of_panels.get(c.label, c) for c in captures]


def read_panel(capture: Capture, albedos: Albedos) -> PanelReading:
    """Measure the panel in each band of a capture. `albedos` take precedence over the albedos of the panel."""
    return PanelReading(capture, tuple(_read(b, albedos) for b in capture.bands))


def reflectance_factors(capture: Capture, readings: Iterable[PanelReading]) -> dict[str, float]:
    """Return the reflectance per radiance of a capture by band.

    The illumination is interpolated linearly in time between the panels of the camera and constant outside. Empty if
    the time of the capture or of all panels is unknown.
    """
    time_s = capture.time_s
    if time_s is None:
        return {}
    illumination: dict[str, list[tuple[float, float]]] = {}
    for panel_time_s, reading in _within_hours(readings, time_s):
        for band in reading.bands if camera_key(reading.capture) == camera_key(capture) else ():
            if band.factor is not None:
                illumination.setdefault(band.band.name, []).append((panel_time_s, 1 / band.factor))
    return {name: 1 / _interpolated(time_s, samples) for name, samples in illumination.items()}


def with_height(capture: Capture, readings: Iterable[PanelReading]) -> Capture:
    """Return the capture with its height above the ground from the altitude of a panel.

    Captures with a height in the tags, without an altitude or without a panel within hours are not changed.
    """
    pose, position, time_s = capture.pose, capture.position, capture.time_s
    if pose is None or pose.height_m is not None or position is None or position.altitude_m is None or time_s is None:
        return capture
    altitudes_m = [
        r.capture.position.altitude_m for _, r in _within_hours(readings, time_s)
        if r.capture.is_of_a_panel and r.capture.position is not None and r.capture.position.altitude_m is not None
    ]  # fmt: skip
    height_m = position.altitude_m - min(altitudes_m) + _PANEL_HEIGHT_M if altitudes_m else 0.0
    if height_m <= _MIN_HEIGHT_M:
        return capture
    return replace(capture, pose=replace(pose, height_m=height_m, height_from="panel"))


def _within_hours(readings: Iterable[PanelReading], time_s: float) -> list[tuple[float, PanelReading]]:
    """Return (time, reading) of the panels within _MAX_TIME_DIFFERENCE_S of a time."""
    return [
        (panel_time_s, r) for r in readings
        if (panel_time_s := r.capture.time_s) is not None and abs(panel_time_s - time_s) <= _MAX_TIME_DIFFERENCE_S
    ]  # fmt: skip


def _interpolated(time_s: float, samples: list[tuple[float, float]]) -> float:
    """Interpolate (time, value) samples linearly; values at equal times are averaged."""
    times = sorted({t for t, _ in samples})
    return float(np.interp(time_s, times, [np.mean([v for t, v in samples if t == time]) for time in times]))


def _from_both_ends(flight: Sequence[Capture]) -> tuple[list[Capture], list[Capture]]:
    """Return the first half of a flight, and the second half in reverse order.

    The order is by time, or as given if a time is unknown.
    """
    times = [t for c in flight if (t := c.time_s) is not None]
    ordered = [flight[i] for i in np.argsort(times, kind="stable")] if len(times) == len(flight) else list(flight)
    middle = (len(ordered) + 1) // 2
    return ordered[:middle], ordered[middle:][::-1]


def _captures_of_panels(half: Sequence[Capture], without_code: bool) -> list[Capture]:
    """Return the captures with a panel, searched until several captures in a row contain none."""
    result: list[Capture] = []
    without_panel = 0
    for capture in half:
        # Mosaics contain no panels and take long to read.
        is_known = capture.panel is not None or capture.reference.georeference is not None
        examined = capture if is_known else _with_detected_panel(capture, without_code)
        if examined.panel is not None:
            result.append(examined)
            without_panel = 0
            continue
        without_panel += 1
        if without_panel == _MAX_CAPTURES_WITHOUT_PANEL:
            break
    return result


def _with_detected_panel(capture: Capture, without_code: bool) -> Capture:
    detected = _detect(capture.reference, without_code=without_code)
    # Without a code, a small square far from the image centre may be a roof or a sheet.
    if detected is None or (detected.in_scene and not detected.code):
        return capture
    by_band = [_detect(b, without_code=True) for b in capture.bands]
    # The code may be readable in one band only; it is valid for all.
    code = next((d.code for d in by_band if d is not None and d.code), "")
    bands = (
        replace(b, panel=None if d is None else _panel(d, b, code, in_scene=detected.in_scene))
        for b, d in zip(capture.bands, by_band, strict=True)
    )
    return replace(capture, bands=tuple(bands))


def _panel(detected: DetectedPanel, band: Band, code: str, *, in_scene: bool) -> Panel:
    serial, _, _ = code.partition("_")
    return Panel("QR code" if code else "look", serial, albedo_of(code, band.wavelength_nm), detected.area_px, in_scene)


def _detect(band: Band, *, without_code: bool) -> DetectedPanel | None:
    """Detect the panel in a band; positions are px of the file. None without a panel or if the file is unreadable."""
    try:
        image = read_for_alignment(band, _DETECTION_PX)
    except AgalignError:
        return None
    result = find_panel(replace(image, lens=None), without_code=without_code)
    if result is None:
        return None
    scale = image.size_px[0] / band.width_px
    in_file_px = PixelScale(scale, scale).inverse.positions(result.area_px)
    return replace(result, area_px=tuple((x, y) for x, y in in_file_px.tolist()))


def _read(band: Band, albedos: Albedos) -> BandReading:
    panel = band.panel
    if panel is not None and not panel.corners_px:
        # Firmware that recognises a panel does not always write its position.
        detected = _detect(band, without_code=True)
        panel = panel if detected is None else replace(panel, corners_px=detected.area_px)
        band = replace(band, panel=panel)
    albedo = albedos.get(band.name.lower(), albedos.get("", None if panel is None else panel.albedo))
    if panel is None or not panel.corners_px:
        return BandReading(band, albedo, None, "it was not found in this band")
    try:
        radiance, saturated = _radiance(band, panel)
    except AgalignError as error:
        return BandReading(band, albedo, None, str(error))
    if saturated > _MAX_SATURATED_SHARE:
        return BandReading(band, albedo, radiance, f"{saturated:.0%} of it is saturated")
    if radiance is not None and not radiance > 0:
        return BandReading(band, albedo, radiance, "it is black")
    return BandReading(band, albedo, radiance)


def _radiance(band: Band, panel: Panel) -> tuple[float | None, float]:
    """Return the mean radiance over the panel, None without calibration, and the saturated share of its pixels."""
    corners = np.asarray(panel.corners_px)
    x0, y0 = np.floor(corners.min(axis=0)).astype(int).clip(0, np.subtract(band.size_px, 1))
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int).clip((x0, y0), np.subtract(band.size_px, 1))
    with open_raster(band.path) as source:
        pixels, valid = read_window(source, band, int(x0), int(y0), int(x1 - x0 + 1), int(y1 - y0 + 1))
    within = inside(corners - (x0, y0), pixels.shape) & valid
    if not within.any():
        return None, 0.0
    values = pixels[within].astype(np.float64)
    saturated = 0.0 if band.saturation_value is None else float((values >= band.saturation_value).mean())
    if band.radiometry is None or not band.radiometry.is_of_light:
        return None, saturated
    return float(calibrated(pixels, band.radiometry, int(x0), int(y0))[within].mean(dtype=np.float64)), saturated
