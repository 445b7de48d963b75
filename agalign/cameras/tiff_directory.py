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

from PIL import Image
from tifffile import DATATYPE, TIFF

from agalign.pixels.raster import suffix_format

EXIF, GPS = 34665, 34853
"""Tags with the offset of a directory as value."""
XMP = 700
_SIZE = {kind: struct.calcsize(f"<{numbers}") for kind, numbers in TIFF.DATA_FORMATS.items()}
"""Bytes of a value of each type."""


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
        layout, at, pointer_at = _header(file)
        entries, following = _read_directory(file, layout, at)
        entries |= first
        for tag, directory in ((EXIF, exif), (GPS, gps)):
            if directory:
                entries[tag] = layout.pointer(_write_directory(file, layout, directory, 0))
        start = _write_directory(file, layout, entries, following)
        file.seek(pointer_at)
        file.write(struct.pack(layout.order + layout.offset, start))


@dataclass(frozen=True)
class _Layout:
    """Number formats of a file, as in the module `struct`: classic TIFF or BigTIFF, in either byte order."""

    order: str
    offset: str
    """Format of an offset, and of the number of values of an entry."""
    entries: str
    """Format of the number of entries of a directory."""

    @property
    def inline_bytes(self) -> int:
        """Length up to which values are stored in the entry itself."""
        return struct.calcsize(self.offset)

    def pointer(self, offset: int) -> Entry:
        """Return the offset of a directory as a tag's value: LONG, or LONG8 in a BigTIFF."""
        kind = DATATYPE.LONG8 if self.offset == "Q" else DATATYPE.LONG
        return Entry(kind, 1, struct.pack("<" + self.offset, offset))


def image_pages(path: Path) -> list[int]:
    """Return the numbers, from 1, of the pages of a TIFF that are images: not reduced ones, masks and sub-directories.

    Raises ValueError or OSError like `read_directories`.
    """
    with path.open("rb") as file:
        layout, at, _ = _header(file)
        if _raw_entries(file, layout, at)[1] == 0:  # most files: their tags are read only once, by `read_directories`
            return [1]
        kinds = [values(page[254]) if 254 in page else 0 for page in _pages(file)]
    reduced_or_mask = 1 | 4  # of the tag NewSubfileType
    return [number for number, kind in enumerate(kinds, 1) if not int(kind) & reduced_or_mask]


def _pages(file: BinaryIO) -> Iterator[Directory]:
    layout, at, _ = _header(file)
    first, following = _read_directory(file, layout, at)
    yield first
    max_pages = 512  # offsets of a damaged file may form a circle
    for _ in range(max_pages):
        if following == 0:
            return
        try:
            page, following = _read_directory(file, layout, following)
        except (ValueError, OverflowError, OSError):
            return  # some cameras write no valid offset after the only page
        yield page


def _read_all(file: BinaryIO, page: int = 0) -> dict[int, Directory]:
    layout, at, _ = _header(file)
    first, _ = _read_directory(file, layout, at)
    if page > 1:
        first |= next(islice(_pages(file), page - 1, None))
    result = {0: first, EXIF: Directory(), GPS: Directory()}
    for tag in (EXIF, GPS):
        if tag in first:
            place = int.from_bytes(first[tag].data[: _SIZE[first[tag].type]], "little")
            result[tag] = _read_directory(file, layout, place)[0]
    return result


def _header(file: BinaryIO) -> tuple[_Layout, int, int]:
    """(layout, offset of the first directory, position of that offset in the file)."""
    file.seek(0)
    head = file.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    version = struct.unpack_from(order + "H", head, 2)[0] if order is not None and len(head) >= 8 else 0
    if order is not None and version == 43 and len(head) == 16:
        return _Layout(order, "Q", "Q"), struct.unpack_from(order + "Q", head, 8)[0], 8
    if order is None or version != 42:
        raise ValueError("no TIFF header")
    return _Layout(order, "I", "H"), struct.unpack_from(order + "I", head, 4)[0], 4


def _read_directory(file: BinaryIO, layout: _Layout, at: int) -> tuple[Directory, int]:
    """(entries, offset of the next directory), without entries of unknown types and those beyond the end of the file.

    Raises ValueError if there are more entries, or they declare more bytes, than any camera writes.
    """
    max_bytes = 1 << 25  # cameras write a few thousand
    head = struct.Struct(f"{layout.order}HH{layout.offset}")
    size = head.size + layout.inline_bytes
    raw, following = _raw_entries(file, layout, at)
    result: Directory = {}
    declared = 0
    for start in range(0, len(raw), size):
        tag, kind, number = head.unpack_from(raw, start)
        length, value = _SIZE.get(kind, 0) * number, raw[start + head.size : start + size]
        declared += length
        if declared > max_bytes:
            raise ValueError(f"its tags declare more than {max_bytes >> 20} MB")
        if length > layout.inline_bytes:
            file.seek(struct.unpack(layout.order + layout.offset, value)[0])
            value = file.read(length)
        if 0 < length <= len(value):
            result[tag] = Entry(kind, number, _swapped(value[:length], kind, layout.order))
    return result, following


def _raw_entries(file: BinaryIO, layout: _Layout, at: int) -> tuple[bytes, int]:
    """(entries as in the file, offset of the next directory)."""
    max_entries = 4096  # cameras write fewer than 100
    file.seek(at)
    (count,) = struct.unpack(layout.order + layout.entries, _exactly(file, struct.calcsize(layout.entries)))
    if count > max_entries:
        raise ValueError(f"a directory of {count} tags")
    raw = _exactly(file, count * (struct.calcsize(f"{layout.order}HH{layout.offset}") + layout.inline_bytes))
    (following,) = struct.unpack(layout.order + layout.offset, _exactly(file, layout.inline_bytes))
    return raw, following


def _write_directory(file: BinaryIO, layout: _Layout, entries: Directory, following: int) -> int:
    """Append a directory, values first, and return its offset."""
    packed = []
    for tag, entry in sorted(entries.items()):
        value = _swapped(entry.data, entry.type, layout.order)
        if len(value) > layout.inline_bytes:
            value = struct.pack(layout.order + layout.offset, _append(file, value))
        head = struct.pack(f"{layout.order}HH{layout.offset}", tag, entry.type, entry.count)
        packed.append(head + value.ljust(layout.inline_bytes, b"\0"))
    count = struct.pack(layout.order + layout.entries, len(packed))
    return _append(file, count + b"".join(packed) + struct.pack(layout.order + layout.offset, following))


def _append(file: BinaryIO, data: bytes) -> int:
    """Append data at an even offset, which the specification requires, and return the offset."""
    end = file.seek(0, 2)
    offset = end + file.write(b"\0" * (end % 2))
    file.write(data)
    return offset


def _swapped(value: bytes, kind: int, order: str) -> bytes:
    """A value converted between little-endian and a file's byte order."""
    size = struct.calcsize(f"<{TIFF.DATA_FORMATS[kind][-1]}")
    if order == "<" or size == 1:
        return value
    return b"".join(value[i : i + size][::-1] for i in range(0, len(value), size))


def _exactly(file: BinaryIO, length: int) -> bytes:
    data = file.read(length)
    if len(data) != length:
        raise ValueError("the file ends within a directory")
    return data
