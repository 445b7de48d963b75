"""Tags for aligned files, as photogrammetry software needs them: TIFF, Exif and GPS tags and the XMP packet of the
input file, with the lens and rig of the reference instead of the band's own.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

from PIL.ExifTags import Base

from agalign.cameras import camera_of
from agalign.cameras.metadata import finite, read_tags
from agalign.cameras.pix4d import GridVignetting
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

_CAPTURE_TAGS: set[int] = {Base.Make, Base.Model, Base.DateTime, Base.Copyright, Base.CameraSerialNumber}
"""Tags of the first directory that are the same for all bands of a capture."""
_GEOMETRIC_EXIF: set[int] = {
    Base.FocalPlaneXResolution,
    Base.FocalPlaneYResolution,
    Base.FocalPlaneResolutionUnit,
    Base.FocalLength,
    Base.FocalLengthIn35mmFilm,
}


@dataclass(frozen=True)
class TransferredTags:
    """Entries for the first, the Exif and the GPS directory of an aligned file."""

    first: Directory
    exif: Directory
    gps: Directory


def capture_tags(reference: Band, grid: OutputGrid) -> TransferredTags:
    """Return the tags for a stack: those that apply to all bands of a capture, whose exposures differ."""
    source = _directories(reference)
    first = _some(source[0], _CAPTURE_TAGS | {Base.Orientation})
    times = {tag for tag in Base if tag.name.startswith(("DateTime", "OffsetTime", "SubsecTime"))}
    exif = _some(source[EXIF], times | {Base.ExifVersion, Base.BodySerialNumber, Base.LensModel})
    return TransferredTags(first, _on_grid(exif, source[EXIF], grid), source[GPS])


def band_tags(
    source: Band, reference: Band, grid: OutputGrid, vignetting: GridVignetting | None, *, radiometry: bool = False
) -> TransferredTags:
    """Return the tags for a file with aligned bands from the file, or the page, of `source`.

    `vignetting` is that of the band; None if the pixels are corrected for it. With `radiometry` they are also corrected
    for black level and exposure, and all their tags are left out.
    """
    own, of_reference = _directories(source), _directories(reference)
    black_level: set[int] = set() if radiometry else {Base.BlackLevelRepeatDim, Base.BlackLevel}
    of_file = {Base.ImageDescription, Base.Software, Base.Artist, Base.OriginalRawFileName}
    first = _some(own[0], _CAPTURE_TAGS | black_level | of_file) | _some(of_reference[0], {Base.Orientation})
    with_offsets = {Base.MakerNote, Base.ExifInteroperabilityOffset}  # these refer to the old file
    exif = {tag: entry for tag, entry in own[EXIF].items() if tag not in with_offsets | _GEOMETRIC_EXIF}
    packet, reference_packet = (Packet.parse(d[0][XMP].data if XMP in d[0] else b"") for d in (own, of_reference))
    with suppress(UnreadableFileError):
        reference_tags, own_tags = (read_tags(band.path, band.page) for band in (reference, source))
        transfer = camera_of(reference_tags).tag_transfer
        transfer.put_geometry(packet, reference_packet, reference, reference_tags, grid)
        transfer = camera_of(own_tags).tag_transfer
        transfer.put_radiometry(packet, own_tags, vignetting, radiometry=radiometry)
        if serialised := packet.serialised():
            first[XMP] = byte_string(serialised)
    return TransferredTags(first, _on_grid(exif, of_reference[EXIF], grid), own[GPS])


def _directories(band: Band) -> dict[int, Directory]:
    """The directories of a file; empty if they are damaged, because the pixels may still be good."""
    try:
        return read_directories(band.path, band.page)
    except Exception:  # a damaged file causes any exception
        return {0: {}, EXIF: {}, GPS: {}}


def _some(directory: Directory, tags: Iterable[int]) -> Directory:
    return {tag: directory[tag] for tag in tags if tag in directory}


def _on_grid(exif: Directory, reference: Directory, grid: OutputGrid) -> Directory:
    """The Exif directory with the focal length and pixel density of the reference, and the size of the output."""
    result = exif | _some(reference, _GEOMETRIC_EXIF)
    densities: set[int] = {Base.FocalPlaneXResolution, Base.FocalPlaneYResolution}
    for tag in densities & result.keys() if grid.scale.mean != 1 else ():
        density = finite(values(result[tag]))
        if density is not None and density > 0:
            with suppress(ValueError):  # too large for a fraction: a damaged tag
                result[tag] = rational(grid.scale.mean * density)
    sizes = {Base.ExifImageWidth: grid.width, Base.ExifImageHeight: grid.height}
    return result | {tag: long(size) for tag, size in sizes.items() if tag in result}
