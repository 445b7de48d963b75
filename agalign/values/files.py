"""Files that are complete or not there, and the names that they may have."""

import errno
import hashlib
import os
import platform
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath

from agalign.errors import OutputError

RUN_FILE = "agalign-run.json"
"""What a run is, in its output folder: there before anything else is, so that the folder is known by it."""
_LONGEST_HOST = 40
"""Of the letters of a host's name: names of files have at most 255 bytes."""
_PARTIAL = ".agalign-part-"
"""Start of the names of files that are being written: host, process and a random part follow."""


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A path to write to next to `path`: renamed to it if the block succeeds, else removed.

    What was written has reached the disk before it takes the name: where the power fails, either the old file is there
    or the whole new one. Raises OutputError for an OSError.
    """
    with scratch_file(path) as partial:
        yield partial
        _to_disk(partial)
        partial.replace(path)
        _to_disk(path.parent)


@contextmanager
def scratch_file(neighbour: Path) -> Iterator[Path]:
    """A path to write to next to another; it is removed when the block ends.

    It has the same suffix, by which some libraries choose a format, and a name that no other process, here or on
    another machine that sees the folder, takes; being hidden, it is not taken for an image. The folder is made.
    Raises OutputError for an OSError.
    """
    scratch = neighbour.with_name(f"{_PARTIAL}{_host()}-{os.getpid()}-{secrets.token_hex(8)}{neighbour.suffix}")
    try:
        neighbour.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
    except OSError as error:
        raise OutputError(f"{neighbour}: cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, the same on every system. Raises OutputError."""
    with complete_file(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def file_checksum(path: Path) -> str:
    """Return the SHA-256 of a file that was written a moment ago. Raises OutputError."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read back ({error.strerror or error})") from None


def open_regular(path: Path) -> BufferedReader:
    """The file, open for reading. Raises OSError, also for a pipe, a socket or a device: these may never answer."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file")
    return open(descriptor, "rb")  # noqa: PTH123 - what was checked is what is read


def remove_partial_files(folder: Path) -> None:
    """What processes of this machine that have ended left of `scratch_file` below a folder, and what this one left.

    The output folders of other runs in it, and files of processes that live or ran elsewhere, are left alone.
    """
    for parent, folders, names in os.walk(folder):
        folders[:] = [f for f in folders if not Path(parent, f, RUN_FILE).exists()]
        for name in names:
            if name.startswith(_PARTIAL) and _is_left_over(name):
                with suppress(OSError):
                    Path(parent, name).unlink()


def _is_left_over(partial: str) -> bool:
    host, _, rest = partial.removeprefix(_PARTIAL).partition("-")
    process = rest.partition("-")[0]
    if host != _host() or not process.isdigit():
        return False
    return int(process) == os.getpid() or not _is_alive(int(process))


def _is_alive(process: int) -> bool:
    """True for a process of this machine. Windows has no such question: its open files cannot be removed anyway."""
    if os.name == "nt":
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _host() -> str:
    """The name of this machine, of letters and digits."""
    return "".join(c for c in platform.node() if c.isalnum())[:_LONGEST_HOST] or "host"


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
        if not (folder and error.errno in (errno.EINVAL, errno.ENOTSUP)):  # as some network drives report for a folder
            raise
    finally:
        os.close(descriptor)
