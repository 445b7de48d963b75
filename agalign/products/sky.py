"""OUT/sky.json: the captures of the sky that a run left out, and the radiance of each band."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agalign.errors import AgalignError, SidecarError
from agalign.flight.sky import SkyCapture, sky_radiance
from agalign.products.sidecar import compact_lists
from agalign.values.capture import Band
from agalign.values.files import write_text

SKY_FILE = "sky.json"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SkyBandPart(_Part):
    """One band of a capture of the sky."""

    band: str
    file: str
    radiance: float | None
    """Median over the image, W / m^2 / sr / nm; null where it is not known, or half of the band is saturated."""


class SkyPart(_Part):
    """One capture of the sky."""

    folder: str
    capture: str
    captured_at: str
    cues: list[str]
    """The reasons for which it counts as one, in words."""
    bands: list[SkyBandPart]

    @property
    def sentence(self) -> str:
        """Why it is left out, in words."""
        return f"shows the sky ({', '.join(self.cues)}): not aligned"


class SkyFile(_Part):
    """All of a run."""

    schema_: Annotated[Literal["agalign-sky/1"], Field(alias="schema")] = "agalign-sky/1"
    captures: list[SkyPart]


def write_sky(sky: Sequence[SkyCapture], out: Path) -> list[SkyPart]:
    """Write OUT/sky.json, or remove that of an earlier run where there is no such capture. Raises OutputError."""
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
    write_text(path, compact_lists(SkyFile(captures=parts).model_dump_json(by_alias=True, indent=1)) + "\n")
    return parts


def read_sky(out: Path) -> list[SkyPart]:
    """Return the captures of an earlier run. Raises SidecarError for a file that agalign did not write."""
    path = out / SKY_FILE
    try:
        return SkyFile.model_validate_json(path.read_bytes()).captures
    except FileNotFoundError:
        return []
    except (OSError, ValidationError):
        raise SidecarError(f"{path}: cannot be read; run again") from None


def _radiance(band: Band) -> float | None:
    with suppress(AgalignError):
        return sky_radiance(band)
    return None
