"""Tags for aligned files, as photogrammetry software needs them: TIFF, Exif and GPS tags and the XMP packet of the
input file, with the lens and rig of the reference instead of the band's own.
"""

import math
import struct
from collections.abc import Iterable
from contextlib import suppress
from functools import partial

from PIL.ExifTags import Base

from agalign.cameras import dji, dls, micasense, pix4d, tiff_directory
from agalign.cameras.makers import camera_of
from agalign.cameras.metadata import Tags, finite, tags_of
from agalign.cameras.parrot import Sequoia
from agalign.cameras.pix4d import SAME_ROWS, GridRows, GridVignetting
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, Directory
from agalign.cameras.xmp import Packet, names_in
from agalign.values import geometry
from agalign.values.capture import Band, is_clock_set
from agalign.values.image import OutputGrid

_CAPTURE_TAGS: set[int] = {Base.Make, Base.Model, Base.Copyright, Base.CameraSerialNumber}
"""Tags of the first directory that are the same for all bands of a capture."""
_TIMES = {tag for tag in Base if tag.name.startswith(("DateTime", "OffsetTime", "SubsecTime"))}
_GEOMETRIC_EXIF: set[int] = {
    Base.FocalPlaneXResolution,
    Base.FocalPlaneYResolution,
    Base.FocalPlaneResolutionUnit,
    Base.FocalLength,
    Base.FocalLengthIn35mmFilm,
}


_of_pix4d, _of_dji = partial(names_in, pix4d.NAMESPACE), partial(names_in, dji.NAMESPACE)
_IN_PX = _of_pix4d("FisheyeAffineMatrix") + _of_dji(
    "CalibratedFocalLength RelativeOpticalCenterX RelativeOpticalCenterY"
)
"""Lengths in px, which are multiplied by the scale of the output."""
_FISHEYE = _of_pix4d("FisheyePolynomial FisheyeAffineMatrix FisheyeAffineSymmetric")
_GEOMETRY = (
    _IN_PX
    + _FISHEYE
    + _of_pix4d("PrincipalPoint PerspectiveFocalLength PerspectiveFocalLengthUnits PerspectiveDistortion ModelType")
    + _of_pix4d("RigRelatives RigRelativesReferenceRigCameraIndex RigTranslations")
    + _of_dji("DewarpData DewarpFlag DewarpHMatrix CalibratedOpticalCenterX CalibratedOpticalCenterY CalibratedHMatrix")
)
"""Values of lens and rig, which are replaced by those of the reference."""
_SENSOR_ONLY = _of_pix4d("InvalidPixel VignettingPolynomial2D VignettingPolynomial2DName") + _of_dji("VignettingData")
"""Values that refer to the sensor's own pixels and are removed."""
_VIGNETTING = _of_pix4d("VignettingCenter VignettingPolynomial") + _of_dji("VignettingFlag")
_RADIOMETRY = _VIGNETTING + _of_pix4d("BlackCurrent RadiometricCalibration BandSensitivity IsNormalized")
_RADIOMETRY += _of_dji("BlackLevel SensorGainAdjustment")
_RADIOMETRY += names_in(micasense.NAMESPACE, "RadiometricCalibration DarkRowValue")
"""Values of corrections that have been applied to the pixels if radiance or reflectance is written."""
TransferredTags = tuple[Directory, Directory, Directory]
"""Entries for the first, the Exif and the GPS directory of an aligned file."""


def capture_tags(reference: Band, grid: OutputGrid) -> TransferredTags:
    """Return the tags for a stack: those that apply to all bands of a capture, whose exposures differ. Its DateTime is
    that of the capture, which it has already.
    """
    source = _directories(reference)
    first = _some(source[0], _CAPTURE_TAGS | {Base.Orientation})
    exif = _some(source[EXIF], _TIMES | {Base.ExifVersion, Base.BodySerialNumber, Base.LensModel})
    return first, _on_grid(_without_unset_clock(exif), source[EXIF], reference, grid), source[GPS]


def band_tags(
    source: Band,
    reference: Band,
    grid: OutputGrid,
    vignetting: GridVignetting | None,
    rows: GridRows = SAME_ROWS,
    *,
    radiometry: bool = False,
) -> TransferredTags:
    """Return the tags for a file with aligned bands from the file, or the page, of `source`.

    `vignetting` and `rows` are those of the band; a vignetting of None is corrected in the pixels. With `radiometry`
    they are also corrected for black level and exposure, and all their tags are left out. Lens and calibration of other
    images than those of the files are left out.
    """
    own, of_reference = _directories(source), _directories(reference)
    black_level: set[int] = set() if radiometry else {Base.BlackLevelRepeatDim, Base.BlackLevel}
    of_file = {Base.ImageDescription, Base.Software, Base.Artist, Base.OriginalRawFileName}
    first = _some(own[0], _CAPTURE_TAGS | _TIMES | black_level | of_file) | _some(of_reference[0], {Base.Orientation})
    with_offsets = {Base.MakerNote, Base.ExifInteroperabilityOffset}  # these refer to the old file
    exif = {tag: entry for tag, entry in own[EXIF].items() if tag not in with_offsets | _GEOMETRIC_EXIF}
    packet, reference_packet = (Packet.parse(d[0][XMP].data if XMP in d[0] else b"") for d in (own, of_reference))
    packet.take(reference_packet, _GEOMETRY)
    _put_geometry(packet, reference, tags_of(of_reference), grid)
    without_radiometry = radiometry or (source.has_other_lens and source.radiometry is None)
    _put_radiometry(packet, source, tags_of(own), vignetting, rows, radiometry=without_radiometry)
    if serialised := packet.serialised():
        first[XMP] = tiff_directory.byte_string(serialised)
    exif = _on_grid(_without_unset_clock(exif), of_reference[EXIF], reference, grid)
    return _without_unset_clock(first), exif, own[GPS]


def _without_unset_clock(directory: Directory) -> Directory:
    """The directory without the dates of a clock that was not set, like `Capture.known_time`, and without their
    fractions and time zones if no date is left.
    """
    dates = {tag for tag in _TIMES if tag in directory and tag.name.startswith("DateTime")}
    unset = {tag for tag in dates if not is_clock_set(directory[tag].data.decode("latin-1"))}
    removed = _TIMES if unset and unset == dates else unset
    return {tag: entry for tag, entry in directory.items() if tag not in removed}


def _put_geometry(packet: Packet, reference: Band, tags: Tags, grid: OutputGrid) -> None:
    """Change the values of the reference, which are in the `tags` of its file, to those on a grid.

    The rig becomes zero: software that reads it would otherwise align the bands a second time.
    """
    packet.remove(_SENSOR_ONLY + (_GEOMETRY if reference.has_other_lens else ()))
    for name in ("RigRelatives", "RigTranslations"):
        packet.put((pix4d.NAMESPACE, name), ["0", "0", "0"])
    _put_principal_point(packet, reference, tags, grid)
    focal_length = _of_pix4d("PerspectiveFocalLength" if pix4d.focal_length_is_in_px(tags) else "")
    for length in _IN_PX + focal_length if grid.scale.mean != 1 else ():
        if numbers := tags.numbers(*length):
            packet.put(length, _texts(v * grid.scale.mean for v in numbers))
    centre = dji.pair(tags, "CalibratedOpticalCenter")
    for axis, value in zip("XY", () if centre is None else grid.px(*centre), strict=False):
        packet.put((dji.NAMESPACE, f"CalibratedOpticalCenter{axis}"), _texts([value]))
    to_camera = geometry.invert(geometry.translation(-grid.x0, -grid.y0) @ grid.scale.matrix)
    for name in ("CalibratedHMatrix", "DewarpHMatrix"):  # from px of the file
        if (matrix := dji.matrix(tags, name)) is not None:
            packet.put((dji.NAMESPACE, name), _texts((matrix @ to_camera).ravel().tolist()))
    date, terms = dji.dewarp_data(tags)
    if terms:
        scaled = [v * grid.scale.mean for v in terms[:4]] + [0.0 if grid.undistorted else v for v in terms[4:]]
        packet.put((dji.NAMESPACE, "DewarpData"), [f"{date};" + ",".join(_texts(scaled))])
    if grid.undistorted:
        _put_pinhole(packet, reference, tags)


def _put_pinhole(packet: Packet, reference: Band, tags: Tags) -> None:
    """Change the lens to that of undistorted images: a pinhole camera, also for a fisheye."""
    distortion = pix4d.NAMESPACE, "PerspectiveDistortion"
    packet.put(distortion, ["0"] * len(tags.numbers(*distortion)))
    packet.put((dji.NAMESPACE, "DewarpFlag"), ["1"])
    density = pix4d.pixels_per_mm(tags)
    if tags.numbers(pix4d.NAMESPACE, "FisheyeAffineMatrix", 4) and density and reference.lens is not None:
        packet.remove(_FISHEYE)
        packet.put((pix4d.NAMESPACE, "ModelType"), ["perspective"])
        packet.add((pix4d.NAMESPACE, "PerspectiveFocalLength"), *_texts([reference.lens.fx_px / density]))
        packet.add((pix4d.NAMESPACE, "PerspectiveFocalLengthUnits"), "mm")


def _put_principal_point(packet: Packet, reference: Band, tags: Tags, grid: OutputGrid) -> None:
    point_px, density = pix4d.principal_point_px(tags), pix4d.pixels_per_mm(tags)
    if point_px is None or density is None:
        return
    if isinstance(camera_of(tags), Sequoia) and tags.orientation == 3:
        stored = pix4d.rotated_180(point_px, reference.size_px)
        point_px = pix4d.rotated_180(grid.px(*stored), (grid.width, grid.height))
    else:
        point_px = grid.px(*point_px)
    packet.put((pix4d.NAMESPACE, "PrincipalPoint"), _texts(v / (density * grid.scale.mean) for v in point_px))


def _put_radiometry(
    packet: Packet, band: Band, tags: Tags, vignetting: GridVignetting | None, rows: GridRows, *, radiometry: bool
) -> None:
    """Replace the vignetting and the calibration; `tags` are the band's own. A vignetting of None is removed, and with
    `radiometry` also the other values that have been applied to the pixels.

    The horizontal irradiance is added under the names that OpenDroneMap reads, with its unit, which is also that of the
    other irradiances.
    """
    if radiometry:
        packet.remove(_RADIOMETRY)
        return
    if vignetting is None:
        packet.remove(_VIGNETTING)
    else:
        packet.put((pix4d.NAMESPACE, "VignettingCenter"), _texts(vignetting.centre_px))
        packet.put((pix4d.NAMESPACE, "VignettingPolynomial"), [f"{v:.9e}" for v in vignetting.coefficients])
    if (coefficients := micasense.calibration_of_output(tags, band, rows)) is not None:
        packet.put(micasense.CALIBRATION, _texts(coefficients))
    light = dls.irradiance(tags) if isinstance(camera_of(tags), micasense.MicaSense) else dls.Irradiance()
    if light.value > 0:
        for name, value in (
            ("HorizontalIrradiance", light.value / light.unit),
            ("IrradianceScaleToSIUnits", light.unit),
        ):
            packet.add((pix4d.NAMESPACE, name), _texts([value])[0])


def _texts(numbers: Iterable[float]) -> list[str]:
    return [f"{number:.10g}" for number in numbers]


def _directories(band: Band) -> dict[int, Directory]:
    """The directories of a file; empty if they are damaged, because the pixels may still be good."""
    try:
        return tiff_directory.read_directories(band.path, band.page)
    except Exception:  # a damaged file causes any exception
        return {0: {}, EXIF: {}, GPS: {}}


def _some(directory: Directory, tags: Iterable[int]) -> Directory:
    return {tag: directory[tag] for tag in tags if tag in directory}


def _on_grid(exif: Directory, of_reference: Directory, reference: Band, grid: OutputGrid) -> Directory:
    """The Exif directory with the focal length and pixel density of the reference, and the size of the output."""
    known = {Base.FocalLength} if reference.has_other_lens else _GEOMETRIC_EXIF
    result = exif | _some(of_reference, known)
    if (of_film := Base.FocalLengthIn35mmFilm) in result:  # relative to the diagonal of the image
        share = math.hypot(grid.width / grid.scale.x, grid.height / grid.scale.y) / math.hypot(*reference.size_px)
        with suppress(TypeError, ValueError, struct.error):  # a damaged tag
            result[of_film] = tiff_directory.short(round(tiff_directory.values(result[of_film]) / share))
    densities: set[int] = {Base.FocalPlaneXResolution, Base.FocalPlaneYResolution}
    for tag in densities & result.keys() if grid.scale.mean != 1 else ():
        density = finite(tiff_directory.values(result[tag]))
        if density is not None and density > 0:
            with suppress(ValueError):  # too large for a fraction: a damaged tag
                result[tag] = tiff_directory.rational(grid.scale.mean * density)
    sizes = {Base.ExifImageWidth: grid.width, Base.ExifImageHeight: grid.height}
    return result | {tag: tiff_directory.long(size) for tag, size in sizes.items() if tag in result}
