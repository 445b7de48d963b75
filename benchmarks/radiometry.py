"""Radiance, irradiance and reflectance against the formulas that MicaSense publishes, and between overlapping captures.

python benchmarks/radiometry.py FOLDER

The formulas of github.com/micasense/imageprocessing are written here again: image.py, dls.py, and the tutorials on
panels and the light sensor. The position of the sun is that of agalign, which a test compares with NREL's example.
Every capture of a MicaSense camera below FOLDER is used. A panel is compared with the captures of its camera, also
where agalign does not combine it with the light sensor. The last table compares the expected error with the difference
of two sources: overlapping captures, also of a Phantom 4, and a panel and the light sensor beside it.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from common import cell, print_head, print_row, read_band, run
from scipy.spatial.transform import Rotation

from agalign.cameras.discover import discover
from agalign.cameras.dls import horizontal_irradiance
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.sun import sun_position
from agalign.flight import panel_readings
from agalign.flight.groups import camera_key
from agalign.pixels.radiometry import calibrated, with_radiometry
from agalign.values.capture import Band, Capture, CaptureTime
from agalign.values.radiometric_errors import panel_errors
from agalign.values.radiometry import total_percent

CAMERA, DLS, PIX4D = "micasense.com/MicaSense", "micasense.com/DLS", "pix4d.com"
MIN_TIES, MAX_RATIO, MAX_ERROR_PX = 20, 0.8, 3.0
PATCH_PX = 31
"""Radiance is averaged over squares, because ties are accurate to a pixel."""
Image = np.ndarray


# ---- the published formulas


def published_radiance(raw: Image, tags: Tags) -> Image:
    a1, a2, a3 = tags.numbers(CAMERA, "RadiometricCalibration")
    centre, k = tags.numbers(PIX4D, "VignettingCenter"), tags.numbers(PIX4D, "VignettingPolynomial")
    exposure_s, gain = tags.exif["ExposureTime"], tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")) / 100
    y, x = np.mgrid[: raw.shape[0], : raw.shape[1]]
    vignette = 1 / np.polyval([*k[::-1], 1.0], np.hypot(x - centre[0], y - centre[1]))
    by_row = 1 / (1 + a2 * y / exposure_s - a3 * y)
    return vignette * by_row * (raw - tags.black_level) / (gain * exposure_s) * a1 / 2**16


def published_irradiance(tags: Tags) -> float:
    """Horizontal irradiance: HorizontalIrradiance of a DLS 2, else SpectralIrradiance by the model of the DLS 1."""
    horizontal, scale = tags.number(DLS, "HorizontalIrradiance"), tags.number(DLS, "IrradianceScaleToSIUnits")
    if horizontal is not None:
        return horizontal * (scale or 0.01)
    elevation, azimuth = sun_position(tags.position, CaptureTime.of(tags.captured_at).utc.timestamp())
    angle = phi = sensor_to_sun(tags, elevation, azimuth)
    light = tags.number(DLS, "SpectralIrradiance") * (scale or 1.0)
    for n1, n2 in ((1.000277, 1.6), (1.6, 1.38)):
        phi = np.arcsin(np.sin(phi) / n1)
        f1, f2 = np.cos(phi), np.sqrt(1 - (n1 / n2 * np.sin(phi)) ** 2)
        rs, rp = ((n1 * f1 - n2 * f2) / (n1 * f1 + n2 * f2)) ** 2, ((n1 * f2 - n2 * f1) / (n1 * f2 + n2 * f1)) ** 2
        light /= 1 - 0.5 * rs - 0.5 * rp
    direct = light / (1 / 6 + np.cos(angle))
    return float(direct * np.sin(elevation) + direct / 6)


def sensor_to_sun(tags: Tags, elevation: float, azimuth: float) -> float:
    """The angle between the axis of the light sensor and the sun, radians."""
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), -np.sin(elevation)])
    return float(np.arccos(sun @ Rotation.from_euler("ZYX", attitude(tags)).apply([0, 0, -1])))


def attitude(tags: Tags) -> list[float]:
    """(yaw, pitch, roll) of the light sensor, radians."""
    return [tags.number(DLS, name) or 0.0 for name in ("Yaw", "Pitch", "Roll")]


# ---- tables


def main(folder: Path) -> None:
    found = panel_readings.with_panels(discover(folder).captures)
    captures = [c for c in found if all(b.radiometry and b.radiometry.quantity == "radiance" for b in c.bands)]
    captures = [c for c in captures if all(b.radiometry.by_sun for b in c.bands)]
    # The formula of both is compared also for a shaded sensor.
    patch.object(panel_readings.PanelReading, "fits_sensor", new=True).start()
    readings = [panel_readings.read_panel(c, {}) for c in captures if c.panel is not None]
    print("Largest difference from the published formulas, relative to the median of the band:\n")
    print_head("captures", "camera", "radiance", "light sensor", "panel", "panel and light sensor")
    for one, group in itertools.groupby(captures, lambda c: c.reference.path.parent):
        first, *others = group
        errors = np.max([largest_differences(c, readings) for c in (first, *others)], axis=0)
        print_row(one.name, f"{first.camera.make} {first.camera.model}", *(cell([e], ".1e") for e in errors))
    print("\nLight in the plane of the sensor and after correction of its tilt, divided by the sensor's horizontal:\n")
    print_head("capture", "sensor to sun, degrees", "zenith angle of the sun", "measured", "corrected")
    for capture in captures:
        tags = read_tags(capture.reference.path)
        if tags.number(DLS, "HorizontalIrradiance") and attitude(tags)[0]:
            print_row(f"{capture.reference.path.parent.name} {capture.name}", *tilt_facts(tags))
    print("\nDifference of the reflectance by two sources, and its expected error (1 sigma), median of the bands:\n")
    print_head("sources", "bands", "difference", "expected", "within 1", "within 2")
    pairs = [*overlaps(folder), *((f"panel and sensor {r.capture.name}", panel_and_sensor(r)) for r in readings)]
    for name, (differences, expected) in pairs:
        ratios = np.abs(differences) / expected
        shares = (f"{(ratios <= limit).mean():.0%}" for limit in (1, 2))
        print_row(name, len(ratios), *(f"{np.median(np.abs(v)):.1%}" for v in (differences, expected)), *shares)
    every = np.concatenate([np.abs(d) / e for _, (d, e) in pairs])
    shares = " and ".join(f"{(every <= limit).mean():.0%} within {limit}" for limit in (1, 2))
    print(f"\n{len(every)} bands of {len(pairs)} pairs: {shares} expected errors")


def largest_differences(capture: Capture, readings: list[panel_readings.PanelReading]) -> Image:
    """Of radiance and reflectance by light sensor, panel, and both; nan without a panel of the camera."""
    without_sensor = tuple(replace(b, radiometry=replace(b.radiometry, by_sun=None)) for b in capture.bands)
    alone = panel_readings.reflectance_factors(replace(capture, bands=without_sensor), readings)
    both = panel_readings.reflectance_factors(capture, readings)
    ways = [with_radiometry(capture, *way) for way in (("camera", {}), ("sun", {}), ("panel", alone), ("panel", both))]
    panel = next((r.capture for r in readings if camera_key(r.capture) == camera_key(capture)), None)
    result = np.full((len(ways), len(capture.bands)), np.nan)
    for i, band in enumerate(capture.bands):
        tags, raw = read_tags(band.path), pixels(band)
        radiance, light = published_radiance(raw, tags), published_irradiance(tags)
        lights = [math.pi, light]
        if panel is not None:
            panel_light, at_panel = published_panel_light(panel.bands[i])
            lights += [panel_light, light * panel_light / at_panel]
        for way, irradiance in enumerate(lights):
            theirs, ours = radiance * math.pi / irradiance, calibrated(raw, ways[way].bands[i].radiometry, 0, 0)
            result[way, i] = np.abs(ours - theirs).max() / np.median(theirs)
    return result.max(axis=1)


def published_panel_light(band: Band) -> tuple[float, float]:
    """The irradiance on a panel, and by the light sensor at that time."""
    tags, area = read_tags(band.path), np.zeros(band.size_px[::-1], np.uint8)
    cv2.fillPoly(area, [np.reshape(tags.numbers(PIX4D, "ReflectArea"), (4, 2)).round().astype(np.int32)], 1)
    radiance = published_radiance(pixels(band), tags)[area > 0].mean()
    return math.pi * radiance / tags.number(PIX4D, "Albedo"), published_irradiance(tags)


def tilt_facts(tags: Tags) -> tuple[str, ...]:
    """Angles, and the measured and the corrected irradiance relative to HorizontalIrradiance."""
    sun = sun_position(tags.position, CaptureTime.of(tags.captured_at).utc.timestamp())
    horizontal, measured = (tags.number(DLS, f"{name}Irradiance") for name in ("Horizontal", "Spectral"))
    corrected = horizontal_irradiance(measured, tuple(np.degrees(attitude(tags))), sun)
    angles = math.degrees(sensor_to_sun(tags, *sun)), 90 - math.degrees(sun[0])
    return *(f"{v:.1f}" for v in angles), *(f"{v / horizontal:.2f}" for v in (measured, corrected))


Compared = tuple[Image, Image]
"""Logarithmic differences (bands,) and their expected errors."""
SHARED = {"factory calibration", "light sensor", "vignetting"}
"""Errors that captures of one camera have in common."""


def overlaps(folder: Path) -> list[tuple[str, Compared]]:
    """Each pair of captures of a camera that show the same ground: reflectance by the light sensor."""
    found = [c for c in discover(folder).captures if all(b.radiometry and b.radiometry.by_sun for b in c.bands)]
    result = []
    for a, b in itertools.combinations([c for c in found if c.panel is None], 2):
        if camera_key(a) == camera_key(b):
            facts = [f for x, y in zip(a.bands, b.bands, strict=True) if (f := difference(x, y)) is not None]
            result += [(f"{a.label} {b.label}", tuple(np.array(facts).T))] if facts else []
    return result


def difference(a: Band, b: Band) -> tuple[float, float] | None:
    """(median logarithmic difference of two bands over the ground that both show, expected error); None without any."""
    images = [calibrated(pixels(x), x.radiometry, 0, 0) * x.radiometry.by_sun.value for x in (a, b)]
    keypoints = [keypoints_of(image) for image in images]
    pairs = cv2.BFMatcher().knnMatch(keypoints[0][1], keypoints[1][1], 2)
    ties = [m for m, other in pairs if m.distance < MAX_RATIO * other.distance]
    if len(ties) < MIN_TIES:
        return None
    sides = zip(keypoints, ("queryIdx", "trainIdx"), strict=True)
    at = [np.float32([points[getattr(m, index)].pt for m in ties]) for (points, _), index in sides]
    homography, inliers = cv2.findHomography(*at, cv2.USAC_MAGSAC, MAX_ERROR_PX)
    if homography is None or inliers.sum() < MIN_TIES:
        return None
    smooth, size_px = [cv2.blur(image, (PATCH_PX, PATCH_PX)) for image in images], b.size_px
    lit = [(pixels(x) < 0.99 * pixels(x).max()).astype(np.float32) for x in (a, b)]
    on_b, lit_on_b = (cv2.warpPerspective(x, homography, size_px, borderValue=math.nan) for x in (smooth[0], lit[0]))
    common = (on_b > 0) & (smooth[1] > 0) & (lit_on_b > 0.99) & (lit[1] > 0)
    own = [e for x in (a, b) for e in x.radiometry.by_sun.errors if e.name not in SHARED]
    return float(np.median(np.log(on_b[common] / smooth[1][common]))), total_percent(own) / 100


def keypoints_of(image: Image) -> tuple[Sequence[cv2.KeyPoint], Image]:
    low, high = np.percentile(image, (1, 99))
    grey = np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    return cv2.SIFT_create(4000).detectAndCompute(grey, None)


def panel_and_sensor(reading: panel_readings.PanelReading) -> Compared:
    """The scale of the light sensor by a panel, and the expected error of the reflectance by each."""
    bands = [b for b in reading.bands if b.sensor_scale]
    of_panel = [panel_errors(b.spread, None) for b in bands]
    of_sensor = [(*b.band.radiometry.errors, *b.band.radiometry.by_sun.errors) for b in bands]
    expected = [total_percent((*a, *b)) / 100 for a, b in zip(of_panel, of_sensor, strict=True)]
    return np.log([b.sensor_scale for b in bands]), np.array(expected)


def pixels(band: Band) -> Image:
    return read_band(band.path).astype(np.float64)


if __name__ == "__main__":
    run(main)
