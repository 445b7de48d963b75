"""The tags of a camera file that still hold for its band on the reference's grid: TIFF, Exif and GPS tags and the XMP
packet, with the reference's geometry in place of the band's own, as photogrammetry software needs them.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from agalign.cameras import camera_of
from agalign.cameras.metadata import read_tags
from agalign.cameras.pix4d import FromSource
from agalign.cameras.tiff_directory import (
    EXIF,
    GPS,
    XMP,
    Directory,
    byte_string,
    long,
    number,
    rational,
    read_directories,
)
from agalign.cameras.xmp import Packet
from agalign.errors import UnreadableFileError
from agalign.values.capture import Band
from agalign.values.image import OutputGrid

_ORIENTATION = 274
_BLACK_LEVEL = {50713, 50714}
_OF_THE_FILE = {270, 271, 272, 305, 306, 315, 33432, 50735, 50827} | _BLACK_LEVEL
"""Description, make, model, firmware, time, artist, copyright, serial number, original name, black level."""
_OF_THE_CAPTURE = {271, 272, 306, 33432, 50735}
_NOT_CARRIED = {37500, 40965}
"""A maker's note holds places in the old file; the interoperability directory is one."""
_DENSITIES = {41486, 41487}
_GEOMETRIC_EXIF = _DENSITIES | {37386, 41488, 41989}
_EXIF_SIZES = (40962, 40963)
_EXIF_OF_THE_CAPTURE = _GEOMETRIC_EXIF | {36864, 36867, 36868, 36880, 36881, 36882, 37520, 37521, 37522, 42033, 42036}
"""For a stack, with bands of different exposure: version, times, body and lens."""


@dataclass(frozen=True)
class TransferredTags:
    """Entries for an aligned file."""

    first: Directory
    exif: Directory
    gps: Directory


def capture_tags(reference: Band, grid: OutputGrid) -> TransferredTags:
    """For a stack: what is true of all bands of a capture."""
    source = _directories(reference.path)
    first = _some(source[0], _OF_THE_CAPTURE | {_ORIENTATION})
    return TransferredTags(first, _on_grid(_some(source[EXIF], _EXIF_OF_THE_CAPTURE), source[EXIF], grid), source[GPS])


def band_tags(
    source: Path, reference: Band, grid: OutputGrid, from_source: FromSource, *, radiometry: bool = False
) -> TransferredTags:
    """For a file with aligned bands from `source`.

    With `radiometry` black level, vignetting and exposure have been taken out of the pixels.
    """
    own, of_reference = _directories(source), _directories(reference.path)
    first = _some(own[0], _OF_THE_FILE - _BLACK_LEVEL if radiometry else _OF_THE_FILE)
    first |= _some(of_reference[0], {_ORIENTATION})
    exif = {tag: entry for tag, entry in own[EXIF].items() if tag not in _NOT_CARRIED | _GEOMETRIC_EXIF}
    packet = Packet.parse(own[0][XMP].data if XMP in own[0] else b"")
    with suppress(UnreadableFileError):
        reference_packet = Packet.parse(of_reference[0][XMP].data if XMP in of_reference[0] else b"")
        reference_tags, own_tags = read_tags(reference.path), read_tags(source)
        transfer = camera_of(reference_tags).tag_transfer
        transfer.put_geometry(packet, reference_packet, reference, reference_tags, grid)
        transfer = camera_of(own_tags).tag_transfer
        transfer.put_vignetting(packet, own_tags, grid, from_source, radiometry=radiometry)
        if serialised := packet.serialised():
            first[XMP] = byte_string(serialised)
    return TransferredTags(first, _on_grid(exif, of_reference[EXIF], grid), own[GPS])


def _directories(path: Path) -> dict[int, Directory]:
    """A file's directories; empty ones where they are damaged, because its pixels may still be good."""
    try:
        return read_directories(path)
    except Exception:  # a damaged file makes a reader fail in any way
        return {0: {}, EXIF: {}, GPS: {}}


def _some(directory: Directory, tags: Iterable[int]) -> Directory:
    return {tag: directory[tag] for tag in tags if tag in directory}


def _on_grid(exif: Directory, reference: Directory, grid: OutputGrid) -> Directory:
    """With the reference's focal length and pixel density, and the size that is written."""
    result = exif | _some(reference, _GEOMETRIC_EXIF)
    for tag in _DENSITIES & result.keys() if grid.scale.mean != 1 else ():
        density = number(result[tag])
        if density is not None and density > 0:
            with suppress(ValueError):  # a density that no camera has
                result[tag] = rational(grid.scale.mean * density)
    sizes = zip(_EXIF_SIZES, (grid.width, grid.height), strict=True)
    return result | {tag: long(size) for tag, size in sizes if tag in result}
