"""The captures of a run by their sidecars: their bands, with file and index, and the captures that differ from most."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from agalign.errors import InputError, SidecarError
from agalign.records.listed_files import ListedFiles
from agalign.records.run_record import counted_sidecars
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import label_of, read_checked, run_sidecars

LeftOut = list[tuple[str, str]]
"""(label of a capture, reason why it is left out)."""


@dataclass(frozen=True)
class AlignedBand:
    """An aligned band: the file and index of its pixels, or the reason why it cannot be used."""

    name: str
    wavelength_nm: float | None
    file: Path
    band_index: int
    sha256: str = ""
    """Checksum of the file, if it is known."""
    problem: str = ""
    quality: tuple[Path, int, str] | None = None
    """Quality raster whose flagged pixels become nan: file, index of the band's layer, checksum of the file."""


def quality_layers(bands: Iterable[str]) -> dict[str, int]:
    """Return the layer of each band in a quality raster, from 1, given the bands in the order of the stack."""
    return {name: number for number, name in enumerate(bands, start=2)}  # layer 1 is that of all bands together


def bands_of(sidecar: Sidecar, folder: Path, *, mask_qa: bool = False) -> list[AlignedBand]:
    """Return the bands of a capture, given the folder of its sidecar; with `mask_qa` with their quality flags.

    Raises InputError with `mask_qa` if the run wrote no quality raster of a capture that has pixels.
    """
    flags = next((part for part in sidecar.products if part.kind == "qa"), None)
    if mask_qa and flags is None and sidecar.output is not None:
        raise InputError(f"{sidecar.capture}: has no quality raster, which --mask-qa needs; align with --qa")
    checksums = {part.file: part.sha256 for part in sidecar.products}
    of_stack = [] if sidecar.output is None else sidecar.output.bands
    layers = quality_layers(of_stack or [part.band for part in sidecar.bands])
    result, lost = [], _why_without_pixels(sidecar)
    for part in sidecar.bands:
        file, index = ("", 1) if part.place is None else (part.place.file, part.place.band_index)
        quality = (folder / flags.file, layers[part.band], flags.sha256) if mask_qa and flags is not None else None
        checksum = checksums.get(file, "")
        problem = ""
        if not part.is_usable(sidecar.accept_predicted_px):
            error = ""
            if part.status == "predicted" and part.error is not None:
                limit_px = sidecar.accept_predicted_px
                error = f" with an expected error of {part.error.in_words}, above {limit_px:g} px of the band"
            problem = f"{part.band} is {part.status.replace('_', ' ')}{error} ({part.reason})"
        elif part.place is None:
            problem = lost or f"the pixels of {part.band} were not written; run again"
        result.append(AlignedBand(part.band, part.wavelength_nm, folder / file, index, checksum, problem, quality))
    return result


def _why_without_pixels(sidecar: Sidecar) -> str:
    """Return that a capture has no aligned pixels and why; empty if it has, or should have, some."""
    if sidecar.output is not None or sidecar.usable:
        return ""
    known = (f": {name} is {status.replace('_', ' ')} ({reason})" for name, status, reason in sidecar.pairs if reason)
    return f"its capture has no aligned pixels{next(known, '')}"


@dataclass(frozen=True)
class RunCapture:
    """A capture of a run."""

    label: str
    """Its name below the output folder of the run."""
    path: Path
    """Path of the sidecar."""
    result: Sidecar
    """Content of the sidecar."""
    file_states: str = ""
    """States of its files in the run record."""

    @cached_property
    def listed(self) -> ListedFiles:
        """Its files as the sidecar lists them."""
        return ListedFiles.of(self.result, self.path.parent, self.file_states)

    @cached_property
    def bands(self) -> list[AlignedBand]:
        """The bands in the order of the sidecar."""
        return bands_of(self.result, self.path.parent)


def captures_of_run(out: Path) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures of a run in the order of their labels, and those with an unreadable sidecar.

    The sidecars lack their long tables: those of a long flight would not fit into memory.
    Raises InputError if `out` has no sidecars.
    """
    captures, left_out = [], []
    for path, states in counted_sidecars(run_sidecars(out), out).items():
        label = label_of(path, out)
        try:
            captures.append(RunCapture(label, path, read_checked(path).without_tables(), states))
        except SidecarError as error:
            left_out.append((label, str(error)))
    return captures, left_out


def differing_from_most(facts: Mapping[str, tuple[str, ...]]) -> LeftOut:
    """Return the captures that differ from most, given the facts about each by label, and how they differ."""
    usual, count = max(Counter(facts.values()).items(), key=lambda item: item[1], default=((), 0))
    most = f"{count} of {len(facts)} captures have"
    pairs = {label: zip(own, usual, strict=True) for label, own in facts.items() if own != usual}
    return [(k, next(f"it has {a}, and {most} {b}" for a, b in pair if a != b)) for k, pair in pairs.items()]
