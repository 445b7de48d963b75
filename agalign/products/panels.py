"""OUT/panels.json with the measurements on calibration panels, and a picture of each panel with the measured area."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from agalign.flight.panels import BandReading, PanelReading
from agalign.pixels.raster import read_preview
from agalign.products.drawing import Picture, with_text, write_png
from agalign.products.json_file import read_model, write_model
from agalign.values.capture import PanelSource
from agalign.values.pixel_units import PixelScale

PANELS_FILE = "panels.json"
_TILE_PX, _TITLE_PX, _GAP_PX = 320, 24, 6
"""Width of a band in the picture, height of its title, distance to the next band."""
_PERCENTILES = 1.0, 99.5
"""Limits of the contrast: a few hot pixels must not determine it."""
_AREA_COLOUR = 255, 64, 32


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PanelBandPart(_Part):
    """Measurement on the panel in one band."""

    band: str
    file: str
    area_px: list[tuple[float, float]]
    """Corners (x, y) of the measured area, raw pixels of the file."""
    albedo: float | None
    """Reflectance of the panel, 0 to 1."""
    radiance: float | None
    """Mean over the area, in the unit of the camera's calibration."""
    reflectance_per_radiance: float | None
    problem: str | None
    """Reason why the band cannot be used."""


class PanelPart(_Part):
    """One capture of a panel."""

    folder: str
    capture: str
    captured_at: str
    seen_by: PanelSource
    serial: str
    picture: str
    in_scene: bool = False
    """The capture shows a scene that contains the panel, and is aligned."""
    bands: list[PanelBandPart]

    @property
    def sentence(self) -> str:
        """Describe the capture for the summary and the report."""
        albedos = sorted({f"{b.albedo:.2f}" for b in self.bands if b.albedo is not None})
        # The smallest and the largest value, or the only one.
        reflectance = " to ".join(dict.fromkeys((albedos[0], albedos[-1]))) if albedos else "not known"
        name = f"calibration panel {self.serial}".strip()
        use = "part of a scene that is aligned" if self.in_scene else "not aligned"
        return f"{name} (reflectance {reflectance}; recognised by its {self.seen_by}): {use}"


class PanelsFile(_Part):
    """All captures of panels of a run."""

    schema_: Annotated[Literal["agalign-panels/1"], Field(alias="schema")] = "agalign-panels/1"
    panels: list[PanelPart]


def write_panels(readings: Sequence[PanelReading], out: Path) -> list[PanelPart]:
    """Write OUT/panels.json and <capture>.panel.png; without panels, remove the panels.json of an earlier run.

    Raises OutputError.
    """
    path = out / PANELS_FILE
    if not readings:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return []
    parts = []
    for reading in readings:
        capture = reading.capture
        picture = out / capture.folder / f"{capture.name}.panel.png"
        write_png(_sheet(reading), picture)
        parts.append(
            PanelPart(
                folder=capture.folder.as_posix(), capture=capture.name, captured_at=capture.captured_at,
                seen_by=reading.panel.seen_by, serial=reading.panel.serial, picture=picture.relative_to(out).as_posix(),
                in_scene=reading.panel.in_scene,
                bands=[_band_part(b) for b in reading.bands],
            )
        )  # fmt: skip
    write_model(path, PanelsFile(panels=parts))
    return parts


def read_panels(out: Path) -> list[PanelPart]:
    """Return the captures of panels of an earlier run. Raises SidecarError for a file that agalign did not write."""
    file = read_model(out / PANELS_FILE, PanelsFile)
    return [] if file is None else file.panels


def _band_part(reading: BandReading) -> PanelBandPart:
    panel, factor = reading.band.panel, reading.factor
    return PanelBandPart(
        band=reading.band.name, file=reading.band.path.name,
        area_px=[] if panel is None else [(round(x, 2), round(y, 2)) for x, y in panel.corners_px],
        albedo=reading.albedo, radiance=reading.radiance, reflectance_per_radiance=factor,
        problem=reading.problem or (None if factor is not None else "its reflectance or the band's is not known"),
    )  # fmt: skip


def _sheet(reading: PanelReading) -> Picture:
    """All bands next to each other, with the measured area."""
    tiles = [_tile(b) for b in reading.bands]
    height = max(t.shape[0] for t in tiles)
    gap = np.full((height, _GAP_PX, 3), 255, np.uint8)
    columns = [np.pad(t, ((0, height - t.shape[0]), (0, 0), (0, 0)), constant_values=255) for t in tiles]
    return np.hstack([part for column in columns for part in (column, gap)][:-1])


def _tile(reading: BandReading) -> Picture:
    band = reading.band
    scale = _TILE_PX / band.width_px
    size = _TILE_PX, max(1, round(band.height_px * scale))
    pixels = read_preview(band.path, band.band_index, (0, 0, *band.size_px), size)
    low, high = np.nanpercentile(pixels, _PERCENTILES) if np.isfinite(pixels).any() else (0.0, 1.0)
    grey = np.clip(np.nan_to_num((pixels - low) / max(high - low, 1e-9)), 0, 1) * 255
    image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
    if band.panel is not None and band.panel.corners_px:
        corners = PixelScale(scale, scale).positions(band.panel.corners_px).round().astype(np.int32)
        cv2.polylines(image, [corners], isClosed=True, color=_AREA_COLOUR, thickness=2, lineType=cv2.LINE_AA)
    title = f"{band.name}: " + ("?" if reading.albedo is None else f"{reading.albedo:.3f}")
    strip = np.full((_TITLE_PX, _TILE_PX, 3), 255, np.uint8)
    return np.vstack([with_text(strip, title, (2, 17)), image])
