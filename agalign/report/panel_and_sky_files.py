"""Writes the captures of calibration panels and of the sky, with a picture of each panel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from agalign.errors import UnreadableFileError
from agalign.flight.footprint import accuracy_of_footprint_m, footprint
from agalign.flight.panel_readings import BandReading, PanelReading
from agalign.flight.sky import SkyCapture, sky_radiance
from agalign.host.files import PANELS_FILE, SKY_FILE, check_inside, write_model
from agalign.pixels.raster import read_preview
from agalign.rasters.drawing import Picture, side_by_side, titled, write_png
from agalign.records.panels_and_sky import PanelPart, PanelsFile, SkyFile, SkyPart
from agalign.values.capture import Capture, source_file
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import PixelScale


def panel_picture(label: str, out: Path) -> Path:
    """Return the path of the picture of a panel. Raises OutputError for a link that leads out of the folder."""
    return check_inside(out / f"{label}.panel.png", out)


def write_panels(readings: Sequence[PanelReading], out: Path, others: Sequence[PanelPart] = ()) -> list[PanelPart]:
    """Write OUT/panels.json and <capture>.panel.png, and return the captures; without any, remove an earlier file.

    The file also has `others`, those of other input folders. Raises OutputError.
    """
    parts = []
    for reading in readings:
        picture = panel_picture(reading.capture.label, out)
        write_png(side_by_side([_tile(b) for b in reading.bands], gap_px=6), picture)
        panel, scales = reading.panel, reading.sensor_scales
        bands = [_panel_band(b, reading.capture) | {"sensor_scale": scales.get(b.band.name)} for b in reading.bands]
        facts = {"seen_by": panel.seen_by, "serial": panel.serial, "in_scene": panel.in_scene, "cues": panel.cues}
        facts |= {"sensor_scale": float(np.median([*scales.values()])) if scales else None}
        facts |= {"fits_sensor": reading.fits_sensor, "bands": bands}
        facts |= {"brighter": reading.brighter, "light_ratio": reading.light_ratio, "is_used": reading.is_lit}
        facts |= _identity(reading.capture) | {"picture": picture.relative_to(out).as_posix()}
        parts.append(PanelPart.model_validate(facts))
    write_model(out / PANELS_FILE, PanelsFile(panels=[*others, *parts]) if others or parts else None)
    return parts


def write_sky(sky: Sequence[SkyCapture], out: Path, others: Sequence[SkyPart] = ()) -> list[SkyPart]:
    """Write OUT/sky.json and return the captures; without any, remove that of an earlier run.

    The file also has `others`, those of other input folders. Raises OutputError.
    """
    parts = []
    for one in sky:
        shown = one.capture
        bands = [{"band": b.name, "file": source_file(shown, b), "radiance": sky_radiance(b)} for b in shown.bands]
        parts.append(SkyPart.model_validate(_identity(shown) | {"cues": one.cues, "bands": bands}))
    write_model(out / SKY_FILE, SkyFile(captures=[*others, *parts]) if others or parts else None)
    return parts


def _identity(capture: Capture) -> dict[str, Any]:
    """The facts about a capture. Its footprint is for a known height only: panels are photographed from 1 m, and the
    sky is not on the ground.
    """
    ring = footprint(capture, OutputGrid(0, 0, *capture.reference.size_px))
    return {
        "folder": capture.folder.as_posix(),
        "capture": capture.name,
        "captured_at": capture.known_time,
        "camera": capture.camera,
        "position": capture.position,
        "pose": capture.pose,
        "footprint": None if ring is None else [(x, y) for x, y in ring[::-1].tolist()],
        "footprint_accuracy_m": None if ring is None else accuracy_of_footprint_m(capture),
    }


def _panel_band(reading: BandReading, capture: Capture) -> dict[str, Any]:
    band, factor = reading.band, reading.factor
    return {
        "band": band.name,
        "file": source_file(capture, band),
        "area_px": [] if band.panel is None else [(round(x, 2), round(y, 2)) for x, y in band.panel.corners_px],
        "albedo": reading.albedo,
        "radiance": reading.radiance,
        "reflectance_per_radiance": factor,
        "other_albedo": reading.other_albedo,
        "problem": reading.problem or (None if factor is not None else "its reflectance or the band's is not known"),
    }


def _tile(reading: BandReading) -> Picture:
    """A band with its name, the albedo and the measured area; black if its pixels cannot be read."""
    band = reading.band
    scale = 320 / band.width_px
    size = 320, max(1, round(band.height_px * scale))
    title = f"{band.name}: " + ("?" if reading.albedo is None else f"{reading.albedo:.3f}")
    try:
        pixels = read_preview(band.path, band.index_in_page, (0, 0, *band.size_px), size, band.page)
    except UnreadableFileError:
        pixels, title = np.full((size[1], size[0]), np.nan), f"{band.name}: cannot be read"
    # A few hot pixels must not determine the contrast.
    low, high = np.nanpercentile(pixels, (1.0, 99.5)) if np.isfinite(pixels).any() else (0.0, 1.0)
    grey = np.clip(np.nan_to_num((pixels - low) / max(high - low, 1e-9)), 0, 1) * 255
    image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
    if band.panel is not None and band.panel.corners_px:
        corners = PixelScale(scale, scale).positions(band.panel.corners_px).round().astype(np.int32)
        cv2.polylines(image, [corners], isClosed=True, color=(255, 64, 32), thickness=2, lineType=cv2.LINE_AA)
    return titled(image, title, height_px=24)
