"""What calibration panels say: which captures show one, and by what radiance is to be multiplied for reflectance."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from agalign.errors import AgalignError
from agalign.flight.groups import camera_key, flights_of
from agalign.pixels.panel import PanelSight, albedo_of, find_panel, inside
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import open_raster, read_for_alignment, read_window, without_warnings
from agalign.values.capture import Band, Capture, Panel
from agalign.values.pixel_units import PixelScale

Albedos = Mapping[str, float]
"""Reflectance of the panel by band in lower case, or by the empty name for all others: what a user says."""
_AT_EITHER_END = 3
"""Captures at either end of a flight that are looked at in vain: panels are held before and after."""
_READERS = 4
_LOOK_PX = 1600
_SAME_OUTING_S = 6 * 3600.0
"""A panel is not valid for the illumination of another day."""
_MAX_SATURATED = 0.01
_PANEL_HEIGHT_M, _MIN_HEIGHT_M = 1.0, 3.0
"""At which the camera is held over a panel; and what errors of altitudes come to."""


@dataclass(frozen=True)
class BandReading:
    """A panel as one band has it."""

    band: Band
    """With its panel."""
    albedo: float | None
    radiance: float | None
    """Mean over its area, in the unit of the camera's own calibration."""
    problem: str = ""
    """Why it cannot be used."""

    @property
    def factor(self) -> float | None:
        """What radiance is to be multiplied by for reflectance."""
        if self.problem or self.albedo is None or self.radiance is None:
            return None
        return self.albedo / self.radiance


@dataclass(frozen=True)
class PanelReading:
    """A capture that shows a panel."""

    capture: Capture
    bands: tuple[BandReading, ...]

    @property
    def panel(self) -> Panel:
        """As the first band shows it."""
        assert self.capture.panel is not None
        return self.capture.panel


def with_panels(captures: Sequence[Capture], *, by_look: bool = False) -> list[Capture]:
    """The captures, with the panel of those that show one: by their tags or, for the first and last of each flight, by
    its QR code, or with `by_look` by its appearance.
    """
    ends = [end for flight in flights_of(captures) for end in _from_either_end(flight)]
    with without_warnings(), ThreadPoolExecutor(_READERS) as pool:
        seen = {c.label: c for result in pool.map(lambda end: _panels_at(end, by_look), ends) for c in result}
    return [seen.get(c.label, c) for c in captures]


def read_panel(capture: Capture, albedos: Albedos) -> PanelReading:
    """What a capture of a panel shows, band by band."""
    return PanelReading(capture, tuple(_read(b, albedos) for b in capture.bands))


def reflectance_factors(capture: Capture, readings: Iterable[PanelReading]) -> dict[str, float]:
    """By band, what a capture's radiance is to be multiplied by for reflectance: the light is linear in time between
    the panels of its camera, and as the nearest one has it before the first and after the last. None where the time of
    the capture or of all panels is unknown.
    """
    time_s = capture.time_s
    if time_s is None:
        return {}
    result: dict[str, list[tuple[float, float]]] = {}
    for panel_time_s, reading in _of_the_same_outing(readings, time_s):
        for band in reading.bands if camera_key(reading.capture) == camera_key(capture) else ():
            if band.factor is not None:
                result.setdefault(band.band.name, []).append((panel_time_s, 1 / band.factor))
    return {name: 1 / _at(time_s, known) for name, known in result.items()}


def with_height(capture: Capture, readings: Iterable[PanelReading]) -> Capture:
    """The capture with its height above the ground, where its tags have only an altitude and a panel of the same hours
    was held on the ground.
    """
    pose, position, time_s = capture.pose, capture.position, capture.time_s
    if pose is None or pose.height_m is not None or position is None or position.altitude_m is None or time_s is None:
        return capture
    panels = [
        r.capture.position.altitude_m for _, r in _of_the_same_outing(readings, time_s)
        if r.capture.is_of_a_panel and r.capture.position is not None and r.capture.position.altitude_m is not None
    ]  # fmt: skip
    height_m = position.altitude_m - min(panels) + _PANEL_HEIGHT_M if panels else 0.0
    if height_m <= _MIN_HEIGHT_M:
        return capture
    return replace(capture, pose=replace(pose, height_m=height_m, height_from="panel"))


def _of_the_same_outing(readings: Iterable[PanelReading], time_s: float) -> list[tuple[float, PanelReading]]:
    """(time, reading) of the panels that were taken within hours of a time; panels of unknown time are left out."""
    return [
        (panel_time_s, r) for r in readings
        if (panel_time_s := r.capture.time_s) is not None and abs(panel_time_s - time_s) <= _SAME_OUTING_S
    ]  # fmt: skip


def _at(time_s: float, known: list[tuple[float, float]]) -> float:
    times = sorted({t for t, _ in known})
    return float(np.interp(time_s, times, [np.mean([v for t, v in known if t == time]) for time in times]))


def _from_either_end(flight: Sequence[Capture]) -> tuple[list[Capture], list[Capture]]:
    """The first half of a flight, and the second from its end: in time, or as given where a time is unknown."""
    times = [t for c in flight if (t := c.time_s) is not None]
    in_time = [flight[i] for i in np.argsort(times, kind="stable")] if len(times) == len(flight) else list(flight)
    middle = (len(in_time) + 1) // 2
    return in_time[:middle], in_time[middle:][::-1]


def _panels_at(end: Sequence[Capture], by_look: bool) -> list[Capture]:
    """Those that show a panel, looked for until a few in a row show none."""
    result: list[Capture] = []
    without = 0
    for capture in end:
        # Mosaics show none, and are long to read.
        known = capture.panel is not None or capture.reference.georeference is not None
        seen = capture if known else _looked_at(capture, by_look)
        result += [] if seen.panel is None else [seen]
        without = 0 if seen.panel is not None else without + 1
        if without == _AT_EITHER_END:
            break
    return result


def _looked_at(capture: Capture, by_look: bool) -> Capture:
    sight = _seen(capture.reference, without_code=by_look)
    # A small square away from the middle is a roof or a sheet unless a code says otherwise.
    if sight is None or (sight.in_scene and not sight.code):
        return capture
    sights = [_seen(b, without_code=True) for b in capture.bands]
    in_scene = sight.in_scene
    # A code that one band shows plainly is the others' too.
    code = next((s.code for s in sights if s is not None and s.code), "")
    bands = (
        replace(b, panel=None if s is None else _panel(s, b, code, in_scene=in_scene))
        for b, s in zip(capture.bands, sights, strict=True)
    )
    return replace(capture, bands=tuple(bands))


def _panel(sight: PanelSight, band: Band, code: str, *, in_scene: bool) -> Panel:
    serial, _, _ = code.partition("_")
    return Panel("QR code" if code else "look", serial, albedo_of(code, band.wavelength_nm), sight.area_px, in_scene)


def _seen(band: Band, *, without_code: bool) -> PanelSight | None:
    """What a band shows of a panel, px of its file."""
    try:
        image = read_for_alignment(band, _LOOK_PX)
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
        sight = _seen(band, without_code=True)
        panel = panel if sight is None else replace(panel, corners_px=sight.area_px)
        band = replace(band, panel=panel)
    albedo = albedos.get(band.name.lower(), albedos.get("", None if panel is None else panel.albedo))
    if panel is None or not panel.corners_px:
        return BandReading(band, albedo, None, "it was not found in this band")
    try:
        radiance, saturated = _radiance(band, panel)
    except AgalignError as error:
        return BandReading(band, albedo, None, str(error))
    if saturated > _MAX_SATURATED:
        return BandReading(band, albedo, radiance, f"{saturated:.0%} of it is saturated")
    if radiance is not None and not radiance > 0:
        return BandReading(band, albedo, radiance, "it is black")
    return BandReading(band, albedo, radiance)


def _radiance(band: Band, panel: Panel) -> tuple[float | None, float]:
    """(mean over the panel's area, None where the tags give no calibration; share of it that is saturated)."""
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
