"""The captures of a run, for products of several captures: their contents, and the captures that differ from most."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from agalign.errors import InputError, SidecarError
from agalign.products.index_bands import RAW, BandReader, IndexBand, bands_of
from agalign.products.sidecar import CaptureResult
from agalign.products.sidecar_file import read_result, run_sidecars

LeftOut = list[tuple[str, str]]
"""(label of a capture, reason why it is left out)."""


@dataclass(frozen=True)
class RunCapture:
    """A capture of a run."""

    label: str
    """Its name below the output folder of the run."""
    path: Path
    """Path of the sidecar."""
    result: CaptureResult
    """The sidecar without its long tables: all of them, of a long flight, would not fit in memory."""

    @cached_property
    def bands(self) -> list[IndexBand]:
        """The bands in the order of the sidecar."""
        return bands_of(self.result, self.path.parent)

    def contents(self) -> tuple[str, str]:
        """Return what the files contain, in words: (bands with pixels, their quantities). Raises InputError."""
        pairs = zip(self.bands, self.result.bands, strict=True)
        bands = [band for band, part in pairs if part.place is not None]
        names: dict[str, list[str]] = defaultdict(list)
        with BandReader() as reader:
            for band in bands:
                names[reader.quantity(band) or RAW].append(band.name)
        quantities = [q if len(names) == 1 else f"{q} in {', '.join(names[q])}" for q in names]
        return f"bands {', '.join(_named(band) for band in bands)}", " and ".join(quantities)


def _named(band: IndexBand) -> str:
    return band.name if band.wavelength_nm is None else f"{band.name} ({band.wavelength_nm:g} nm)"


def captures_of_run(out: Path) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures of a run in the order of their labels, and those with an unreadable sidecar.

    Raises InputError if `out` has no sidecars.
    """
    captures, left_out = [], []
    for path in run_sidecars(out):
        label = path.relative_to(out).with_suffix("").as_posix()
        try:
            captures.append(RunCapture(label, path, read_result(path)))
        except SidecarError as error:
            left_out.append((label, str(error)))
    return captures, left_out


def like_most(captures: Sequence[RunCapture]) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures with the same contents as most of them, and the others, or those that cannot be read."""
    contents: dict[str, tuple[str, ...]] = {}
    left_out = []
    for capture in captures:
        try:
            contents[capture.label] = capture.contents()
        except InputError as error:
            left_out.append((capture.label, str(error)))
    left_out += exceptions(contents)
    labels = {label for label, _ in left_out}
    return [c for c in captures if c.label not in labels], left_out


def exceptions(facts: Mapping[str, tuple[str, ...]]) -> LeftOut:
    """Return the captures that differ from most, given the facts about each by label, and how they differ."""
    usual, count = max(Counter(facts.values()).items(), key=lambda item: item[1], default=((), 0))
    most = f"{count} of {len(facts)} captures have"
    pairs = {label: zip(own, usual, strict=True) for label, own in facts.items() if own != usual}
    return [(k, next(f"it has {a}, and {most} {b}" for a, b in pair if a != b)) for k, pair in pairs.items()]
