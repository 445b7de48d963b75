"""Captures of calibration panels and of the sky: OUT/panels.json, OUT/sky.json and a picture of each panel."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from agalign.errors import AgalignError
from agalign.flight.panel_readings import BandReading, PanelReading
from agalign.flight.sky import SkyCapture, sky_radiance
from agalign.pixels.raster import read_preview
from agalign.products.report.drawing import Picture, side_by_side, titled, write_png
from agalign.values.capture import Band, Capture, PanelSource, source_file
from agalign.values.fields import Message, Name, SourceFile
from agalign.values.files import check_inside, read_model, write_model
from agalign.values.pixel_units import PixelScale

PANELS_FILE, SKY_FILE = "panels.json", "sky.json"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PanelBandPart(_Part):
    """Measurement on the panel in one band."""

    band: Name
    file: SourceFile
    """Image file, relative to the input folder that the run record names."""
    area_px: list[tuple[float, float]]
    """Corners (x, y) of the measured area, raw pixels of the file."""
    albedo: float | None
    """Reflectance of the panel, 0 to 1."""
    radiance: float | None
    """Mean over the area, in the unit of the camera's calibration."""
    reflectance_per_radiance: float | None
    sensor_scale: float | None = None
    """Irradiance on the panel divided by that of the light sensor."""
    problem: Message | None
    """Reason why the band cannot be used."""


class SkyBandPart(_Part):
    """One band of a capture of the sky."""

    band: Name
    file: SourceFile
    """Image file, relative to the input folder that the run record names."""
    radiance: float | None
    """Median over the image, W / m^2 / sr / nm; null if it is unknown or half of the band is saturated."""


class _CapturePart(_Part):
    folder: str
    capture: str
    captured_at: Name

    @property
    def is_left_out(self) -> bool:
        """True if the capture is not aligned."""
        return True


class PanelPart(_CapturePart):
    """One capture of a panel."""

    seen_by: PanelSource
    serial: Name
    picture: str
    in_scene: bool = False
    """The capture shows a scene that contains the panel, or only one cue indicates it: it is aligned."""
    cues: list[Name] = []
    """Evidence that the capture shows a panel, in words."""
    sensor_scale: float | None = None
    """Irradiance on the panel divided by that of the light sensor, the median of the bands."""
    fits_sensor: bool = True
    """False if the scale or its range over the bands is implausible; panels are then not combined with the sensor."""
    bands: list[PanelBandPart]

    @property
    def is_left_out(self) -> bool:
        """True if the capture is not aligned."""
        return not self.in_scene

    @property
    def sentence(self) -> str:
        """Describe the capture for the summary and the report."""
        albedos = sorted({f"{b.albedo:.2f}" for b in self.bands if b.albedo is not None})
        # The smallest and the largest value, or the only one.
        reflectance = " to ".join(dict.fromkeys((albedos[0], albedos[-1]))) if albedos else "not known"
        name = f"calibration panel {self.serial}".strip()
        use = "aligned, as it shows a scene or by one cue only" if self.in_scene else "not aligned"
        recognised = ", ".join(self.cues) or self.seen_by
        scale = self.sensor_scale
        sensor = "" if scale is None else f"; irradiance {scale:.2f} times that of the light sensor"
        if not self.fits_sensor:
            by_band = sorted((b.sensor_scale, b.band) for b in self.bands if b.sensor_scale)
            extremes = " to ".join(f"{value:.2f} in {band}" for value, band in by_band[:: max(1, len(by_band) - 1)])
            sensor += f"{extremes and f' ({extremes})'}, which was in other light or is wrong in a band: "
            sensor += "--radiometry auto uses the sensor alone, panel the panels alone"
        refused = {b.problem: [o.band for o in self.bands if o.problem == b.problem] for b in self.bands if b.problem}
        unused = "".join(f"; not used in {', '.join(bands)}: {why}" for why, bands in refused.items() if albedos)
        return f"{name} (reflectance {reflectance}; recognised by {recognised}): {use}{sensor}{unused}"


class SkyPart(_CapturePart):
    """One capture of the sky."""

    cues: list[Name]
    """Evidence that the capture shows the sky, in words."""
    bands: list[SkyBandPart]

    @property
    def sentence(self) -> str:
        """State in words why the capture is not aligned."""
        return f"shows the sky ({', '.join(self.cues)}): not aligned"


class PanelsFile(_Part):
    """All captures of panels of a run."""

    schema_: Annotated[Literal["agalign-panels/1"], Field(alias="schema")] = "agalign-panels/1"
    panels: list[PanelPart]


class SkyFile(_Part):
    """All captures of the sky of a run."""

    schema_: Annotated[Literal["agalign-sky/1"], Field(alias="schema")] = "agalign-sky/1"
    captures: list[SkyPart]


def write_panels(readings: Sequence[PanelReading], out: Path) -> list[PanelPart]:
    """Write OUT/panels.json and <capture>.panel.png, and return the captures; without any, remove an earlier file.

    Raises OutputError.
    """
    parts = []
    for reading in readings:
        picture = check_inside(out / reading.capture.folder, out) / f"{reading.capture.name}.panel.png"
        write_png(side_by_side([_tile(b) for b in reading.bands], gap_px=6), picture)
        panel, scales = reading.panel, reading.sensor_scales
        bands = [_panel_band(b, reading.capture) | {"sensor_scale": scales.get(b.band.name)} for b in reading.bands]
        facts = {"seen_by": panel.seen_by, "serial": panel.serial, "in_scene": panel.in_scene, "cues": panel.cues}
        facts |= {"sensor_scale": float(np.median([*scales.values()])) if scales else None}
        facts |= {"fits_sensor": reading.fits_sensor, "bands": bands}
        facts |= _identity(reading.capture) | {"picture": picture.relative_to(out).as_posix()}
        parts.append(PanelPart.model_validate(facts))
    write_model(out / PANELS_FILE, PanelsFile(panels=parts) if parts else None)
    return parts


def write_sky(sky: Sequence[SkyCapture], out: Path) -> list[SkyPart]:
    """Write OUT/sky.json and return its captures; without any, remove that of an earlier run. Raises OutputError."""
    parts = []
    for one in sky:
        bands = [
            {"band": b.name, "file": source_file(one.capture, b), "radiance": _radiance(b)} for b in one.capture.bands
        ]
        parts.append(SkyPart.model_validate(_identity(one.capture) | {"cues": one.cues, "bands": bands}))
    write_model(out / SKY_FILE, SkyFile(captures=parts) if parts else None)
    return parts


def read_excluded(out: Path) -> tuple[list[PanelPart], list[SkyPart]]:
    """Return the captures of panels and those of the sky of an earlier run.

    Raises SidecarError for a file that agalign did not write.
    """
    panels, sky = read_model(out / PANELS_FILE, PanelsFile), read_model(out / SKY_FILE, SkyFile)
    return ([] if panels is None else panels.panels), ([] if sky is None else sky.captures)


def _identity(capture: Capture) -> dict[str, Any]:
    return {"folder": capture.folder.as_posix(), "capture": capture.name, "captured_at": capture.known_time}


def _panel_band(reading: BandReading, capture: Capture) -> dict[str, Any]:
    band, factor = reading.band, reading.factor
    return {
        "band": band.name,
        "file": source_file(capture, band),
        "area_px": [] if band.panel is None else [(round(x, 2), round(y, 2)) for x, y in band.panel.corners_px],
        "albedo": reading.albedo,
        "radiance": reading.radiance,
        "reflectance_per_radiance": factor,
        "problem": reading.problem or (None if factor is not None else "its reflectance or the band's is not known"),
    }


def _radiance(band: Band) -> float | None:
    with suppress(AgalignError):
        return sky_radiance(band)
    return None


def _tile(reading: BandReading) -> Picture:
    """A band with its name, the albedo and the measured area."""
    band = reading.band
    scale = 320 / band.width_px
    size = 320, max(1, round(band.height_px * scale))
    pixels = read_preview(band.path, band.index_in_page, (0, 0, *band.size_px), size, band.page)
    # A few hot pixels must not determine the contrast.
    low, high = np.nanpercentile(pixels, (1.0, 99.5)) if np.isfinite(pixels).any() else (0.0, 1.0)
    grey = np.clip(np.nan_to_num((pixels - low) / max(high - low, 1e-9)), 0, 1) * 255
    image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
    if band.panel is not None and band.panel.corners_px:
        corners = PixelScale(scale, scale).positions(band.panel.corners_px).round().astype(np.int32)
        cv2.polylines(image, [corners], isClosed=True, color=(255, 64, 32), thickness=2, lineType=cv2.LINE_AA)
    title = f"{band.name}: " + ("?" if reading.albedo is None else f"{reading.albedo:.3f}")
    return titled(image, title, height_px=24)
