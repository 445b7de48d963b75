"""Files that are complete or not there, and the names that they may have."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath, PureWindowsPath

from agalign.errors import OutputError

RUN_FILE = "agalign-run.json"
"""What a run is, in its output folder: there before anything else is, so that the folder is known by it."""
_PARTIAL = ".agalign-part-"


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A path to write to beside `path`, which takes that name where the block ends well and goes where it does not.

    What was written has reached the disk before it takes the name: where the power fails, either the old file is there
    or the whole new one. Raises OutputError for an OSError.
    """
    with scratch_file(path) as partial:
        yield partial
        _to_disk(partial)
        partial.replace(path)
        _to_disk(path.parent)


@contextmanager
def scratch_file(beside: Path) -> Iterator[Path]:
    """A path to write to beside another, which is gone when the block ends.

    It has the same suffix, by which some libraries choose a format, and a name that no other process, here or on
    another machine that sees the folder, takes; as a hidden file it is no image to be aligned. The folder is made.
    Raises OutputError for an OSError.
    """
    scratch = beside.with_name(f"{_PARTIAL}{secrets.token_hex(8)}{beside.suffix}")
    try:
        beside.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
    except OSError as error:
        raise OutputError(f"{beside}: cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all, the same on every system. Raises OutputError."""
    with complete_file(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def remove_partial_files(folder: Path) -> None:
    """What a killed process left of `scratch_file` below a folder. Nobody else may be writing there."""
    for parent, _, names in os.walk(folder):
        for name in names:
            if name.startswith(_PARTIAL):
                with suppress(OSError):
                    Path(parent, name).unlink()


def is_inside(name: str) -> bool:
    """True for the relative path of a file that no reading of it puts outside the folder it is relative to."""
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    anchored = posix.is_absolute() or bool(windows.drive or windows.root)
    return bool(name) and not anchored and ".." not in windows.parts and "\0" not in name


def _to_disk(path: Path) -> None:
    """A folder's entries are written to disk like a file's contents, where system and file system have that."""
    folder = path.is_dir()
    if folder and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if not (folder and error.errno in (errno.EINVAL, errno.ENOTSUP)):  # as some network drives say of a folder
            raise
    finally:
        os.close(descriptor)
