"""Atomic writing of files, tables and models among them, partial files of killed processes, and checks of paths."""

import csv
import errno
import hashlib
import io
import os
import platform
import re
import secrets
import shutil
import stat
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, TypeVar

from agalign.errors import OutputError, SidecarError
from agalign.host.processes import is_running
from agalign.host.text import name_problem, shortened, without_formula

if TYPE_CHECKING:  # `agalign --help` does without pydantic
    from pydantic import BaseModel

_Model = TypeVar("_Model", bound="BaseModel")

RUN_FILE = "agalign-run.json"
"""Name of the run record. It is written first, and identifies an output folder."""
PANELS_FILE, SKY_FILE, MODELS_FOLDER = "panels.json", "sky.json", "models"
REPORT_FILE, SUMMARY_FILE, INDICES_FILE, FLIGHT_MAP_FILE = "index.html", "summary.csv", "indices.csv", "flight.geojson"
PAGE_STARTS = {
    REPORT_FILE: b'<!doctype html>\n<html lang="en">\n<head>\n'
    b'<meta charset="utf-8">\n<meta name="generator" content="agalign">',
    SUMMARY_FILE: b"folder,capture,band,wavelength_nm,status,",
    INDICES_FILE: b"folder,capture,captured_at,latitude,longitude,index,",
    FLIGHT_MAP_FILE: b'{"type": "FeatureCollection", "name": "flight", ',
}
"""How the pages and tables of a run start, by their names in the output folder: the mark of this program."""
_PARTIAL = ".agalign-part-"
"""Prefix of partial files; host, process id and a random part follow."""
_MAX_NAME_BYTES, _MAX_SUFFIX = 120, 12
"""File names have at most 255 bytes: a checksum, and what the writer adds, follow."""
_WRITTEN_BELOW: ContextVar[Path | None] = ContextVar("written_below", default=None)
"""Folder that links must not lead out of when a file is written; None where any file may be written."""
_MAX_PATH_BYTES, _MAX_PART_BYTES = 1024, 255
"""Of a relative path in a file that is read: file systems allow parts of 255 bytes, and systems paths of 4,096."""
_MAX_ARGUMENT_BYTES = 4095
"""Of a path that a user gives: the limit of Linux."""
_RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)
"""Names of devices on Windows."""


@contextmanager
def written_below(folder: Path) -> Iterator[None]:
    """Make `complete_file` and `scratch_file` raise OutputError within the block if a link leads out of a folder, such
    as one that was put in the place of a subfolder during the run.
    """
    token = _WRITTEN_BELOW.set(folder)
    try:
        yield
    finally:
        _WRITTEN_BELOW.reset(token)


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, which is renamed to `path` if the block succeeds, and else removed.

    The contents are flushed to disk before the renaming: after a power failure, `path` is either the old file or the
    complete new one. Raises OutputError for an OSError.
    """
    with scratch_file(path) as partial:
        yield partial
        _flush_to_disk(partial)
        partial.replace(path)
        remove_companions(path)
        _flush_to_disk(path.parent)


@contextmanager
def scratch_file(neighbour: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `neighbour`, which is created; the file or folder that the block makes
    there is removed after it.

    The file has the suffix of `neighbour`, because some libraries choose the format by it. Its name is unique among
    processes on all machines that share the folder, and hidden, so that it is not read as an image.
    Raises OutputError for an OSError, and within `written_below` for a folder elsewhere.
    """
    if (root := _WRITTEN_BELOW.get()) is not None:
        check_inside(neighbour.parent, root)
    scratch = neighbour.with_name(f"{_PARTIAL}{_host()}-{os.getpid()}-{secrets.token_hex(8)}{neighbour.suffix}")
    try:
        neighbour.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
    except OSError as error:
        raise OutputError(f"{neighbour}: cannot be written ({error.strerror or error})") from None
    finally:
        _remove(scratch)


def remove_companions(path: Path) -> None:
    """Remove the files that GDAL has put beside a raster which is replaced or removed: they describe its pixels."""
    if path.suffix.lower() in (".tif", ".tiff", ".png"):
        for suffix in (".ovr", ".aux.xml", ".msk"):  # overviews, statistics, mask
            with suppress(OSError):
                path.with_name(path.name + suffix).unlink(missing_ok=True)


def below_as_given(path: Path, folder: Path) -> Path:
    """Return a path below a folder with the folder as the user gave it: workers get and return absolute paths."""
    return folder / path.relative_to(folder.absolute()) if path.is_absolute() else path


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically, with line feeds on every system. Raises OutputError."""
    with complete_file(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def link_or_copy(source: Path, target: Path, *, copy: bool = False) -> None:
    """Make a hard link to a file, or a copy where that is not possible or not wanted. Raises OSError."""
    if not copy:
        with suppress(OSError):  # another disk, or a file system without hard links
            os.link(source, target)
    if not target.exists():
        shutil.copyfile(source, target)


def file_checksum(path: Path) -> str:
    """Return the SHA-256 of an output file as hexadecimal digits. Raises OutputError."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read back ({error.strerror or error})") from None


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises OSError, also for pipes, sockets and devices, which could block."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file")
    return open(descriptor, "rb")  # noqa: PTH123 - the descriptor that was checked


def read_regular(path: Path, max_bytes: int = 1 << 28) -> bytes:
    """Return the contents of a regular file. Raises OSError, also for a file with more bytes than that: the default is
    ten times the record of a run of 100,000 captures.
    """
    with open_regular(path) as file:
        contents = file.read(max_bytes + 1)
    if len(contents) > max_bytes:
        raise OSError(errno.EFBIG, f"over {max_bytes >> 20} MB are too many for this file")
    return contents


def remove_partial_files(folder: Path, *, below: bool = True) -> None:
    """Remove partial files and folders in a folder, and in those `below` it, from this process and from processes of
    this machine that have ended.

    Partial files in output folders of other runs, of running processes and of other machines are kept.
    """
    for parent, folders, files in folders_of_run(folder):
        for name in (*folders, *files):
            if name.startswith(_PARTIAL) and _is_left_over(name):
                _remove(Path(parent, name))
        if not below:
            return


def folders_of_run(out: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield an output folder and those below it, with the names of the folders and files there, as `os.walk` does,
    without the output folders of other runs.
    """
    for parent, folders, files in os.walk(out):
        yield parent, folders, files
        folders[:] = [f for f in folders if not os.path.exists(Path(parent, f, RUN_FILE))]  # noqa: PTH110 - it may not be readable


def _remove(path: Path) -> None:
    """Remove a file or a folder, if it can be."""
    with suppress(OSError):
        path.unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)


def _is_left_over(partial: str) -> bool:
    host, _, rest = partial.removeprefix(_PARTIAL).partition("-")
    process = rest.partition("-")[0]
    if host != _host() or not process.isdigit():
        return False
    return int(process) == os.getpid() or not is_running(int(process))


def _host() -> str:
    """Return the letters and digits of the host name, up to 40, because file names have at most 255 bytes."""
    return "".join(c for c in platform.node() if c.isalnum())[:40] or "host"


def is_inside(name: str) -> bool:
    """True for a relative path that stays inside its folder on POSIX and on Windows, and is not too long for a file."""
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    anchored = posix.is_absolute() or bool(windows.drive or windows.root)
    path_bytes, *parts_bytes = (len(text.encode(errors="surrogatepass")) for text in (name, *posix.parts))
    if path_bytes > _MAX_PATH_BYTES or max(parts_bytes, default=0) > _MAX_PART_BYTES:
        return False
    return bool(name) and not anchored and ".." not in windows.parts and "\0" not in name


def file_name(text: str, taken: MutableMapping[str, str] | None = None) -> str:
    """Return a text from a file as (a part of) a file name: letters, digits and `._-`, of bounded length, without a dot
    at its ends, not a name that Windows reserves, and not empty. A suffix is kept.

    `taken` has the text of each name, in lower case, that was given in a folder: another text gets another name, which
    ends in a checksum.
    """
    allowed = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFKC", text)).strip(".")
    stem, suffix = os.path.splitext(allowed)  # noqa: PTH122 - a path would be empty without text
    stem = stem.encode()[:_MAX_NAME_BYTES].decode(errors="ignore").strip(".") or "_"
    suffix = suffix[:_MAX_SUFFIX]
    if _RESERVED.fullmatch(stem + suffix):
        stem = f"_{stem}"
    while taken is not None and taken.setdefault(f"{stem}{suffix}".lower(), text) != text:
        stem += f"-{hashlib.sha256(text.encode(errors='surrogatepass')).hexdigest()[:8]}"
    return stem + suffix


def path_problem(path: Path) -> str:
    """Return why a path that a user gives cannot be that of a local file or folder, and the remedy; empty if it can."""
    if problem := name_problem(path):
        return problem
    text, longest = path.as_posix(), max((len(os.fsencode(part)) for part in path.parts), default=0)
    if longest > _MAX_PART_BYTES or len(os.fsencode(path)) > _MAX_ARGUMENT_BYTES:
        what = f"a name of {longest} bytes" if longest > _MAX_PART_BYTES else "too many folders"
        limits = f"file systems take {_MAX_PART_BYTES} bytes a name and {_MAX_ARGUMENT_BYTES:,} a path"
        return f"{shortened(text)}: has {what}, and {limits}; give a shorter path"
    try:
        path.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return f"{text}: its symbolic links lead back to themselves; give the path of a file or folder"
    if text.startswith("/vsi"):
        return f"{text}: is one of GDAL's virtual paths; mount or unpack it, and give the local path"
    # A Path writes s3://bucket or https://host with one slash; a drive has one letter.
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", text):
        address = text.replace(":/", "://", 1)
        return f"{address}: only local files and folders are used; mount it or copy the files, and give the local path"
    return ""


def max_name_bytes(folder: Path) -> int:
    """Return how many bytes a file's name may have in a folder, which may not exist yet: 255, or fewer on some NAS."""
    existing = next((p for p in (folder, *folder.absolute().parents) if p.exists()), folder)
    with suppress(OSError, ValueError, AttributeError):  # other systems have no pathconf
        return min(_MAX_PART_BYTES, os.pathconf(existing, "PC_NAME_MAX"))
    return _MAX_PART_BYTES


def check_inside(path: Path, folder: Path) -> Path:
    """Return a path below a folder. Raises OutputError if a symbolic link leads out of the folder."""
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise OutputError(f"{path}: a link leads out of {folder}; remove the link, or choose another folder with -o")
    return path


def _flush_to_disk(path: Path) -> None:
    """Flush a file, or the entries of a folder where the system supports that, to disk (fsync)."""
    folder = path.is_dir()
    if folder and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if not (
            folder and error.errno in (errno.EINVAL, errno.ENOTSUP)
        ):  # network file systems without fsync of folders
            raise
    finally:
        os.close(descriptor)


# ---- tables as CSV, and pydantic models as JSON that is read back


_NUMBERS = r"\[[^][\"{}]*+\]"
"""A list of numbers, then of such lists, up to four deep. Possessive: it takes milliseconds for a megabyte."""
for _ in range(3):
    _NUMBERS = rf"\[(?:[^][\"{{}}]++|{_NUMBERS})*+\]"
_JSON_TOKEN = re.compile(rf'"(?:[^"\\]|\\.)*+"|{_NUMBERS}|\{{\}}|[]{{}}[,:]')


def indented(text: str) -> str:
    """Return compact JSON with a line for each element of objects and lists; a list of numbers, or of such lists, stays
    on one line: it takes a third of the size.
    """
    depth = 0

    def laid_out(token: re.Match[str]) -> str:
        nonlocal depth
        match token[0]:
            case ":":
                return ": "
            case "," as separator:
                return f"{separator}\n{' ' * depth}"
            case "{" | "[" as first:
                depth += 1
                return f"{first}\n{' ' * depth}"
            case "}" | "]" as last:
                depth -= 1
                return f"\n{' ' * depth}{last}"
            case other:
                return other

    return _JSON_TOKEN.sub(laid_out, text)


def write_model(path: Path, model: "BaseModel | None") -> None:
    """Write a model atomically as indented JSON; None removes the file of an earlier run. Raises OutputError.

    A file with this content already keeps its time, by which pages are known to be newer.
    """
    if model is None:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return
    text = indented(model.model_dump_json(by_alias=True)) + "\n"
    with suppress(OSError):
        if read_regular(path) == text.encode():
            return
    write_text(path, text)


def read_model(path: Path, model: type[_Model]) -> _Model | None:
    """Return the model in a file, or None if the file does not exist. Raises SidecarError for any other content."""
    try:
        return model.model_validate_json(read_regular(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:  # pydantic's ValidationError is a ValueError
        reason = f" ({error.strerror})" if isinstance(error, OSError) else ""
        raise SidecarError(f"{path}: cannot be read{reason}; delete it and run again") from None


class CsvTable:
    """A table that is collected row by row as text, which takes little memory, and then written as CSV."""

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns, self._text = columns, io.StringIO()
        self._writer = csv.writer(self._text, lineterminator="\n")
        self._writer.writerow(columns)

    def add(self, row: Sequence[object] | Mapping[str, object]) -> None:
        """Add a row, or cells by column; None and a missing one become an empty cell, and formulas are quoted.

        Raises KeyError for a cell without a column, which the caller has to name.
        """
        if isinstance(row, Mapping):
            if unknown := row.keys() - set(self._columns):
                raise KeyError(f"no column {', '.join(sorted(unknown))}")
            row = [row.get(name) for name in self._columns]
        self._writer.writerow(map(without_formula, row))

    def write(self, path: Path) -> None:
        """Write the table atomically. Raises OutputError."""
        write_text(path, self._text.getvalue())


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object] | Mapping[str, object]]) -> None:
    """Write a table atomically, with rows as `CsvTable.add`. Raises OutputError."""
    table = CsvTable(columns)
    for row in rows:
        table.add(row)
    table.write(path)
