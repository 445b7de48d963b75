"""Detection of captures of calibration panels, and reflectance factors from them."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import call
from typing import Protocol, TypeVar

import numpy as np

from agalign.cameras.sun import sun_position
from agalign.errors import AgalignError
from agalign.flight.groups import camera_key, flights_of
from agalign.pixels.gdal import without_warnings
from agalign.pixels.panel_detection import DetectedPanel, albedo_of, evenly_lit, find_panel, inside, is_homogeneous
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import read_for_alignment, read_tile
from agalign.values.capture import Band, Capture, Panel, PanelSource, distance_km, known_time_s
from agalign.values.image import Tile
from agalign.values.pixel_units import PixelScale
from agalign.values.radiometric_errors import LIGHT_SENSOR, PANEL_AND_SENSOR, contradiction, panel_errors
from agalign.values.radiometry import RadiometricError, RadiometrySource, ReflectanceFactor
from agalign.values.spectrum import band_key

R = TypeVar("R")
Albedos = Mapping[str, float]
"""Reflectance of the panel as the user gives it, by band in lower case; the empty name is the default."""
MAX_LIGHT_APART_S = 6 * 3600.0
"""Between a capture and the panels that tell its light, which changes within hours."""
_MAX_HEIGHT_APART_S = 6 * 3600.0
"""Between a capture and a panel that tells its height: air pressure changes with the weather, by 1 hPa for 8 m."""
READERS = 4
"""Number of captures whose images are read at a time: more would wait for the disk."""
_SAME_LIGHT_S = 3600.0
"""Two panels within this time are compared: the sun's height, or a light sensor, tells how the light changed."""
_MAX_SCALE = 1.3
"""Between the light on a panel and that by a light sensor or another panel."""
MIN_LIGHT_RATIO = 0.5
"""Of the light on a panel relative to that on another one of the hour: in the shade it is 0.1 to 0.4."""
_SAME_ALBEDO = 0.01
"""Relative difference of the reflectance of one panel by two captures: files round it to 0.1 %."""
_MAX_DISTANCE_KM = 1.0
"""From a panel whose altitude is that of the ground: farther away, it may be of another field."""
_MIN_HEIGHT_M = 3.0
"""Lower heights are within the error of the altitudes."""


@dataclass(frozen=True)
class BandReading:
    """Measurement of the panel of one band."""

    band: Band
    albedo: float | None
    radiance: float | None = None
    """Mean over the evenly lit part of the panel, in the unit of the camera's calibration."""
    problem: str = ""
    """Why it cannot be used; empty if it can."""
    spread: float = 0.0
    """Standard deviation over this part, relative to the mean."""
    other_albedo: float | None = None
    """Reflectance of the panel of this serial number by another capture that contradicts `albedo`; None without one."""

    @property
    def factor(self) -> float | None:
        """Reflectance per radiance; None if the reading cannot be used."""
        if self.problem or self.albedo is None or self.radiance is None:
            return None
        return self.albedo / self.radiance

    @property
    def sensor_scale(self) -> float | None:
        """Irradiance on the panel divided by that of the light sensor, in any unit; None if either is unknown."""
        sun = None if self.band.radiometry is None else self.band.radiometry.by_sun
        return sun.value / self.factor if sun and self.factor else None


@dataclass(frozen=True)
class PanelReading:
    """Measurement of a panel in all bands of a capture."""

    capture: Capture
    bands: tuple[BandReading, ...]
    brighter: str = ""
    """Label of a capture of a panel within the hour on which the light was stronger than it can have changed; empty if
    there is none."""
    light_ratio: float = 1.0
    """Light on this panel relative to that on the brighter one, after the change of the light; the median of the bands.
    """

    @property
    def is_lit(self) -> bool:
        """False for a panel with less than half of the light on a brighter one: shade leaves less, most clouds more."""
        return self.light_ratio >= MIN_LIGHT_RATIO

    @property
    def sensor_scales(self) -> dict[str, float]:
        """Irradiance on the panel divided by that of the light sensor by band, if both are known and not relative."""
        known = [b.band.radiometry for b in self.bands if b.band.radiometry is not None]
        if any(r.by_sun is not None and r.by_sun.quantity != "reflectance" for r in known):
            return {}
        return {b.band.name: b.sensor_scale for b in self.bands if b.sensor_scale}

    @property
    def fits_sensor(self) -> bool:
        """False if the panel and the light sensor cannot have been in the same light, or one is wrong in some bands."""
        # Calibrated sensors agree with panels within 20 %, except if a person, an aircraft or a cloud shades one. Bands
        # of one panel and one sensor that is not calibrated differ by up to 18 % (RedEdge-M, DLS 1).
        scales = [*self.sensor_scales.values()] or [1.0]
        median = float(np.median(scales))
        return 1 / _MAX_SCALE < median < _MAX_SCALE and max(scales) < _MAX_SCALE * min(scales)

    @property
    def panel(self) -> Panel:
        """The panel in the first band that contains it."""
        assert self.capture.panel is not None
        return self.capture.panel


class Examine(Protocol):
    """Calls a function that reads the images of a capture; returns None if that takes longer than a time limit."""

    def __call__(self, function: Callable[..., R], capture: Capture, /, *arguments: object) -> R | None: ...


def with_panels(captures: Sequence[Capture], *, without_code: bool = False, examine: Examine = call) -> list[Capture]:
    """Return the captures with their panels.

    Panels are known from the tags or detected in the first and last captures of each flight by their QR code; with
    `without_code` also by their appearance. Captures in which fewer than two cues indicate a panel are aligned as well.
    """
    flights = flights_of(captures)
    ends = [end for flight in flights for end in _from_both_ends(flight)]
    medians_m: dict[str, float] = {}
    for flight in flights:
        altitudes_m = [c.altitude_m for c in flight if c.altitude_m is not None] or [math.nan]
        medians_m |= dict.fromkeys((c.label for c in flight), float(np.median(altitudes_m)))
    with without_warnings(), ThreadPoolExecutor(READERS) as pool:
        results = pool.map(lambda end: _captures_of_panels(end, without_code, examine), ends)
        of_panels = [c for result in results for c in result]
        judged = pool.map(lambda c: examine(with_cues, c, medians_m[c.label]), of_panels)
        by_label = {c.label: c for c in judged if c is not None}
    return [by_label.get(c.label, c) for c in captures]


def with_cues(capture: Capture, flight_altitude_m: float) -> Capture:
    """Return a capture of a panel with its cues, given the median altitude of its flight (nan if unknown).

    A single cue does not exclude it: tags and names can be wrong, a QR code may belong to a marker in the field, and
    roofs and sheets are bright squares.
    """
    cues = _panel_cues(capture, flight_altitude_m)
    is_single = len(cues) < 2
    bands = (
        b if b.panel is None else replace(b, panel=replace(b.panel, cues=cues, in_scene=b.panel.in_scene or is_single))
        for b in capture.bands
    )
    return replace(capture, bands=tuple(bands))


def _panel_cues(capture: Capture, flight_altitude_m: float) -> tuple[str, ...]:
    seen_by = {b.panel.seen_by for b in capture.bands if b.panel is not None}
    cues = ["its tags"] if "tags" in seen_by else []
    cues += ["a QR code"] if "QR code" in seen_by else []
    if sum(map(_shows_square, capture.bands)) > len(capture.bands) / 2:
        cues.append("a homogeneous square in most bands")
    if capture.altitude_m is not None and capture.altitude_m < flight_altitude_m - _MIN_HEIGHT_M:
        cues.append(f"an altitude more than {_MIN_HEIGHT_M:.0f} m below the median of the flight")
    if any(re.search("panel|calib", name, re.IGNORECASE) for name in (*capture.folder.parts, capture.name)):
        cues.append("'panel' or 'calib' in its folder or name")
    return tuple(cues)


def _shows_square(band: Band) -> bool:
    """Return True if the area of the panel was detected in the pixels of a band, or is homogeneous there."""
    panel = band.panel
    if panel is None or panel.seen_by != "tags":
        return panel is not None and len(panel.corners_px) > 0
    if not panel.corners_px:
        detected = _detect(band, without_code=True)
        return detected is not None and len(detected.area_px) > 0
    try:
        pixels, valid = read_tile(band, Tile(0, 0, *band.size_px))
    except AgalignError:
        return False
    return is_homogeneous(pixels[inside(panel.corners_px, pixels.shape) & valid].astype(np.float64))


def read_panel(capture: Capture, albedos: Albedos) -> PanelReading:
    """Measure the panel in each band of a capture. `albedos` take precedence over the albedos of the panel."""
    return PanelReading(capture, tuple(_read(b, albedos) for b in capture.bands))


def compared(readings: Sequence[PanelReading]) -> list[PanelReading]:
    """Return the readings with what others contradict: panels that are darker than another one of the hour, and panels
    of one serial number with two reflectances.
    """
    return [_with_other_albedos(_with_brighter(one, readings), readings) for one in readings]


def _with_brighter(reading: PanelReading, others: Sequence[PanelReading]) -> PanelReading:
    ratios = [(ratio, o.capture.label) for o in others if (ratio := _light_ratio(reading, o)) is not None]
    ratio, label = min(ratios, default=(1.0, ""))
    return replace(reading, brighter=label, light_ratio=ratio) if ratio < 1 / _MAX_SCALE else reading


def _light_ratio(one: PanelReading, other: PanelReading) -> float | None:
    """The light on a panel relative to that on another one of the camera within the hour, divided by the change of the
    light by the light sensor, else by the height of the sun; the median of the bands. None if it is unknown.
    """
    times_s = one.capture.time_s, other.capture.time_s
    is_one_camera = camera_key(one.capture) == camera_key(other.capture) and one.capture is not other.capture
    if not is_one_camera or times_s[0] is None or times_s[1] is None or abs(times_s[0] - times_s[1]) > _SAME_LIGHT_S:
        return None
    by_name = {b.band.name: b for b in other.bands}
    pairs = [(b, by_name[b.band.name]) for b in one.bands if b.band.name in by_name]
    of_sun, ratios = _sun_height(one.capture) / _sun_height(other.capture), []
    for own, others in pairs:
        if own.sensor_scale and others.sensor_scale:
            ratios.append(own.sensor_scale / others.sensor_scale)
        elif own.factor and others.factor:
            ratios.append(others.factor / own.factor / of_sun)
    return float(np.median(ratios)) if ratios else None


def _sun_height(capture: Capture) -> float:
    """Sine of the elevation of the sun, at least 0.1; 1 if the position or the time is unknown."""
    if capture.position is None or (time_s := known_time_s(capture.captured_at)) is None:
        return 1.0
    min_sine = 0.1  # near the horizon, the light is not proportional to it
    return max(min_sine, math.sin(sun_position(capture.position, time_s)[0]))


def _with_other_albedos(reading: PanelReading, others: Sequence[PanelReading]) -> PanelReading:
    same = [b for o in others if o.panel.serial and o.panel.serial == reading.panel.serial for b in o.bands]
    bands = []
    for band in reading.bands:
        known = [b.albedo for b in same if b.band.name == band.band.name and b.albedo]
        own = band.albedo or 0.0
        differing = [v for v in known if abs(v - own) > _SAME_ALBEDO * max(v, own)]
        bands.append(replace(band, other_albedo=differing[0]) if own and differing else band)
    return replace(reading, bands=tuple(bands))


def reflectance_factors(capture: Capture, readings: Iterable[PanelReading]) -> dict[str, ReflectanceFactor]:
    """Return the factor from radiance to reflectance of a capture by band, given the `compared` readings.

    The panel gives the scale of the light sensor, with the irradiances E of the capture and E_p of the panel's capture:

        factor = albedo / (radiance of the panel) * E_p / E

    E_p / E is 1 without a sensor, and if the sensor was not in the same light as one of the panels: for all bands of
    the capture alike, as the change of the light would not cancel in an index of bands under different light. Between
    the panels of the camera, the reciprocals are interpolated linearly in time; before the first and after the last,
    they are constant. If the time of the capture or of the panels is unknown, `_without_clock` chooses the panel;
    without one the result is empty. A panel with less than half of the light on another one of the hour is not used.
    """
    of_camera = [r for r in readings if camera_key(r.capture) == camera_key(capture)]
    timed = _near_in_time(of_camera, capture, MAX_LIGHT_APART_S)
    near = timed or _without_clock(of_camera, capture)
    used = [(s, r) for s, r in near if r.is_lit]
    light = _of_panels(used, lambda b: None if b.factor is None else 1 / b.factor)
    scales = _of_panels(used, lambda b: b.sensor_scale)
    suns = {b.name: b.radiometry.by_sun for b in capture.bands if b.radiometry is not None and b.name in light}
    is_by_sensor = all(r.fits_sensor for _, r in used) and all(suns.values()) and suns.keys() <= scales.keys()
    result = {}
    for band in (b for b in capture.bands if b.name in light):
        measured = [(abs(s), b.spread) for s, r in used for b in r.bands if b.band.name == band.name and b.factor]
        nearest_s, spread = min(measured)
        age_s = nearest_s if timed else None
        sun = suns.get(band.name)
        if sun is not None and is_by_sensor:
            source: RadiometrySource = "panel and light sensor"
            value = sun.value / _interpolated(scales[band.name])
            tilt = [e for e in sun.errors if e not in LIGHT_SENSOR.values()]  # its scale is that of the panel
            errors = (*panel_errors(spread, None), *_difference(scales[band.name]), *tilt)
        else:
            value, source = 1 / _interpolated(light[band.name]), "panel"
            errors = (*panel_errors(spread, age_s), *_difference(light[band.name]))
        contradictions = _contradictions([r for _, r in near], band.name)
        result[band.name] = ReflectanceFactor(value, "reflectance", source, age_s, (*errors, *contradictions))
    return result


def _of_panels(
    used: Sequence[tuple[float, PanelReading]], value: Callable[[BandReading], float | None]
) -> dict[str, list[tuple[float, float]]]:
    """Return (seconds after the capture, value) of the panels by band, for each band that any of them has.

    What a panel lacks in a band, as it is saturated there, is that of the panel nearest in time which has it, times the
    median ratio of the two in the other bands: the light changes alike in all.
    """
    known = [(s, {b.band.name: v for b in reading.bands if (v := value(b))}) for s, reading in used]
    result = dict[str, list[tuple[float, float]]]()
    for name in dict.fromkeys(name for _, values in known for name in values):
        having = [(s, values) for s, values in known if name in values]
        result[name] = [(s, values[name]) for s, values in having]
        for s, values in (one for one in known if name not in one[1]):
            _, other = min(having, key=lambda one: abs(one[0] - s))
            if ratios := [values[n] / other[n] for n in values.keys() & other.keys()]:
                result[name].append((s, other[name] * float(np.median(ratios))))
    return result


def _difference(samples: Sequence[tuple[float, float]]) -> list[RadiometricError]:
    """The error by the difference of several panels, given their (time, value)."""
    values = [value for _, value in samples]
    percent = 100 * (math.sqrt(max(values) / min(values)) - 1)
    return [RadiometricError("difference of the panels", percent)] if len(values) > 1 else []


def _contradictions(near: Sequence[PanelReading], band: str) -> list[RadiometricError]:
    """What contradicts the panels near a capture in a band."""
    dark = [r.light_ratio for r in near if r.brighter]
    bands = [b for r in near for b in r.bands if b.band.name == band]
    albedos = [v for b in bands if b.other_albedo for v in (b.albedo, b.other_albedo) if v]
    scales = [b.sensor_scale for r in near if r.is_lit and not r.fits_sensor for b in r.bands if b in bands]
    found = [contradiction("two calibration panels", 1.0, min(dark))] if dark else []
    found += [contradiction("reflectance of the panel", *albedos)] if albedos else []
    return found + [contradiction(PANEL_AND_SENSOR, 1.0, scale) for scale in scales[:1] if scale]


def missing_panel(capture: Capture, readings: Sequence[PanelReading]) -> str:
    """Return why no reading gives the reflectance of all bands of a capture, and the remedy; empty if they do."""
    lacking = {b.name for b in capture.bands if not b.is_from_photograph} - reflectance_factors(
        capture, readings
    ).keys()
    if not lacking:
        return ""
    if not readings:
        return (
            "no capture of a calibration panel was found; photograph the panel before and after the flight, or give "
            "--panel-albedo for a panel without QR code"
        )
    of_camera = [r for r in readings if camera_key(r.capture) == camera_key(capture)]
    if not of_camera:
        other = readings[0].capture
        return f"the panel in {other.label} was photographed by {camera_key(other)}, not by {camera_key(capture)}"
    near = _near_in_time(of_camera, capture, MAX_LIGHT_APART_S) or _without_clock(of_camera, capture)
    if not near:
        return _far_in_time(capture, of_camera)
    readable = [(r.capture.label, b) for _, r in near for b in r.bands if b.band.name in lacking]
    for label, reading in sorted(readable, key=lambda one: not one[1].problem):
        if reading.problem:
            return f"{reading.band.name} of the panel in {label}: {reading.problem}"
        if reading.albedo is None:
            return f"the reflectance of the panel in {label} is unknown in {reading.band.name}; give --panel-albedo"
    return f"the panel in {near[0][1].capture.label} has no reflectance in {', '.join(sorted(lacking))}"


def _far_in_time(capture: Capture, readings: Sequence[PanelReading]) -> str:
    """Return in words how far the nearest panel is from a capture, or which time is unknown."""
    time_s, panels = capture.time_s, [r.capture for r in readings]
    unset = [c for c in (capture, *panels) if c.captured_at and not c.known_time]
    if unset and len(unset) <= len(panels):
        return f"the clock of {unset[0].label} was not set, so that no panel is known to be of the flight"
    if time_s is None or all(panel.time_s is None for panel in panels):
        unknown = capture if time_s is None else panels[0]
        return f"the time of {unknown.label} is unknown, so that no panel is known to be of the flight"
    later = [(panel.time_s - time_s, panel) for panel in panels if panel.time_s is not None]
    later_s, nearest = min(later, key=lambda one: abs(one[0]))
    hours = abs(later_s) / 3600
    age = f"{hours / 24:.0f} days" if hours >= 48 else f"{hours:.0f} hours"
    limit = f"a panel counts for {MAX_LIGHT_APART_S / 3600:.0f} hours, because the light changes"
    return f"the nearest panel, in {nearest.label}, is {age} {'older' if later_s < 0 else 'newer'}; {limit}"


def with_height(capture: Capture, readings: Iterable[PanelReading]) -> Capture:
    """Return the capture with its height above the ground from the altitude of a panel.

    Captures with a height in the tags, without an altitude or without a panel within hours and a kilometre are not
    changed.
    """
    pose, here = capture.pose, capture.position
    if pose is None or pose.height_m is not None or capture.altitude_m is None or here is None:
        return capture
    recent = _near_in_time(readings, capture, _MAX_HEIGHT_APART_S)
    on_ground = [r.capture for _, r in recent if r.capture.is_of_a_panel]
    near = [c for c in on_ground if c.position is not None and distance_km(c.position, here) <= _MAX_DISTANCE_KM]
    altitudes_m = [c.altitude_m for c in near if c.altitude_m is not None]
    above_panel_m = 1.0  # of the camera when a panel is recorded
    height_m = capture.altitude_m - min(altitudes_m) + above_panel_m if altitudes_m else 0.0
    if height_m <= _MIN_HEIGHT_M:
        return capture
    return replace(capture, pose=replace(pose, height_m=height_m, height_from="panel"))


def _near_in_time(
    readings: Iterable[PanelReading], capture: Capture, max_apart_s: float
) -> list[tuple[float, PanelReading]]:
    """Return (seconds after a capture, reading) of the panels close to it in time; none if its time is unknown."""
    time_s = math.nan if capture.time_s is None else capture.time_s
    timed = [(panel_time_s - time_s, r) for r in readings if (panel_time_s := r.capture.time_s) is not None]
    return [(later_s, r) for later_s, r in timed if abs(later_s) <= max_apart_s]


def _without_clock(readings: Sequence[PanelReading], capture: Capture) -> list[tuple[float, PanelReading]]:
    """Return (0, reading) of the panel that a capture has if the clock of one of the two was not set: the only panel of
    the camera, or the next one by the number in its name, in the folder of the capture.
    """
    unset = [r for r in readings if bool(r.capture.known_time) != bool(capture.known_time)]
    if len(readings) == 1:
        return [(0.0, r) for r in unset]
    numbers = [(r, _number(r.capture)) for r in unset if r.capture.folder == capture.folder]
    own = _number(capture)
    distances = [
        (abs(number - own), i) for i, (_, number) in enumerate(numbers) if number is not None and own is not None
    ]
    return [(0.0, numbers[min(distances)[1]][0])] if distances else []


def _number(capture: Capture) -> int | None:
    """The last number in the name of a capture."""
    found = re.findall(r"\d{1,9}", capture.name)
    return int(found[-1]) if found else None


def _interpolated(samples: list[tuple[float, float]]) -> float:
    """Interpolate (time, value) samples linearly at time 0; values at equal times are averaged."""
    times = sorted({t for t, _ in samples})
    return float(np.interp(0.0, times, [np.mean([v for t, v in samples if t == time]) for time in times]))


def _from_both_ends(flight: Sequence[Capture]) -> tuple[list[Capture], list[Capture]]:
    """Return the first half of a flight and the reversed second half: by time, or as given if one is unknown."""
    times = [t for c in flight if (t := c.time_s) is not None]
    ordered = [flight[i] for i in np.argsort(times, kind="stable")] if len(times) == len(flight) else list(flight)
    middle = (len(ordered) + 1) // 2
    return ordered[:middle], ordered[middle:][::-1]


def _captures_of_panels(half: Sequence[Capture], without_code: bool, examine: Examine) -> list[Capture]:
    """Return the captures with a panel, searched until several captures in a row contain none."""
    max_without_panel = 3  # panels are recorded before and after a flight
    result: list[Capture] = []
    without_panel = 0
    for capture in half:
        # Mosaics contain no panels and take long to read.
        is_known = capture.panel is not None or capture.reference.georeference is not None
        examined = capture if is_known else examine(_with_detected_panel, capture, without_code) or capture
        without_panel = 0 if examined.panel is not None else without_panel + 1
        result += [examined] if examined.panel is not None else []
        if without_panel == max_without_panel:
            break
    return result


def _with_detected_panel(capture: Capture, without_code: bool) -> Capture:
    detected = _detect(capture.reference, without_code=without_code)
    # Without a code, a small square far from the image centre may be a roof or a sheet.
    if detected is None or (detected.in_scene and not detected.code):
        return capture
    areas = [_detect(b, without_code=True) for b in capture.bands]
    # The code may be readable in one band only; it is valid for all.
    code = next((d.code for d in areas if d is not None and d.code), "")
    source: PanelSource = "QR code" if code else "look"
    bands = []
    for band, area in zip(capture.bands, areas, strict=True):
        albedo, serial = albedo_of(code, band.wavelength_nm), code.partition("_")[0]
        panel = None if area is None else Panel(source, serial, albedo, area.area_px, detected.in_scene)
        bands.append(replace(band, panel=panel))
    return replace(capture, bands=tuple(bands))


def _detect(band: Band, *, without_code: bool) -> DetectedPanel | None:
    """Detect the panel in a band; positions are px of the file. None without a panel or if the file is unreadable."""
    longest_side_px = 1600  # of the image in which the panel is searched
    try:
        image = read_for_alignment(band, longest_side_px)
    except AgalignError:
        return None
    result = find_panel(replace(image, lens=None), without_code=without_code)
    if result is None or not result.area_px:
        return result
    in_file_px = PixelScale.between(band.size_px, image.size_px).inverse.positions(result.area_px)
    return replace(result, area_px=tuple((x, y) for x, y in in_file_px.tolist()))


def _read(band: Band, albedos: Albedos) -> BandReading:
    panel, problem = band.panel, "it was not found in this band"
    if panel is not None and not panel.corners_px:
        # Firmware that recognises a panel does not always write its position.
        detected = _detect(band, without_code=True)
        panel = panel if detected is None else replace(panel, corners_px=detected.area_px)
        if detected is not None and detected.is_ambiguous:
            problem = "several squares of different brightness may be the panel; none is used"
        band = replace(band, panel=panel)
    albedo = albedos.get(band_key(band.name), albedos.get("", None if panel is None else panel.albedo))
    if panel is None or not panel.corners_px:
        return BandReading(band, albedo, problem=problem)
    try:
        radiance, problem, spread = _radiance(band, panel)
        return BandReading(band, albedo, radiance, problem, spread)
    except AgalignError as error:
        return BandReading(band, albedo, problem=str(error))


def _radiance(band: Band, panel: Panel) -> tuple[float | None, str, float]:
    """Return the mean radiance over the evenly lit part of the panel, why it cannot be used, empty if it can, and the
    standard deviation relative to the mean. None without calibration.
    """
    pixels, valid = read_tile(band, Tile(0, 0, *band.size_px))
    within = inside(panel.corners_px, pixels.shape) & valid
    if not within.any() or band.radiometry is None or not band.radiometry.is_of_light:
        return None, "", 0.0
    saturation = np.inf if band.saturation_value is None else band.saturation_value
    saturated = float((pixels[within].astype(np.float64) >= saturation).mean())
    image, max_saturated = calibrated(pixels, band.radiometry, 0, 0), 0.01  # share; they bias the mean radiance
    values = image[within].astype(np.float64)
    spread = float(values.std() / max(abs(float(np.median(values))), 1e-30))
    if saturated > max_saturated:
        return float(values.mean()), f"{saturated:.0%} of it is saturated", spread
    if not np.median(values) > 0:
        return float(values.mean()), "it is black", spread
    lit = evenly_lit(image, within)
    if not lit.any():
        problem = f"its pixels vary by {spread:.0%}: it is shaded, soiled or not in the area"
        return float(values.mean()), problem, spread
    mean = float(image[lit].mean(dtype=np.float64))
    return mean, "", float(image[lit].std(dtype=np.float64)) / mean
