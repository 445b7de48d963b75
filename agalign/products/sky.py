"""OUT/sky.json: the captures of the sky, which a run does not align, and the radiance of each band."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from agalign.errors import AgalignError
from agalign.flight.sky import SkyCapture, sky_radiance
from agalign.products.json_file import read_model, write_model
from agalign.values.capture import Band

SKY_FILE = "sky.json"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SkyBandPart(_Part):
    """One band of a capture of the sky."""

    band: str
    file: str
    radiance: float | None
    """Median over the image, W / m^2 / sr / nm; null if it is unknown or half of the band is saturated."""


class SkyPart(_Part):
    """One capture of the sky."""

    folder: str
    capture: str
    captured_at: str
    cues: list[str]
    """Evidence that the capture shows the sky, in words."""
    bands: list[SkyBandPart]

    @property
    def sentence(self) -> str:
        """State in words why the capture is not aligned."""
        return f"shows the sky ({', '.join(self.cues)}): not aligned"


class SkyFile(_Part):
    """All captures of the sky of a run."""

    schema_: Annotated[Literal["agalign-sky/1"], Field(alias="schema")] = "agalign-sky/1"
    captures: list[SkyPart]


def write_sky(sky: Sequence[SkyCapture], out: Path) -> list[SkyPart]:
    """Write OUT/sky.json; without captures of the sky, remove that of an earlier run. Raises OutputError."""
    path = out / SKY_FILE
    if not sky:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return []
    parts = [
        SkyPart(
            folder=s.capture.folder.as_posix(), capture=s.capture.name, captured_at=s.capture.captured_at,
            cues=list(s.cues),
            bands=[SkyBandPart(band=b.name, file=b.path.name, radiance=_radiance(b)) for b in s.capture.bands],
        )
        for s in sky
    ]  # fmt: skip
    write_model(path, SkyFile(captures=parts))
    return parts


def read_sky(out: Path) -> list[SkyPart]:
    """Return the captures of the sky of an earlier run. Raises SidecarError for a file that agalign did not write."""
    file = read_model(out / SKY_FILE, SkyFile)
    return [] if file is None else file.captures


def _radiance(band: Band) -> float | None:
    with suppress(AgalignError):
        return sky_radiance(band)
    return None
