"""Unique names of the bands of a capture, and of the captures of an output folder."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import MappingProxyType

from agalign.values.capture import Band, Capture
from agalign.values.files import RUN_FILE

_RESERVED_NAMES = {"panels", "sky", Path(RUN_FILE).stem, "summary", "index"}
"""Files of a run in its output folder, without suffix."""


def with_unique_band_names(bands: Sequence[Band]) -> list[Band]:
    """Return the bands with unique names: the first band keeps a repeated name, the others get a number."""
    taken = {b.name for b in bands}
    kept: set[str] = set()
    unique = []
    for band in bands:
        name = band.name
        if name in kept:
            name = next(n for k in count(2) if (n := f"{band.name}-{k}") not in taken)
        taken.add(name)
        kept.add(name)
        unique.append(replace(band, name=name))
    return unique


def band_file_owners(captures: Sequence[Capture]) -> dict[str, str]:
    """Return the label of the capture by the band files that it may write, without suffix, below the output folder."""
    return {
        (c.folder / b.path.stem).as_posix().lower(): c.label
        for c in captures if len({b.path for b in c.bands}) > 1 for b in c.bands
    }  # fmt: skip


def with_unique_capture_names(
    captures: Sequence[Capture], file_owners: Mapping[str, str] = MappingProxyType({})
) -> list[Capture]:
    """Return the captures with a number added to names that are those of an earlier capture, of a file of the run, or
    of another capture's band file. `file_owners` is from `band_file_owners`.
    """
    taken = set(_RESERVED_NAMES)
    counts: Counter[str] = Counter()
    unique = []
    for capture in captures:
        renamed = capture
        while renamed.label.lower() in taken or file_owners.get(renamed.label.lower(), capture.label) != capture.label:
            counts[capture.label.lower()] += 1
            renamed = replace(capture, name=f"{capture.name}-{counts[capture.label.lower()] + 1}")
        taken.add(renamed.label.lower())
        unique.append(renamed)
    return unique
