"""Captures of calibration panels and of the sky: OUT/panels.json and OUT/sky.json."""

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from agalign.errors import SidecarError
from agalign.host.files import PANELS_FILE, SKY_FILE, read_model
from agalign.host.text import counted
from agalign.values.capture import CameraIdentity, PanelSource, Pose, Position
from agalign.values.fields import Message, Name, SourceFile


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
    other_albedo: float | None = None
    """Reflectance of the panel of this serial number by another capture, if it contradicts `albedo`."""


class SkyBandPart(_Part):
    """One band of a capture of the sky."""

    band: Name
    file: SourceFile
    """Image file, relative to the input folder that the run record names."""
    radiance: float | None
    """Median over the image, W / m^2 / sr / nm; null if it is unknown or half of the band is saturated."""


class PanelOrSkyPart(_Part):
    """A capture of a panel or of the sky."""

    kind: ClassVar[str]
    """What the capture shows, as its status in tables and maps."""
    folder: str
    capture: str
    captured_at: Name
    camera: CameraIdentity = CameraIdentity()
    position: Position | None = None
    pose: Pose | None = None
    footprint: list[tuple[float, float]] | None = None
    """Longitude and latitude, degrees, of the corners of the image."""
    footprint_accuracy_m: float | None = None
    cues: list[Name] = []
    """Independent evidence for what the capture shows, in words."""

    @property
    def label(self) -> str:
        """Folder and name of the capture, relative to the input."""
        return Path(self.folder, self.capture).as_posix()

    @property
    def is_left_out(self) -> bool:
        """True if the capture is not aligned."""
        return True


class PanelPart(PanelOrSkyPart):
    """One capture of a panel."""

    kind = "panel"
    seen_by: PanelSource
    serial: Name
    picture: str
    in_scene: bool = False
    """The capture shows a scene that contains the panel, or only one cue indicates it: it is aligned."""
    sensor_scale: float | None = None
    """Irradiance on the panel divided by that of the light sensor, the median of the bands."""
    fits_sensor: bool = True
    """False if the scale or its range over the bands is implausible; panels are then not combined with the sensor."""
    brighter: Name = ""
    """Capture of a panel within the hour with more light than the light can have changed."""
    light_ratio: float = 1.0
    """Light on this panel relative to that on the brighter one."""
    is_used: bool = True
    """False for a panel in shade."""
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
        sensor += self._contradictions
        refused = {b.problem: [o.band for o in self.bands if o.problem == b.problem] for b in self.bands if b.problem}
        unused = "".join(f"; not used in {', '.join(bands)}: {why}" for why, bands in refused.items() if albedos)
        return f"{name} (reflectance {reflectance}; recognised by {recognised}): {use}{sensor}{unused}"

    @property
    def _contradictions(self) -> str:
        """What other captures of panels contradict."""
        text = ""
        if self.brighter:
            text = (
                f"; the light on it is {self.light_ratio:.2f} times that on the panel in {self.brighter}, within the "
            )
            text += "hour: " + (
                "it was wet, soiled or below a cloud" if self.is_used else "it was in shade, and is not used"
            )
            text += f"; with it alone, reflectance would be {1 / self.light_ratio:.2f} times as large"
        for band in [b for b in self.bands if b.other_albedo is not None][:1]:
            text += f"; the reflectance of the panel in {band.band} is {band.albedo:.3f} here and "
            text += f"{band.other_albedo:.3f} by another capture of this serial number"
        return text


class SkyPart(PanelOrSkyPart):
    """One capture of the sky."""

    kind = "sky"
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


PANEL_AND_SKY_FILES = {PANELS_FILE: b'{\n "schema": "agalign-panels/', SKY_FILE: b'{\n "schema": "agalign-sky/'}
"""How each of the two files starts, by name."""


def read_panels(out: Path) -> list[PanelPart]:
    """Return the captures of panels of an earlier run. Raises SidecarError for a file that agalign did not write."""
    file = read_model(out / PANELS_FILE, PanelsFile)
    return [] if file is None else file.panels


def read_sky(out: Path) -> list[SkyPart]:
    """Return the captures of the sky of an earlier run. Raises SidecarError for a file that agalign did not write."""
    file = read_model(out / SKY_FILE, SkyFile)
    return [] if file is None else file.captures


def last_panels_and_sky(out: Path) -> tuple[list[PanelPart], list[SkyPart]]:
    """Return the captures of panels and those of the sky; none of a file that cannot be read, which the commands that
    need it name.
    """
    panels, sky = list[PanelPart](), list[SkyPart]()
    with suppress(SidecarError):
        panels = read_panels(out)
    with suppress(SidecarError):
        sky = read_sky(out)
    return panels, sky


def exclusions(parts: Iterable[PanelOrSkyPart]) -> list[str]:
    """Return a line for each kind of captures that are not aligned: their number, and that of those with each cue."""
    lines, left_out = [], [part for part in parts if part.is_left_out]
    for kind, shows in (("panel", "a calibration panel"), ("sky", "the sky")):
        of_kind = [part for part in left_out if part.kind == kind]
        counts = Counter(cue for part in of_kind for cue in part.cues)
        if of_kind:
            evidence = ", ".join(f"{cue} ({number})" for cue, number in counts.items())
            lines.append(f"Left out: {counted(len(of_kind), 'capture')} of {shows}, by {evidence}")
    return lines
