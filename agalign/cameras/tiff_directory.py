"""Reading the directories of a TIFF, and adding Exif and GPS directories, which rasterio and tifffile do not write, to
a finished file. Classic TIFF and BigTIFF in either byte order, by TIFF 6.0 and the EXIF specification.
"""

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import Image
from tifffile import DATATYPE, TIFF, TiffFormat

from agalign.pixels.raster import suffix_format

EXIF, GPS = 34665, 34853
"""Tags with the offset of a directory as value."""
XMP = 700
_SIZE = {kind: struct.calcsize(f"<{numbers}") for kind, numbers in TIFF.DATA_FORMATS.items()}
"""Bytes of a value of each type."""
_LAYOUTS = {b"II*\0": TIFF.CLASSIC_LE, b"MM\0*": TIFF.CLASSIC_BE, b"II+\0": TIFF.BIG_LE, b"MM\0+": TIFF.BIG_BE}
"""The formats of the numbers of a file by its first bytes. The offset of its first directory follows at the position
that is the size of an offset.
"""


@dataclass(frozen=True)
class Entry:
    """The values of a tag: their TIFF type, their number, and their bytes, little-endian."""

    type: int
    count: int
    data: bytes


Directory = dict[int, Entry]
"""The entries by tag."""


def short(*values: int) -> Entry:
    """Return an entry of 16-bit integers."""
    return Entry(DATATYPE.SHORT, len(values), struct.pack(f"<{len(values)}H", *values))


def long(*values: int) -> Entry:
    """Return an entry of 32-bit integers."""
    return Entry(DATATYPE.LONG, len(values), struct.pack(f"<{len(values)}I", *values))


def text(value: str) -> Entry:
    """Return an entry of text; characters beyond ASCII are written as UTF-8, which most readers expect."""
    data = value.encode() + b"\0"
    return Entry(DATATYPE.ASCII, len(data), data)


def byte_string(value: bytes) -> Entry:
    """Return an entry of bytes."""
    return Entry(DATATYPE.BYTE, len(value), value)


def rational(*values: float) -> Entry:
    """Return an entry of unsigned fractions. Raises ValueError for values that do not fit."""
    pairs, max_long = b"", (1 << 32) - 1
    for value in values:
        if not 0 <= value < max_long:
            raise ValueError(f"{value} does not fit into a TIFF fraction")
        denominator = min(1_000_000, max(1, int(max_long / (value + 1))))
        pairs += struct.pack("<II", round(value * denominator), denominator)
    return Entry(DATATYPE.RATIONAL, len(values), pairs)


def values(entry: Entry) -> Any:
    """Return the number of an entry, a tuple of several numbers, or the bytes of a text or of the types BYTE and
    UNDEFINED. Fractions are floats, nan for a denominator of 0.
    """
    numbers = TIFF.DATA_FORMATS[entry.type]
    if numbers[-1] in "Bbs":
        return entry.data.partition(b"\0")[0] if entry.type == DATATYPE.ASCII else entry.data
    result = struct.unpack(f"<{int(numbers[0]) * entry.count}{numbers[-1]}", entry.data)
    if numbers[0] == "2":
        result = tuple(n / d if d else math.nan for n, d in zip(result[::2], result[1::2], strict=True))
    return result[0] if len(result) == 1 else result


def read_directories(path: Path, page: int = 0) -> dict[int, Directory]:
    """Return {0: the first directory, EXIF: …, GPS: …} of a TIFF, or of the Exif part of a JPEG, with its XMP packet.

    The tags of a `page` of a TIFF, from 1, are added to those of the first directory.
    A file with the suffix of a JPEG is read as one. Raises ValueError, or an error of Pillow, if the file is malformed,
    OSError if it cannot be read.
    """
    if suffix_format(path) != "JPEG":
        with path.open("rb") as file:
            return _read_all(file, page)
    with Image.open(path, formats=("JPEG",)) as image:
        block, packet = image.info.get("exif", b""), image.info.get("xmp", b"")
    result = _read_all(BytesIO(block[6:])) if block.startswith(b"Exif\0\0") else {0: {}, EXIF: {}, GPS: {}}
    if packet:
        result[0][XMP] = byte_string(packet)
    return result


def add_directories(path: Path, first: Mapping[int, Entry], exif: Directory, gps: Directory) -> None:
    """Add entries to the first directory of a finished TIFF, and Exif and GPS directories, in place.

    The first directory is written again at the end of the file; the pixels are not moved.
    """
    with path.open("r+b") as file:
        layout, at = _header(file)
        page, following = _directory_at(file, layout, at)
        entries = {**_entries(file, layout, page), **first}
        offset_format = layout.offsetformat[-1]
        kind = DATATYPE.LONG8 if offset_format == "Q" else DATATYPE.LONG
        for tag, directory in ((EXIF, exif), (GPS, gps)):
            if directory:
                start = _write_directory(file, layout, directory, 0)
                entries[tag] = Entry(kind, 1, struct.pack(f"<{offset_format}", start))
        start = _write_directory(file, layout, entries, following)
        file.seek(layout.offsetsize)
        file.write(struct.pack(layout.offsetformat, start))


def image_pages(path: Path) -> list[int]:
    """Return the numbers, from 1, of the pages of a TIFF that are images: not reduced ones, masks and sub-directories.

    Raises ValueError or OSError like `read_directories`.
    """
    with path.open("rb") as file:
        layout, at = _header(file)
        pages = list(_pages(file, layout, at))
        if len(pages) == 1:  # most files: their tags are read only once, by `read_directories`
            return [1]
        kinds = [_entries(file, layout, page).get(254, long(0)) for page in pages]
    reduced_or_mask = 1 | 4  # of the tag NewSubfileType
    return [number for number, kind in enumerate(kinds, 1) if not int(values(kind)) & reduced_or_mask]


def _read_all(file: BinaryIO, page: int = 0) -> dict[int, Directory]:
    layout, at = _header(file)
    pages = _pages(file, layout, at)
    first = _entries(file, layout, next(pages))
    if page > 1:
        first |= _entries(file, layout, next(islice(pages, page - 2, None)))
    result = {0: first, EXIF: Directory(), GPS: Directory()}
    for tag in (EXIF, GPS):
        if tag in first:
            place = int.from_bytes(first[tag].data[: _SIZE[first[tag].type]], "little")
            result[tag] = _entries(file, layout, _directory_at(file, layout, place)[0])
    return result


def _header(file: BinaryIO) -> tuple[TiffFormat, int]:
    """(layout, offset of the first directory)."""
    file.seek(0)
    layout = _LAYOUTS.get(file.read(4))
    if layout is None:
        raise ValueError("no TIFF header")
    file.seek(layout.offsetsize)
    return layout, _number(file, layout.offsetformat)


def _pages(file: BinaryIO, layout: TiffFormat, at: int) -> Iterator[bytes]:
    """Yield the entries of each page as in the file. Raises ValueError or OSError if the first page is malformed."""
    max_pages = 512  # offsets of a damaged file may form a circle
    for number in range(max_pages):
        try:
            page, at = _directory_at(file, layout, at)
        except (ValueError, OverflowError, OSError):
            if number == 0:
                raise
            return  # some cameras write no valid offset after the only page
        yield page
        if at == 0:
            return


def _directory_at(file: BinaryIO, layout: TiffFormat, at: int) -> tuple[bytes, int]:
    """(entries as in the file, offset of the next directory). Raises ValueError for more entries than cameras write."""
    max_entries = 4096  # cameras write fewer than 100
    file.seek(at)
    count = _number(file, layout.tagnoformat)
    if count > max_entries:
        raise ValueError(f"a directory of {count} tags")
    return _exactly(file, count * layout.tagsize), _number(file, layout.offsetformat)


def _entries(file: BinaryIO, layout: TiffFormat, directory: bytes) -> Directory:
    """The entries with their values, without those of unknown types and those beyond the end of the file.

    Raises ValueError if they declare more bytes than any camera writes.
    """
    max_bytes = 1 << 25  # cameras write a few thousand
    result: Directory = {}
    declared = 0
    for tag, kind, number, value in struct.iter_unpack(layout.tagformat1 + layout.tagformat2[1:], directory):
        length = _SIZE.get(kind, 0) * number
        declared += length
        if declared > max_bytes:
            raise ValueError(f"its tags declare more than {max_bytes >> 20} MB")
        if length > layout.offsetsize:
            file.seek(struct.unpack(layout.offsetformat, value)[0])
            value = file.read(length)
        if 0 < length <= len(value):
            result[tag] = Entry(kind, number, _swapped(value[:length], kind, layout))
    return result


def _write_directory(file: BinaryIO, layout: TiffFormat, entries: Directory, following: int) -> int:
    """Append a directory, values first, and return its offset."""
    packed = struct.pack(layout.tagnoformat, len(entries))
    for tag, entry in sorted(entries.items()):
        value = _swapped(entry.data, entry.type, layout)
        if len(value) > layout.offsetsize:
            value = struct.pack(layout.offsetformat, _append(file, value))
        packed += struct.pack(layout.tagformat1 + layout.tagformat2[1:], tag, entry.type, entry.count, value)
    return _append(file, packed + struct.pack(layout.offsetformat, following))


def _append(file: BinaryIO, data: bytes) -> int:
    """Append data at an even offset, which the specification requires, and return the offset."""
    end = file.seek(0, 2)
    offset = end + file.write(b"\0" * (end % 2))
    file.write(data)
    return offset


def _swapped(value: bytes, kind: int, layout: TiffFormat) -> bytes:
    """A value converted between little-endian and a file's byte order."""
    if layout.byteorder == "<":
        return value
    size = struct.calcsize(f"<{TIFF.DATA_FORMATS[kind][-1]}")
    return np.frombuffer(value, f"u{size}").byteswap().tobytes()


def _number(file: BinaryIO, number_format: str) -> int:
    return int(struct.unpack(number_format, _exactly(file, struct.calcsize(number_format)))[0])


def _exactly(file: BinaryIO, length: int) -> bytes:
    data = file.read(length)
    if len(data) != length:
        raise ValueError("the file ends within a directory")
    return data
