"""Tags for aligned files, as photogrammetry software needs them: TIFF, Exif and GPS tags and the XMP packet of the
input file, with the lens and rig of the reference instead of the band's own.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL.ExifTags import Base

from agalign.cameras import camera_of
from agalign.cameras.metadata import finite, read_tags
from agalign.cameras.pix4d import FromSource
from agalign.cameras.tiff_directory import (
    EXIF,
    GPS,
    XMP,
    Directory,
    byte_string,
    long,
    rational,
    read_directories,
    values,
)
from agalign.cameras.xmp import Packet
from agalign.errors import UnreadableFileError
from agalign.values.capture import Band
from agalign.values.image import OutputGrid

_BLACK_LEVEL: set[int] = {Base.BlackLevelRepeatDim, Base.BlackLevel}
_CAPTURE_TAGS: set[int] = {Base.Make, Base.Model, Base.DateTime, Base.Copyright, Base.CameraSerialNumber}
"""Tags of the first directory that are the same for all bands of a capture."""
_FILE_TAGS = (
    _CAPTURE_TAGS | _BLACK_LEVEL | {Base.ImageDescription, Base.Software, Base.Artist, Base.OriginalRawFileName}
)
_NOT_COPIED: set[int] = {Base.MakerNote, Base.ExifInteroperabilityOffset}
"""Tags with offsets in the old file."""
_DENSITIES: set[int] = {Base.FocalPlaneXResolution, Base.FocalPlaneYResolution}
_GEOMETRIC_EXIF = _DENSITIES | {Base.FocalLength, Base.FocalPlaneResolutionUnit, Base.FocalLengthIn35mmFilm}
_CAPTURE_EXIF = _GEOMETRIC_EXIF | {
    Base.ExifVersion,
    Base.DateTimeOriginal,
    Base.DateTimeDigitized,
    Base.OffsetTime,
    Base.OffsetTimeOriginal,
    Base.OffsetTimeDigitized,
    Base.SubsecTime,
    Base.SubsecTimeOriginal,
    Base.SubsecTimeDigitized,
    Base.BodySerialNumber,
    Base.LensModel,
}
"""Exif tags for a stack: exposure differs between its bands."""


@dataclass(frozen=True)
class TransferredTags:
    """Entries for the first, the Exif and the GPS directory of an aligned file."""

    first: Directory
    exif: Directory
    gps: Directory


def capture_tags(reference: Band, grid: OutputGrid) -> TransferredTags:
    """Return the tags for a stack: those that apply to all bands of a capture."""
    source = _directories(reference.path)
    first = _some(source[0], _CAPTURE_TAGS | {Base.Orientation})
    return TransferredTags(first, _on_grid(_some(source[EXIF], _CAPTURE_EXIF), source[EXIF], grid), source[GPS])


def band_tags(
    source: Path, reference: Band, grid: OutputGrid, from_source: FromSource, *, radiometry: bool = False
) -> TransferredTags:
    """Return the tags for a file with aligned bands from the file `source`.

    With `radiometry` the pixels are corrected for black level, vignetting and exposure, and their tags are left out.
    """
    own, of_reference = _directories(source), _directories(reference.path)
    first = _some(own[0], _FILE_TAGS - _BLACK_LEVEL if radiometry else _FILE_TAGS)
    first |= _some(of_reference[0], {Base.Orientation})
    exif = {tag: entry for tag, entry in own[EXIF].items() if tag not in _NOT_COPIED | _GEOMETRIC_EXIF}
    packet, reference_packet = (Packet.parse(d[0][XMP].data if XMP in d[0] else b"") for d in (own, of_reference))
    with suppress(UnreadableFileError):
        reference_tags, own_tags = read_tags(reference.path), read_tags(source)
        transfer = camera_of(reference_tags).tag_transfer
        transfer.put_geometry(packet, reference_packet, reference, reference_tags, grid)
        transfer = camera_of(own_tags).tag_transfer
        transfer.put_vignetting(packet, own_tags, grid, from_source, radiometry=radiometry)
        if serialised := packet.serialised():
            first[XMP] = byte_string(serialised)
    return TransferredTags(first, _on_grid(exif, of_reference[EXIF], grid), own[GPS])


def _directories(path: Path) -> dict[int, Directory]:
    """The directories of a file; empty if they are damaged, because the pixels may still be good."""
    try:
        return read_directories(path)
    except Exception:  # a damaged file causes any exception
        return {0: {}, EXIF: {}, GPS: {}}


def _some(directory: Directory, tags: Iterable[int]) -> Directory:
    return {tag: directory[tag] for tag in tags if tag in directory}


def _on_grid(exif: Directory, reference: Directory, grid: OutputGrid) -> Directory:
    """The Exif directory with the focal length and pixel density of the reference, and the size of the output."""
    result = exif | _some(reference, _GEOMETRIC_EXIF)
    for tag in _DENSITIES & result.keys() if grid.scale.mean != 1 else ():
        density = finite(values(result[tag]))
        if density is not None and density > 0:
            with suppress(ValueError):  # too large for a fraction: a damaged tag
                result[tag] = rational(grid.scale.mean * density)
    sizes = {Base.ExifImageWidth: grid.width, Base.ExifImageHeight: grid.height}
    return result | {tag: long(size) for tag, size in sizes.items() if tag in result}
