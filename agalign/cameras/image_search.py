"""The image files below a folder, without those in output folders of earlier runs."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from agalign.cameras.image_file import Problem, natural_order, problem_of
from agalign.errors import InputError
from agalign.host.files import PAGE_STARTS, REPORT_FILE, RUN_FILE, SUMMARY_FILE, path_problem
from agalign.host.own_files import has_mark
from agalign.host.text import counted
from agalign.pixels.raster import suffix_format


def check_folder(folder: Path) -> None:
    """Raise InputError if `folder` is not a folder that can be listed."""
    if problem := path_problem(folder):
        raise InputError(problem)
    try:
        if folder.is_dir():
            return
        what = "is a file" if folder.exists() else "does not exist"
    except OSError as error:
        what = f"cannot be looked into ({error.strerror or error})"
    raise InputError(f"{folder}: {what}; give the folder of the images")


def image_files(folder: Path, skip: Sequence[Path]) -> tuple[list[Path], list[Problem]]:
    """Return (image files below a folder, problems of folders that cannot be listed).

    Linked folders are read after the others: each folder once, by its own path if that is below `folder`.
    """
    skipped = {p.resolve() for p in skip}
    result: list[Path] = []
    problems: list[Problem] = []

    def refuse(error: OSError) -> None:
        path = Path(error.filename)
        problems.append(problem_of(path, f"cannot be looked into ({error.strerror}); left out"))

    outputs, listed, starts = list[Path](), set[tuple[int, int]](), [folder]
    for start in starts:  # links add to it
        for parent, folders, names in os.walk(start, onerror=refuse):
            here = Path(parent)
            if not _is_first_time(here, listed):
                folders.clear()
                continue
            folders[:] = [d for d in sorted(folders) if _is_input_folder(here / d, skipped, outputs)]
            starts += [here / d for d in folders if (here / d).is_symlink()]
            images = [n for n in names if suffix_format(Path(n)) and not n.startswith(".")]
            result.extend(here / n for n in sorted(images, key=natural_order))
    if outputs:
        what = f"output folders of earlier runs are skipped, {counted(len(outputs), 'folder')} in all"
        problems.append(problem_of(outputs[0], what, is_harmless=True))
    return result, problems


def _is_first_time(folder: Path, listed: set[tuple[int, int]]) -> bool:
    """Return False for a folder that is in the set `listed` by device and file number, to which it is added."""
    try:
        status = folder.stat()
    except OSError:
        return True
    key = status.st_dev, status.st_ino
    is_first = key not in listed
    listed.add(key)
    return is_first


def without_companions(images: Sequence[Path], folder: Path) -> tuple[list[Path], list[Problem]]:
    """Return (the images below a folder without the masks and small copies that programs and NAS keep beside them, a
    problem that counts these).

    Their folder has a name that such programs use, or their name is that of an image in the same folder, or in the one
    above, and what such programs add.
    """
    stems = {(path.parent, path.stem) for path in images}
    elsewhere = {path.name for path in images if not _MASK_FOLDER.fullmatch(path.parent.name)}

    def is_companion(path: Path) -> bool:
        if any(map(_SMALL_COPIES.fullmatch, path.relative_to(folder).parts[:-1])):
            return True
        if _MASK_FOLDER.fullmatch(path.parent.name) and path.name in elsewhere:
            return True
        end = _COMPANION_END.search(path.stem)
        of_image = "" if end is None else path.stem[: end.start()]
        return any((there, of_image) in stems for there in (path.parent, path.parent.parent))

    kept, skipped = list[Path](), list[Path]()
    for path in images:
        (skipped if is_companion(path) else kept).append(path)
    text = f"masks and thumbnails beside the images are skipped, {counted(len(skipped), 'file')} in all"
    return kept, [problem_of(path, text, is_harmless=True) for path in skipped[:1]]


_SMALL_COPIES = re.compile(r"@eadir|[.@]*_*thumb(?:nail)?s?|#?@?recycle", re.IGNORECASE)
"""Folders that NAS and programs make for small copies of images, and for deleted ones."""
_MASK_FOLDER = re.compile(r"masks?", re.IGNORECASE)
_COMPANION_END = re.compile(r"[ _-](?:masks?|thumb(?:nail)?)$", re.IGNORECASE)


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
        others = (Path(n) for n in names if not n.startswith(".") and not suffix_format(Path(n)))
        suffixes.update(other.suffix.lower() or "no suffix" for other in others)
    return suffixes


def _is_input_folder(folder: Path, skipped: set[Path], outputs: list[Path]) -> bool:
    """False for hidden folders, those of operating systems on memory cards, and the output folder of a run, which is
    added to `outputs`.

    A run writes RUN_FILE first, so the output of a killed run is recognised too; pages of that name of other programs
    are no output.
    """
    of_system = "lost+found", "System Volume Information", "$RECYCLE.BIN"
    if folder.name.startswith(".") or folder.name in of_system or folder.resolve() in skipped:
        return False
    try:
        entries = {entry.name for entry in os.scandir(folder)}
    except OSError:
        return True
    pages = [name in entries and has_mark(folder / name, (PAGE_STARTS[name],)) for name in (SUMMARY_FILE, REPORT_FILE)]
    is_output = RUN_FILE in entries or all(pages)
    outputs += [folder] if is_output else []
    return not is_output
