"""Unique names: of the bands within a capture, and of the captures that write to one folder."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import MappingProxyType

from agalign.values.capture import Band, Capture
from agalign.values.files import RUN_FILE

_NAMES_OF_THE_RUN = {"panels", "sky", Path(RUN_FILE).stem, "summary", "index"}
"""Files at the top of an output folder that are not of a capture, without suffix."""


def with_unique_band_names(bands: Sequence[Band]) -> list[Band]:
    """The bands, renamed where a name repeats: the first band keeps it, the others get the next free number."""
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
    """{file below the output folder that a layout of single bands may write, without suffix: its capture's label}."""
    return {
        (c.folder / b.path.stem).as_posix().lower(): c.label
        for c in captures if len({b.path for b in c.bands}) > 1 for b in c.bands
    }  # fmt: skip


def with_unique_capture_names(
    captures: Sequence[Capture], file_owners: Mapping[str, str] = MappingProxyType({})
) -> list[Capture]:
    """The captures, numbered where their file would be that of an earlier capture, of another capture's band
    (`file_owners`, as `band_file_owners` returns them) or of the run.
    """
    taken = set(_NAMES_OF_THE_RUN)
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
