"""The mark by which a command recognises the files that an earlier one wrote, whatever their names, and what is not
replaced.
"""

import os
import re
from contextlib import suppress
from pathlib import Path

from agalign.errors import ConfigurationError
from agalign.host.files import PAGE_STARTS, open_regular

SOFTWARE = "agalign"
"""Value of the tag Software of every raster."""
PNG_MARK = b"Software\0" + SOFTWARE.encode()
"""Text chunk of every PNG file: keyword and text."""
JPEG_MARK = b"\xff\xfe" + (2 + len(SOFTWARE)).to_bytes(2) + SOFTWARE.encode()
"""Comment of every JPEG file, with its marker and length."""
MODEL_MARK = b'{"__metadata__":{"agalign":'
"""Start of every model, after the length of its header in eight bytes."""
_TIFF_MARK = rb'%b(?<![ -~]%b)\0|<Item name="REFERENCE_BAND">' % (SOFTWARE.encode(), SOFTWARE.encode())
"""The tag Software, not the end of a longer text; that of GDAL's metadata in files of single bands, which keep the
camera's software. A search is three times faster with the name before the condition."""
_MARKS = {b"II": _TIFF_MARK, b"MM": _TIFF_MARK, b"\x89P": re.escape(PNG_MARK), b"\xff\xd8": re.escape(JPEG_MARK)}
"""Patterns of marks by the first two bytes of a file: TIFF in both orders of bytes, PNG, JPEG."""
_SEARCHED_BYTES = 1 << 16
"""The mark is near the start of a file, or near its end in a TIFF to which tags were added."""


def is_taken(path: Path) -> bool:
    """Return True for a file, pipe or device, or a link to a folder, which a new file would replace; False for a
    folder, where no file can be written, and for a link to nothing.
    """
    return path.exists() and (path.is_symlink() or not path.is_dir())


def is_own_file(path: Path, text_starts: tuple[bytes, ...] = ()) -> bool:
    """Return True for an image or a model with the mark, a text with one of these starts, and an empty file, which has
    no contents.

    Texts have no place for a mark; their writers know how they start (`Product.text_starts`).
    """
    with suppress(OSError):
        return (path.is_file() and not path.stat().st_size) or has_mark(path, text_starts)
    return False


def has_mark(path: Path, text_starts: tuple[bytes, ...] = ()) -> bool:
    """Return True for a file as `is_own_file` that is not empty."""
    with suppress(OSError), open_regular(path) as file:
        start, size = file.read(_SEARCHED_BYTES), file.seek(0, os.SEEK_END)
        file.seek(max(_SEARCHED_BYTES, size - _SEARCHED_BYTES))
        end = file.read()
        mark = _MARKS.get(start[:2])
        is_image = mark is not None and any(re.search(mark, part) for part in (start, end))
        return is_image or start.startswith(MODEL_MARK, 8) or start.startswith(text_starts)
    return False


_OTHER_FOLDER = "choose another output folder with -o"


def foreign(path: Path, remedy: str = _OTHER_FOLDER) -> str:
    """Return the message about a file at the path of an output that no command has written."""
    return f"{path}: was not written by agalign; {remedy}"


def refuse_foreign(path: Path, text_starts: tuple[bytes, ...] = (), remedy: str = _OTHER_FOLDER) -> None:
    """Raise ConfigurationError for a file that is not one as `is_own_file`."""
    if is_taken(path) and not is_own_file(path, text_starts):
        raise ConfigurationError(foreign(path, remedy))


def refuse_foreign_pages(out: Path, remedy: str = _OTHER_FOLDER) -> None:
    """Raise ConfigurationError for a file with the name of a page or table of a run that no command has written."""
    for name, start in PAGE_STARTS.items():
        refuse_foreign(out / name, (start,), remedy)


def refuse_to_replace(path: Path, mark: bytes | None) -> None:
    """Raise ConfigurationError if a file exists that a command would replace, unless it is one of an earlier command:
    that has a `mark` near its start. None refuses every file.
    """
    start = b""
    with suppress(OSError), open_regular(path) as file:
        start = file.read(256)
    if path.exists() and (mark is None or mark not in start):
        raise ConfigurationError(f"{path}: exists already; choose another name with -o, or delete it")
