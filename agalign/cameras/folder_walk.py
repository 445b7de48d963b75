"""The image files below a folder, in natural order, without those in output folders of earlier runs."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from agalign.cameras.scan import Problem
from agalign.errors import InputError
from agalign.pixels.raster import PICTURE_SUFFIXES, TIFF_SUFFIXES
from agalign.values.files import RUN_FILE

_SUFFIXES = TIFF_SUFFIXES | PICTURE_SUFFIXES
IMAGE_KINDS = ".tif, .tiff, .jpg, .jpeg or .png"
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""Network address such as s3://bucket or https://host, as a Path writes it, with one slash. A drive has one letter."""
_SYSTEM_FOLDERS = {"lost+found", "System Volume Information", "$RECYCLE.BIN"}
"""Operating systems create these on a memory card."""


def check_folder(folder: Path) -> None:
    """Raise InputError if `folder` is not a folder that can be listed."""
    if folder.as_posix().startswith("/vsi"):
        raise InputError(f"{folder}: is one of GDAL's virtual paths; mount or unpack it, and give the folder")
    if _ADDRESS.match(folder.as_posix()):
        address = folder.as_posix().replace(":/", "://", 1)
        raise InputError(f"{address}: only local folders can be read; mount it or copy the images, and give the folder")
    try:
        if folder.is_dir():
            return
        what = "is a file; give the folder it is in" if folder.exists() else "does not exist"
    except OSError as error:
        what = f"cannot be looked into ({error.strerror or error})"
    raise InputError(f"{folder}: {what}")


def image_files(folder: Path, skip: Sequence[Path]) -> tuple[list[Path], list[Problem]]:
    """Return (image files below a folder, problems of folders that cannot be listed)."""
    skipped = {p.resolve() for p in skip}
    result: list[Path] = []
    problems: list[Problem] = []

    def refuse(error: OSError) -> None:
        path = Path(error.filename)
        problems.append(Problem(path, InputError(f"{path}: cannot be looked into ({error.strerror}); left out")))

    for parent, folders, names in os.walk(folder, onerror=refuse):
        here = Path(parent)
        folders[:] = sorted(d for d in folders if _is_input_folder(here / d, skipped))
        images = [n for n in names if Path(n).suffix.lower() in _SUFFIXES and not n.startswith(".")]
        result.extend(here / n for n in sorted(images, key=natural_order))
    return result, problems


def is_chosen(path: Path, include: Sequence[str], exclude: Sequence[str]) -> bool:
    """Return True for a path that matches a glob of `include`, or `include` is empty, and no glob of `exclude`.

    A glob is compared with the path relative to the input folder and with the file name; * matches / too.
    """

    def matches(globs: Sequence[str]) -> bool:
        return any(fnmatchcase(name, glob) for name in (path.as_posix(), path.name) for glob in globs)

    return (not include or matches(include)) and not matches(exclude)


def other_files(folder: Path) -> Counter[str]:
    """Return the number of other files below a folder by suffix, in lower case."""
    suffixes: Counter[str] = Counter()
    for _, folders, names in os.walk(folder):
        folders[:] = [d for d in folders if not d.startswith(".")]
        suffixes.update(Path(n).suffix.lower() or "no suffix" for n in names if not n.startswith("."))
    return Counter({s: n for s, n in suffixes.items() if s not in _SUFFIXES})


def natural_order(name: str) -> list[tuple[bool, int, str]]:
    """Return a sort key that puts `_2` before `_10`."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part.lower()) for part in parts]


def _is_input_folder(folder: Path, skipped: set[Path]) -> bool:
    if folder.name.startswith(".") or folder.name in _SYSTEM_FOLDERS or folder.resolve() in skipped:
        return False
    return not _is_output_folder(folder)


def _is_output_folder(folder: Path) -> bool:
    """True for the output folder of a run, whose stacks are not captures.

    A run writes RUN_FILE first, so the output of a killed run is recognised too.
    """
    try:
        entries = {entry.name for entry in os.scandir(folder)}
    except OSError:
        return False
    return RUN_FILE in entries or {"summary.csv", "index.html"} <= entries
