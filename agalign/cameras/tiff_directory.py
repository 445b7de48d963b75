"""The directories of a TIFF, entry by entry: what rasterio and tifffile do not write, Exif and GPS, is added to a
finished file. Classic TIFF and BigTIFF, TIFF 6.0 and the EXIF specification.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from PIL import Image

EXIF, GPS = 34665, 34853
"""Tags with the offset of a directory as value."""
XMP = 700
_SIZE = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Bytes of a value of each type."""
_NUMBER_SIZE = {**_SIZE, 5: 4, 10: 4}
"""Bytes of the numbers to swap: a rational is two numbers."""
_RATIONAL, _SIGNED_RATIONAL = 5, 10
_MAX_BYTES = 1 << 25
"""Of the tags of one file: cameras write a few thousand. Its pixels are elsewhere."""
_MAX_ENTRIES = 4096
"""Of a directory: cameras write fewer than 100; a damaged count must not be followed."""
_MAX_LONG = (1 << 32) - 1
_MILLION = 1_000_000
_MAX_MILLIONTHS = 4000
"""Values below fit into 32 bits as millionths."""
_HEADER_BYTES, _BIG_HEADER_BYTES = 8, 16
_TIFF, _BIG_TIFF = 42, 43
"""Version numbers."""


@dataclass(frozen=True)
class Entry:
    """A tag's value: its TIFF type, how many there are, and their bytes, little-endian."""

    type: int
    count: int
    data: bytes


Directory = dict[int, Entry]


def short(*values: int) -> Entry:
    """16-bit numbers."""
    return Entry(3, len(values), struct.pack(f"<{len(values)}H", *values))


def long(*values: int) -> Entry:
    """32-bit numbers."""
    return Entry(4, len(values), struct.pack(f"<{len(values)}I", *values))


def text(value: str) -> Entry:
    """A text; other characters than ASCII are written as UTF-8, which most readers expect."""
    data = value.encode() + b"\0"
    return Entry(2, len(data), data)


def byte_string(value: bytes, kind: int = 1) -> Entry:
    """Bytes; `kind` is 1 for BYTE or 7 for UNDEFINED."""
    return Entry(kind, len(value), value)


def rational(*values: float) -> Entry:
    """Fractions, of millionths where they fit into 32 bits. Raises ValueError for values that do not fit."""
    pairs = b""
    for value in values:
        if not 0 <= value < _MAX_LONG:
            raise ValueError(f"{value} does not fit into a TIFF fraction")
        denominator = _MILLION if value < _MAX_MILLIONTHS else max(1, int(_MAX_LONG / (value + 1)))
        pairs += struct.pack("<II", round(value * denominator), denominator)
    return Entry(_RATIONAL, len(values), pairs)


def number(entry: Entry) -> float | None:
    """The first value of an entry of numbers; None for other entries and for a denominator of 0."""
    formats = {3: "<H", 4: "<I", 8: "<h", 9: "<i", 11: "<f", 12: "<d"}
    if entry.type in (_RATIONAL, _SIGNED_RATIONAL):
        numerator, denominator = struct.unpack_from("<II" if entry.type == _RATIONAL else "<ii", entry.data)
        return numerator / denominator if denominator else None
    return float(struct.unpack_from(formats[entry.type], entry.data)[0]) if entry.type in formats else None


def read_directories(path: Path) -> dict[int, Directory]:
    """{0: the first directory, EXIF: …, GPS: …} of a TIFF, or of the Exif part of a JPEG, with its XMP.

    Raises ValueError where the file is malformed, OSError where it cannot be read.
    """
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return _read_all(file)
    with Image.open(path, formats=("JPEG",)) as image:
        block, packet = image.info.get("exif", b""), image.info.get("xmp", b"")
    result = _read_all(BytesIO(block[6:])) if block.startswith(b"Exif\0\0") else {0: {}, EXIF: {}, GPS: {}}
    if packet:
        result[0][XMP] = byte_string(packet)
    return result


def check_directories(path: Path) -> None:
    """Raises ValueError where a TIFF is malformed or its tags declare more bytes than any camera writes."""
    with path.open("rb") as file:
        layout, at, _ = _header(file)
        first = _entries(file, layout, at)[0]
        declared = sum(length for _, _, _, length, _ in first)
        for tag, kind, _, _, value in first:
            if tag in (EXIF, GPS) and kind in _SIZE:
                place = _swapped(value[: _SIZE[kind]], kind, layout.order)
                declared += sum(e[3] for e in _entries(file, layout, int.from_bytes(place, "little"))[0])
    if declared > _MAX_BYTES:
        raise ValueError(f"its tags declare {declared >> 20} MB")


def add_directories(path: Path, first: Mapping[int, Entry], exif: Directory, gps: Directory) -> None:
    """Give a finished TIFF these entries in its first directory, and these Exif and GPS directories.

    The first directory is rewritten at the end of the file; pixels stay where they are.
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


# ---- within


@dataclass(frozen=True)
class _Layout:
    """How a file writes numbers: classic TIFF or BigTIFF, in either byte order."""

    order: str
    offset: str
    """Format of an offset, and of a value's count."""
    entries: str
    """Format of a directory's number of entries."""

    @property
    def inline_bytes(self) -> int:
        """Values up to this length are stored in the entry itself."""
        return struct.calcsize(self.offset)

    def pointer(self, place: int) -> Entry:
        """The place of a directory as a tag's value: LONG, or LONG8 in a BigTIFF."""
        return Entry(16 if self.offset == "Q" else 4, 1, struct.pack("<" + self.offset, place))


def _read_all(file: BinaryIO) -> dict[int, Directory]:
    layout, at, _ = _header(file)
    first, _ = _read_directory(file, layout, at)
    result = {0: first, EXIF: Directory(), GPS: Directory()}
    for tag in (EXIF, GPS):
        if tag in first:
            place = int.from_bytes(first[tag].data[: _SIZE[first[tag].type]], "little")
            result[tag] = _read_directory(file, layout, place)[0]
    return result


def _header(file: BinaryIO) -> tuple[_Layout, int, int]:
    """(layout, where the first directory is, where that is written)."""
    file.seek(0)
    head = file.read(_BIG_HEADER_BYTES)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or len(head) < _HEADER_BYTES:
        raise ValueError("no TIFF header")
    (version,) = struct.unpack_from(order + "H", head, 2)
    if version == _BIG_TIFF and len(head) == _BIG_HEADER_BYTES:
        return _Layout(order, "Q", "Q"), struct.unpack_from(order + "Q", head, 8)[0], 8
    if version != _TIFF:
        raise ValueError("no TIFF header")
    return _Layout(order, "I", "H"), struct.unpack_from(order + "I", head, 4)[0], 4


def _read_directory(file: BinaryIO, layout: _Layout, at: int) -> tuple[Directory, int]:
    """(entries, where the next directory is)."""
    entries, following = _entries(file, layout, at)
    result: Directory = {}
    left = _MAX_BYTES
    for tag, kind, number, length, value in entries:
        if length == 0 or length > left:
            continue
        left -= length
        if length > layout.inline_bytes:
            file.seek(struct.unpack(layout.order + layout.offset, value)[0])
            value = _exactly(file, length)
        result[tag] = Entry(kind, number, _swapped(value[:length], kind, layout.order))
    return result, following


def _entries(file: BinaryIO, layout: _Layout, at: int) -> tuple[list[tuple[int, int, int, int, bytes]], int]:
    """((tag, type, count, length in bytes, the value or its place) of each entry, where the next directory is)."""
    entry_format = f"{layout.order}HH{layout.offset}"
    fixed = struct.calcsize(entry_format)
    file.seek(at)
    (count,) = struct.unpack(layout.order + layout.entries, _exactly(file, struct.calcsize(layout.entries)))
    if count > _MAX_ENTRIES:
        raise ValueError(f"a directory of {count} tags")
    size = fixed + layout.inline_bytes
    raw = _exactly(file, count * size)
    (following,) = struct.unpack(layout.order + layout.offset, _exactly(file, layout.inline_bytes))
    result = []
    for start in range(0, len(raw), size):
        tag, kind, number = struct.unpack_from(entry_format, raw, start)
        result.append((tag, kind, number, _SIZE.get(kind, 0) * number, raw[start + fixed : start + size]))
    return result, following


def _write_directory(file: BinaryIO, layout: _Layout, entries: Directory, following: int) -> int:
    """Append a directory, values first, and return where it is."""
    packed = []
    for tag, entry in sorted(entries.items()):
        value = _swapped(entry.data, entry.type, layout.order)
        if len(value) > layout.inline_bytes:
            value = struct.pack(layout.order + layout.offset, _append(file, value))
        place = struct.pack(f"{layout.order}HH{layout.offset}", tag, entry.type, entry.count)
        packed.append(place + value.ljust(layout.inline_bytes, b"\0"))
    count = struct.pack(layout.order + layout.entries, len(packed))
    return _append(file, count + b"".join(packed) + struct.pack(layout.order + layout.offset, following))


def _append(file: BinaryIO, data: bytes) -> int:
    """Write at the file's end, on an even place as the specification wants it; returns the place."""
    end = file.seek(0, 2)
    place = end + file.write(b"\0" * (end % 2))
    file.write(data)
    return place


def _swapped(value: bytes, kind: int, order: str) -> bytes:
    """A value converted between little-endian and a file's byte order."""
    size = _NUMBER_SIZE[kind]
    if order == "<" or size == 1:
        return value
    return b"".join(value[i : i + size][::-1] for i in range(0, len(value), size))


def _exactly(file: BinaryIO, length: int) -> bytes:
    data = file.read(length)
    if len(data) != length:
        raise ValueError("the file ends within a directory")
    return data
