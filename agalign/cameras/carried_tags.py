"""What is still true of a camera file once its band lies on the reference's grid: TIFF, Exif and GPS tags and the XMP
packet, with the reference's geometry in place of the band's own, so that photogrammetry software takes the pixels for
what they are.
"""

import math
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from agalign.cameras.metadata import Tags, read_tags
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
from agalign.cameras.xmp import Name, Packet
from agalign.errors import UnreadableFileError
from agalign.values.capture import Band
from agalign.values.image import OutputGrid

_ORIENTATION, _UPSIDE_DOWN = 274, 3
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
"""Of a stack, whose bands were exposed differently: version, times, body and lens."""

_PRINCIPAL_POINT: Name = ("Camera", "PrincipalPoint")
_FOCAL_LENGTH: Name = ("Camera", "PerspectiveFocalLength")
_DISTORTION: Name = ("Camera", "PerspectiveDistortion")
_AFFINE: Name = ("Camera", "FisheyeAffineMatrix")
_FOCAL_LENGTH_UNITS: Name = ("Camera", "PerspectiveFocalLengthUnits")
_MODEL_TYPE: Name = ("Camera", "ModelType")
_FISHEYE: tuple[Name, ...] = (("Camera", "FisheyePolynomial"), _AFFINE, ("Camera", "FisheyeAffineSymmetric"))
_DEWARP: Name = ("drone-dji", "DewarpData")
_CENTRE: tuple[Name, Name] = (("drone-dji", "CalibratedOpticalCenterX"), ("drone-dji", "CalibratedOpticalCenterY"))
_IN_PX: tuple[Name, ...] = (
    ("drone-dji", "CalibratedFocalLength"), ("drone-dji", "RelativeOpticalCenterX"),
    ("drone-dji", "RelativeOpticalCenterY"), _AFFINE,
)  # fmt: skip
_GEOMETRY: frozenset[Name] = frozenset({
    _PRINCIPAL_POINT, _FOCAL_LENGTH, _FOCAL_LENGTH_UNITS, _DISTORTION, _MODEL_TYPE, *_FISHEYE,
    ("Camera", "RigRelatives"), ("Camera", "RigTranslations"), ("Camera", "RigRelativesReferenceRigCameraIndex"),
    *_CENTRE, _DEWARP, *_IN_PX, ("drone-dji", "DewarpFlag"), ("drone-dji", "DewarpHMatrix"),
    ("drone-dji", "CalibratedHMatrix"),
})  # fmt: skip
_OF_THE_SENSOR: frozenset[Name] = frozenset({
    ("Camera", "InvalidPixel"), ("Camera", "VignettingPolynomial2D"), ("Camera", "VignettingPolynomial2DName"),
    ("drone-dji", "VignettingData"),
})  # fmt: skip
"""True of the sensor's own pixels only."""
_VIGNETTING_CENTRE: Name = ("Camera", "VignettingCenter")
_VIGNETTING_POLYNOMIAL: Name = ("Camera", "VignettingPolynomial")
_VIGNETTING: frozenset[Name] = frozenset({_VIGNETTING_CENTRE, _VIGNETTING_POLYNOMIAL})
_RADIOMETRY: frozenset[Name] = _VIGNETTING | {
    ("Camera", "BlackCurrent"), ("drone-dji", "BlackLevel"), ("MicaSense", "RadiometricCalibration"),
    ("MicaSense", "DarkRowValue"),
}  # fmt: skip
_MOST_MAGNIFICATION = 1.02
"""Beyond this a polynomial of vignetting in the band's own pixels is dropped."""


@dataclass(frozen=True)
class CarriedTags:
    """Entries for an aligned file."""

    first: Directory
    exif: Directory
    gps: Directory


FromSource = Callable[[float, float], tuple[float, float]]
"""Where a pixel of the band's own file lies in the reference's pixels; nan where that cannot be told."""


def capture_tags(reference: Band, grid: OutputGrid) -> CarriedTags:
    """For a stack: what is true of all bands of a capture."""
    source = _directories(reference.path)
    first = _some(source[0], _OF_THE_CAPTURE | {_ORIENTATION})
    return CarriedTags(first, _on_grid(_some(source[EXIF], _EXIF_OF_THE_CAPTURE), source[EXIF], grid), source[GPS])


def band_tags(
    source: Path, reference: Band, grid: OutputGrid, from_source: FromSource, *, radiometry: bool = False
) -> CarriedTags:
    """For a file whose aligned bands came from `source`.

    With `radiometry` black level, vignetting and exposure have been taken out of the pixels.
    """
    own, theirs = _directories(source), _directories(reference.path)
    first = _some(own[0], _OF_THE_FILE - _BLACK_LEVEL if radiometry else _OF_THE_FILE)
    first |= _some(theirs[0], {_ORIENTATION})
    exif = {tag: entry for tag, entry in own[EXIF].items() if tag not in _NOT_CARRIED | _GEOMETRIC_EXIF}
    packet = Packet.parse(own[0][XMP].data if XMP in own[0] else b"")
    with suppress(UnreadableFileError):
        theirs_packet = Packet.parse(theirs[0][XMP].data if XMP in theirs[0] else b"")
        _put_geometry(packet, theirs_packet, reference, grid)
        _put_vignetting(packet, read_tags(source), grid, from_source, radiometry=radiometry)
        if serialised := packet.serialised():
            first[XMP] = byte_string(serialised)
    return CarriedTags(first, _on_grid(exif, theirs[EXIF], grid), own[GPS])


def _directories(path: Path) -> dict[int, Directory]:
    """A file whose directories cannot be followed gives none: its pixels are good all the same."""
    with suppress(ValueError, OSError, struct.error):
        return read_directories(path)
    return {0: {}, EXIF: {}, GPS: {}}


def _some(directory: Directory, tags: Iterable[int]) -> Directory:
    return {tag: directory[tag] for tag in tags if tag in directory}


def _on_grid(exif: Directory, reference: Directory, grid: OutputGrid) -> Directory:
    """With the reference's focal length and pixel density, and the size that is written."""
    found = exif | _some(reference, _GEOMETRIC_EXIF)
    for tag in _DENSITIES & found.keys() if grid.scale != 1 else ():
        density = number(found[tag])
        if density is not None and density > 0:
            with suppress(ValueError):  # a density that no camera has
                found[tag] = rational(grid.scale * density)
    sizes = zip(_EXIF_SIZES, (grid.width, grid.height), strict=True)
    return found | {tag: long(size) for tag, size in sizes if tag in found}


def _put_geometry(packet: Packet, theirs: Packet, reference: Band, grid: OutputGrid) -> None:
    tags = read_tags(reference.path)
    packet.take(theirs, _GEOMETRY)
    packet.remove(_OF_THE_SENSOR)
    density, point = tags.pixels_per_mm, tags.numbers(*_PRINCIPAL_POINT)
    if density and len(point) == 2:
        turned = tags.orientation == _UPSIDE_DOWN
        x, y = (v * density for v in point)
        stored = (reference.width_px - x, reference.height_px - y) if turned else (x, y)
        x, y = grid.px(*stored)
        written = (grid.width - x, grid.height - y) if turned else (x, y)
        packet.put(_PRINCIPAL_POINT, [_number(v / (density * grid.scale)) for v in written])
    if tags.focal_length_is_in_px:
        _scale(packet, tags, _FOCAL_LENGTH, grid.scale)
    for name in _IN_PX:
        _scale(packet, tags, name, grid.scale)
    centre = [tags.number(*name) for name in _CENTRE]
    if centre[0] is not None and centre[1] is not None:
        for name, value in zip(_CENTRE, grid.px(centre[0], centre[1]), strict=True):
            packet.put(name, [_number(value)])
    date, _, dewarp = tags.text(*_DEWARP).rpartition(";")
    with suppress(ValueError):
        terms = [float(v) for v in dewarp.split(",")]
        terms = [v * grid.scale for v in terms[:4]] + [0.0 if grid.undistorted else v for v in terms[4:]]
        packet.put(_DEWARP, [f"{date};" + ",".join(map(_number, terms))])
    if grid.undistorted:
        packet.put(_DISTORTION, ["0"] * len(tags.numbers(*_DISTORTION)))
        if tags.numbers(*_AFFINE) and density and reference.lens is not None:
            # What was a fisheye is a pinhole now.
            packet.remove(_FISHEYE)
            packet.put(_MODEL_TYPE, ["perspective"])
            packet.add(_FOCAL_LENGTH, _number(reference.lens.fx_px / density))
            packet.add(_FOCAL_LENGTH_UNITS, "mm")


def _put_vignetting(packet: Packet, tags: Tags, grid: OutputGrid, from_source: FromSource, *, radiometry: bool) -> None:
    """The centre where it lies now, and the polynomial in the pixels that are written."""
    centre, k = tags.numbers(*_VIGNETTING_CENTRE), tags.numbers(*_VIGNETTING_POLYNOMIAL)
    if radiometry:
        packet.remove(_RADIOMETRY)
        return
    if len(centre) != 2:
        return
    here, beside = from_source(*centre), from_source(centre[0] + 1, centre[1])
    magnification = math.dist(here, beside)
    # Written so that nan passes nowhere.
    if not 1 / _MOST_MAGNIFICATION < magnification < _MOST_MAGNIFICATION:
        packet.remove(_VIGNETTING)
        return
    packet.put(_VIGNETTING_CENTRE, [_number(v) for v in grid.px(*here)])
    scaled = [v / (grid.scale * magnification) ** i for i, v in enumerate(k, start=1)]
    packet.put(_VIGNETTING_POLYNOMIAL, [f"{v:.9e}" for v in scaled])


def _scale(packet: Packet, tags: Tags, name: Name, factor: float) -> None:
    values = tags.numbers(*name)
    if values and factor != 1:
        packet.put(name, [_number(v * factor) for v in values])


def _number(value: float) -> str:
    return f"{value:.10g}"
