"""The XMP tags that most makers share, defined by Pix4D: lens, rig, band, vignetting and panel."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from agalign.cameras.metadata import Tags, finite
from agalign.cameras.model_tables import named_by_camera
from agalign.pixels.radiometry import plausible
from agalign.values.capture import Band, Panel, Pose
from agalign.values.geometry import Points
from agalign.values.lens import Lens
from agalign.values.radiometry import Radiometry

NAMESPACE = "pix4d.com"
"""Contains `pix4d.com/camera/1.0`, and `pix4d.com/1.0` of older firmware."""


def perspective_lens(tags: Tags) -> Lens | None:
    """Return fx = fy = f r, (cx, cy) = PrincipalPoint r with r in px/mm; None if a tag is missing.

    Camera:PerspectiveDistortion is k1, k2, k3, p1, p2; `Lens` has OpenCV's order k1, k2, p1, p2, k3.
    """
    focal_px, centre_px = focal_length_px(tags), principal_point_px(tags)
    if focal_px is None or centre_px is None:
        return None
    k = tags.numbers(NAMESPACE, "PerspectiveDistortion", 5)
    distortion = (k[0], k[1], k[3], k[4], k[2]) if len(k) == 5 else ()
    return Lens(focal_px, focal_px, *centre_px, distortion)


def principal_point_px(tags: Tags) -> tuple[float, float] | None:
    """Return (x, y), with the centre of the top-left pixel at (0, 0): the vendors' libraries multiply mm by px/mm."""
    density, point_mm = pixels_per_mm(tags), tags.numbers(NAMESPACE, "PrincipalPoint", 2)
    return (point_mm[0] * density, point_mm[1] * density) if density and len(point_mm) == 2 else None


def pixels_per_mm(tags: Tags) -> float | None:
    """Return EXIF's resolution of the focal plane, else the ratio of the focal length in px to EXIF's in mm, else, as
    in files without EXIF, that with the principal point in the middle of the image.
    """
    resolution, unit = finite(tags.exif.get("FocalPlaneXResolution")), tags.exif.get("FocalPlaneResolutionUnit", 2)
    mm_per_unit = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(unit)  # inch, cm, mm, micrometre
    if resolution and mm_per_unit:
        return resolution / mm_per_unit
    focal_px = tags.number(NAMESPACE, "PerspectiveFocalLength") if focal_length_is_in_px(tags) else None
    if focal_px and tags.focal_length_mm:
        return focal_px / tags.focal_length_mm
    max_ratio = 1.1  # of both axes: principal points are within 0.02 of the longer side of the middle
    point_mm = tags.numbers(NAMESPACE, "PrincipalPoint", 2)
    if focal_px or tags.size_px is None or len(point_mm) != 2 or min(point_mm) <= 0:
        return None
    low, high = sorted(side_px / 2 / mm for side_px, mm in zip(tags.size_px, point_mm, strict=True))
    return (low + high) / 2 if high < max_ratio * low else None


def focal_length_is_in_px(tags: Tags) -> bool:
    """Return True if Camera:PerspectiveFocalLength is in px, which old firmware does not state."""
    units = tags.text(NAMESPACE, "PerspectiveFocalLengthUnits").lower()
    length = tags.number(NAMESPACE, "PerspectiveFocalLength")
    max_focal_length_mm = 100.0  # larger numbers are px: lenses of drone cameras have 2 to 50 mm, or 300 px and more
    return "px" in units or "pixel" in units or (length is not None and length > max_focal_length_mm)


def focal_length_px(tags: Tags) -> float | None:
    """Return Camera:PerspectiveFocalLength in px; None if it is missing, not positive or impossible."""
    focal_length, density = tags.number(NAMESPACE, "PerspectiveFocalLength"), pixels_per_mm(tags)
    if focal_length is None or density is None or focal_length <= 0:
        return None
    length_px = focal_length if focal_length_is_in_px(tags) else focal_length * density
    max_focal_length_px = 1e6  # larger numbers are from damaged tags
    return length_px if length_px < max_focal_length_px else None


def rig_degrees(tags: Tags) -> tuple[float, ...]:
    """Return the three angles of Camera:RigRelatives; zeros if they are missing."""
    angles = tags.numbers(NAMESPACE, "RigRelatives", 3)
    return angles if len(angles) == 3 else (0.0, 0.0, 0.0)


def lens_offset(tags: Tags) -> tuple[float, float] | None:
    """Return the position (right, down) of a band's lens in the rig from Camera:RigTranslations, in the unit of
    `rig_unit_m`; None if that is missing.
    """
    position = tags.numbers(NAMESPACE, "RigTranslations", 3)
    return (position[0], position[1]) if len(position) == 3 else None


def rig_unit_m(bands: Iterable[Band]) -> float:
    """Return the unit of `lens_offset` in all bands of a camera, metres: firmware writes m or mm."""
    offsets = (abs(v) for band in bands for v in band.lens_offset or ())
    max_offset_m = 0.5  # larger numbers are mm: no rig of a drone is half a metre wide
    return 1.0 if max(offsets, default=0.0) < max_offset_m else 1e-3


def described(band: Band, tags: Tags, name: str) -> Band:
    """Return the band with the name in its tags or description, else `name`, and the centre wavelength and bandwidth in
    the tags, nm.
    """
    return replace(
        band,
        name=tags.text(NAMESPACE, "BandName") or named_by_camera(band.name)[1] or name,
        wavelength_nm=wavelength_nm(tags),
        bandwidth_nm=tags.number(NAMESPACE, "WavelengthFWHM"),
    )


def wavelength_nm(tags: Tags) -> float | None:
    """Return Camera:CentralWavelength, nm; None if it is missing or of no camera."""
    min_nm, max_nm = 200.0, 20_000.0  # ultraviolet to thermal infrared
    nm = tags.number(NAMESPACE, "CentralWavelength")
    return nm if nm is not None and min_nm <= nm <= max_nm else None


def listed_names(tags: Tags) -> list[str]:
    """Return the items of Camera:BandName, which is a list in files of several bands."""
    return [name.strip() for name in tags.text(NAMESPACE, "BandName").split(",") if name.strip()]


def listed_bands(tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
    """Return the bands of a file with those of its names, wavelengths and widths that are lists of one item for each
    band.
    """
    names, count = listed_names(tags), len(stored)
    nm, width_nm = tags.numbers(NAMESPACE, "CentralWavelength"), tags.numbers(NAMESPACE, "WavelengthFWHM")
    return tuple(
        replace(
            band,
            name=band.name or (names[i] if len(names) == count else ""),
            wavelength_nm=band.wavelength_nm or (nm[i] if len(nm) == count else None),
            bandwidth_nm=band.bandwidth_nm or (width_nm[i] if len(width_nm) == count else None),
        )
        for i, band in enumerate(stored)
    )


def pose_of(tags: Tags, height_m: float | None = None) -> Pose | None:
    """Return the pose by Camera:Yaw, Pitch and Roll, degrees; None if the yaw is missing. All are 0 for a camera that
    looks straight down with its upper edge to the north.
    """
    yaw, pitch, roll = (tags.number(NAMESPACE, name) for name in ("Yaw", "Pitch", "Roll"))
    if yaw is None:
        return None
    return Pose(yaw, pitch or 0.0, roll or 0.0, height_m, focal_length_px(tags))


def panel_in(tags: Tags, size_px: tuple[int, int]) -> Panel | None:
    """Return the calibration panel that the firmware detected in an image (width, height), by CalibrationPicture,
    Albedo, ReflectArea (x, y of four corners, px) and PanelSerial; None if it detected none.
    """
    corners, is_picture = _panel_corners(tags, size_px), tags.number(NAMESPACE, "CalibrationPicture")
    if is_picture == 0 or (is_picture is None and not corners):
        return None
    albedo = tags.number(NAMESPACE, "Albedo")
    if albedo is not None and not 0 < albedo <= 1:
        albedo = None
    serial = tags.first_text([("micasense.com/MicaSense", "PanelSerial"), (NAMESPACE, "PanelSerial")])
    return Panel("tags", serial, albedo, corners)


def _panel_corners(tags: Tags, size_px: tuple[int, int]) -> tuple[tuple[float, float], ...]:
    """(x, y) of the corners of ReflectArea; empty if they are not four different points of the image."""
    area = tags.numbers(NAMESPACE, "ReflectArea", 8)
    if len(area) != 8:
        return ()
    corners = tuple(zip(area[::2], area[1::2], strict=True))
    inside = all(0 <= x < size_px[0] and 0 <= y < size_px[1] for x, y in corners)
    return corners if inside and len(set(corners)) == len(corners) else ()


# ---- vignetting


@dataclass(frozen=True)
class GridVignetting:
    """Vignetting 1 + k1 r + k2 r^2 + … of a band as a polynomial on the output grid."""

    centre_px: tuple[float, float]
    """r is the distance from this pixel of the output."""
    coefficients: tuple[float, ...]
    error: float
    """p95 of its relative error."""


class GridRows(NamedTuple):
    """The rows of a band's file as a linear function of the rows of the output grid."""

    first: float
    """Row of the file at row 0 of the output."""
    step: float
    """Rows of the file per row of the output."""


SAME_ROWS = GridRows(0.0, 1.0)
"""Of an output with the rows of the file."""


def vignetting(tags: Tags) -> tuple[tuple[float, float], tuple[float, ...]]:
    """Return ((x, y), (k1, k2 ...)) of Camera:VignettingCenter and VignettingPolynomial; no k if one is missing."""
    centre, k = tags.numbers(NAMESPACE, "VignettingCenter", 2), tags.numbers(NAMESPACE, "VignettingPolynomial", 6)
    return ((centre[0], centre[1]), k) if len(centre) == 2 and any(k) else ((0.0, 0.0), ())


def vignetting_of(tags: Tags, size_px: tuple[int, int], *, divides: bool = True) -> Radiometry | None:
    """Return the correction of the vignetting alone, of values above the black level, by Camera:VignettingCenter and
    VignettingPolynomial of a band of (width, height), which `divides` the values or else multiplies them; None if they
    are missing or damaged.
    """
    centre, k = vignetting(tags)
    if not k or not all(0 <= c <= size for c, size in zip(centre, size_px, strict=True)):
        return None
    result = Radiometry("relative radiance", tags.black_level or 0.0, 1.0, 1.0, centre, k, divides)
    return plausible(result, size_px)[0]


def vignetting_on_grid(vignetting: Radiometry, output_px: Points, positions_px: Points) -> GridVignetting:
    """Return the polynomial of a band's vignetting on the output grid, fitted by least squares to pixels (n, 2) of the
    output and their positions (n, 2) in the band's file; n is at least 3.
    """
    to_output, *_ = np.linalg.lstsq(np.column_stack([positions_px, np.ones(len(positions_px))]), output_px)
    centre_px = np.append(vignetting.vignetting_centre_px, 1.0) @ to_output
    r, own_r = (
        np.linalg.norm(points - centre, axis=-1)
        for points, centre in ((output_px, centre_px), (positions_px, vignetting.vignetting_centre_px))
    )
    falloff = np.polynomial.polynomial.polyval(own_r, (1.0, *vignetting.vignetting))
    exponents = np.arange(1, len(vignetting.vignetting) + 1)
    # In units of the largest r, relative to the falloff: errors of corrected pixels.
    terms, wanted = (r[:, None] / r.max()) ** exponents / falloff[:, None], 1.0 - 1.0 / falloff
    k, *_ = np.linalg.lstsq(terms, wanted)
    error = float(np.percentile(np.abs(terms @ k - wanted), 95))
    return GridVignetting((centre_px[0], centre_px[1]), tuple((k / r.max() ** exponents).tolist()), error)


def rotated_180(point_px: Sequence[float], size_px: tuple[int, int]) -> tuple[float, float]:
    """Return a pixel (x, y) of an image (width, height) in the image rotated by 180 degrees; (0, 0) is the centre of
    the top-left pixel.
    """
    return size_px[0] - 1 - point_px[0], size_px[1] - 1 - point_px[1]
