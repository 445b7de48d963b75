"""The tags that most makers share, in the namespace that Pix4D gave them: lens, rig, band, and vignetting.

`TagTransfer` converts them for a band that is written on the reference's grid; a maker with tags of its own extends it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from agalign.cameras.metadata import Tags
from agalign.cameras.xmp import Name, Packet
from agalign.values.capture import Band, Panel, Pose
from agalign.values.image import OutputGrid
from agalign.values.lens import Lens

CAMERA = "pix4d.com"
"""Firmware writes `pix4d.com/camera/1.0`, and older one `pix4d.com/1.0`."""
BAND_NAME: Name = (CAMERA, "BandName")
CAPTURE_UUID: Name = (CAMERA, "CaptureUUID")
FLIGHT_UUID: Name = (CAMERA, "FlightUUID")
PRINCIPAL_POINT: Name = (CAMERA, "PrincipalPoint")
FOCAL_LENGTH: Name = (CAMERA, "PerspectiveFocalLength")
FOCAL_LENGTH_UNITS: Name = (CAMERA, "PerspectiveFocalLengthUnits")
DISTORTION: Name = (CAMERA, "PerspectiveDistortion")
MODEL_TYPE: Name = (CAMERA, "ModelType")
RIG_RELATIVES: Name = (CAMERA, "RigRelatives")
RIG_TRANSLATIONS: Name = (CAMERA, "RigTranslations")
VIGNETTING_CENTRE: Name = (CAMERA, "VignettingCenter")
VIGNETTING_POLYNOMIAL: Name = (CAMERA, "VignettingPolynomial")

_PANEL_SERIALS: tuple[Name, ...] = (("micasense.com/MicaSense", "PanelSerial"), (CAMERA, "PanelSerial"))
_AREA_NUMBERS = 8
"""x and y of four corners."""
_MAX_FOCAL_LENGTH_MM = 100.0
"""Larger numbers are px: lenses of drone cameras have 2 to 50 mm, or 300 px and more."""
_MAX_OFFSET_M = 0.5
_MAX_MAGNIFICATION = 1.02
"""Beyond this a polynomial of vignetting in the band's own pixels is dropped."""

FromSource = Callable[[float, float], tuple[float, float]]
"""Maps a pixel (x, y) of the band's own file to the reference's pixels; nan where the mapping has no inverse."""


# ---- reading


def perspective_lens(tags: Tags) -> Lens | None:
    """K = [f r, f r, ppx r, ppy r] with r in px/mm; Camera:PerspectiveDistortion is k1, k2, k3, p1, p2."""
    focal_px, centre_px = focal_length_px(tags), principal_point_px(tags)
    if focal_px is None or centre_px is None:
        return None
    k = tags.numbers(*DISTORTION)
    distortion = (k[0], k[1], k[3], k[4], k[2]) if len(k) == 5 else ()
    return Lens(focal_px, focal_px, *centre_px, distortion)


def principal_point_px(tags: Tags) -> tuple[float, float] | None:
    """(x, y) with the centre of the top-left pixel at (0, 0), as makers' libraries take millimetres times density."""
    density, point_mm = pixels_per_mm(tags), tags.numbers(*PRINCIPAL_POINT)
    return (point_mm[0] * density, point_mm[1] * density) if density and len(point_mm) == 2 else None


def pixels_per_mm(tags: Tags) -> float | None:
    """EXIF's density, else the ratio of a focal length in px to EXIF's in mm."""
    if tags.pixels_per_mm:
        return tags.pixels_per_mm
    focal_px = tags.number(*FOCAL_LENGTH) if focal_length_is_in_px(tags) else None
    return focal_px / tags.focal_length_mm if focal_px and tags.focal_length_mm else None


def focal_length_is_in_px(tags: Tags) -> bool:
    """True where Camera:PerspectiveFocalLength is in px: old firmware gives them without saying so."""
    units, length = tags.text(*FOCAL_LENGTH_UNITS).lower(), tags.number(*FOCAL_LENGTH)
    return "px" in units or "pixel" in units or (length is not None and length > _MAX_FOCAL_LENGTH_MM)


def focal_length_px(tags: Tags) -> float | None:
    """Camera:PerspectiveFocalLength; None where it is missing or not positive."""
    focal, density = tags.number(*FOCAL_LENGTH), pixels_per_mm(tags)
    if focal is None or density is None or focal <= 0:
        return None
    return focal if focal_length_is_in_px(tags) else focal * density


def rig_degrees(tags: Tags) -> tuple[float, ...]:
    """The three angles of Camera:RigRelatives; zeros where they are missing."""
    angles = tags.numbers(*RIG_RELATIVES)
    return angles if len(angles) == 3 else (0.0, 0.0, 0.0)


def parallax_of(tags: Tags) -> tuple[float, float] | None:
    """Direction in which a band's pixels move as the ground comes nearer: opposite to the position of the lens right
    of and below the rig's origin in Camera:RigTranslations, metres or millimetres. None where that is missing.
    """
    place = tags.numbers(*RIG_TRANSLATIONS)
    return (-place[0], -place[1]) if len(place) == 3 else None


def lens_offset_m(tags: Tags) -> tuple[float, float] | None:
    """Position of a band's lens right of and below the rig's origin, metres, from Camera:RigTranslations; None where
    that is missing. Some cameras write millimetres: no rig of a drone is half a metre wide.
    """
    place = tags.numbers(*RIG_TRANSLATIONS)
    if len(place) != 3:
        return None
    scale = 1.0 if max(map(abs, place)) < _MAX_OFFSET_M else 1e-3
    return place[0] * scale, place[1] * scale


def spectral(band: Band, tags: Tags) -> Band:
    """The band with the wavelength and width that its tags give, nm."""
    return replace(
        band,
        wavelength_nm=tags.number(CAMERA, "CentralWavelength"),
        bandwidth_nm=tags.number(CAMERA, "WavelengthFWHM"),
    )


def pose_of(tags: Tags, height_m: float | None = None) -> Pose | None:
    """From Camera:Yaw, Pitch and Roll, degrees, of a camera that looks down; None where they are missing."""
    yaw, pitch, roll = (tags.number(CAMERA, name) for name in ("Yaw", "Pitch", "Roll"))
    if yaw is None:
        return None
    return Pose(yaw, pitch or 0.0, roll or 0.0, height_m, focal_length_px(tags))


def panel_in(tags: Tags, size_px: tuple[int, int]) -> Panel | None:
    """The calibration panel that the firmware saw in an image (width, height): CalibrationPicture, Albedo, ReflectArea
    (x, y of four corners, px) and PanelSerial; None where it saw none.
    """
    corners, is_picture = _panel_corners(tags, size_px), tags.number(CAMERA, "CalibrationPicture")
    if is_picture == 0 or (is_picture is None and not corners):
        return None
    albedo = tags.number(CAMERA, "Albedo")
    known = albedo if albedo is not None and 0 < albedo <= 1 else None
    return Panel("tags", tags.first_text(_PANEL_SERIALS), known, corners)


def _panel_corners(tags: Tags, size_px: tuple[int, int]) -> tuple[tuple[float, float], ...]:
    """(x, y) of the four corners of ReflectArea; none where they are not four points of the image."""
    area = tags.numbers(CAMERA, "ReflectArea")
    if len(area) != _AREA_NUMBERS:
        return ()
    corners = tuple(zip(area[::2], area[1::2], strict=True))
    inside = all(0 <= x < size_px[0] and 0 <= y < size_px[1] for x, y in corners)
    return corners if inside and len(set(corners)) == len(corners) else ()


# ---- writing on the reference's grid


class TagTransfer:
    """How XMP values are converted for a band on the reference's grid."""

    geometry: frozenset[Name] = frozenset({
        PRINCIPAL_POINT, FOCAL_LENGTH, FOCAL_LENGTH_UNITS, DISTORTION, MODEL_TYPE, RIG_RELATIVES,
        RIG_TRANSLATIONS, (CAMERA, "RigRelativesReferenceRigCameraIndex"),
    })  # fmt: skip
    """Values of the lens and the rig, which are replaced by the reference's."""
    sensor_only: frozenset[Name] = frozenset({
        (CAMERA, "InvalidPixel"), (CAMERA, "VignettingPolynomial2D"), (CAMERA, "VignettingPolynomial2DName"),
    })  # fmt: skip
    """Values that are true of the sensor's own pixels only, which are removed."""
    radiometry: frozenset[Name] = frozenset({VIGNETTING_CENTRE, VIGNETTING_POLYNOMIAL, (CAMERA, "BlackCurrent")})
    """Corrections that the pixels have had where reflectance is written."""
    in_px: tuple[Name, ...] = ()
    """Lengths in px, which grow with the resolution."""
    principal_point_follows_orientation = False
    """True where the principal point is in the image after EXIF's Orientation, not as it is stored."""

    def put_geometry(
        self, packet: Packet, reference_packet: Packet, reference: Band, tags: Tags, grid: OutputGrid
    ) -> None:
        """Replace a band's geometry by the reference's on a grid; `reference_packet` and `tags` are of the reference's
        file.

        The rig is removed: software that reads it would align the bands a second time.
        """
        packet.take(reference_packet, self.geometry)
        packet.remove(self.sensor_only)
        for name in (RIG_RELATIVES, RIG_TRANSLATIONS):
            packet.put(name, ["0", "0", "0"])
        self._put_principal_point(packet, reference, tags, grid)
        for name in (*self.in_px, *([FOCAL_LENGTH] if focal_length_is_in_px(tags) else [])):
            values = tags.numbers(*name)
            if values and grid.scale.mean != 1:
                packet.put(name, [number_text(v * grid.scale.mean) for v in values])
        if grid.undistorted:
            packet.put(DISTORTION, ["0"] * len(tags.numbers(*DISTORTION)))

    def _put_principal_point(self, packet: Packet, reference: Band, tags: Tags, grid: OutputGrid) -> None:
        point_px, density = principal_point_px(tags), self.pixels_per_mm(tags)
        if point_px is None or density is None:
            return
        if self.is_rotated(tags):
            stored = rotated_180(point_px, reference.size_px)
            point_px = rotated_180(grid.px(*stored), (grid.width, grid.height))
        else:
            point_px = grid.px(*point_px)
        packet.put(PRINCIPAL_POINT, [number_text(v / (density * grid.scale.mean)) for v in point_px])

    def put_vignetting(
        self, packet: Packet, tags: Tags, grid: OutputGrid, from_source: FromSource, *, radiometry: bool
    ) -> None:
        """Convert the vignetting's centre and polynomial to the pixels that are written; `tags` are the band's own.

        With `radiometry` they are removed, because the pixels have been corrected.
        """
        centre, k = tags.numbers(*VIGNETTING_CENTRE), tags.numbers(*VIGNETTING_POLYNOMIAL)
        if radiometry:
            packet.remove(self.radiometry)
            return
        if len(centre) != 2:
            return
        new_centre, next_pixel = from_source(*centre), from_source(centre[0] + 1, centre[1])
        magnification = math.dist(new_centre, next_pixel)
        # In this form nan is out of range too.
        if not 1 / _MAX_MAGNIFICATION < magnification < _MAX_MAGNIFICATION:
            packet.remove([VIGNETTING_CENTRE, VIGNETTING_POLYNOMIAL])
            return
        packet.put(VIGNETTING_CENTRE, [number_text(v) for v in grid.px(*new_centre)])
        scaled = [v / (grid.scale.mean * magnification) ** i for i, v in enumerate(k, start=1)]
        packet.put(VIGNETTING_POLYNOMIAL, [f"{v:.9e}" for v in scaled])

    def pixels_per_mm(self, tags: Tags) -> float | None:
        """Of the focal plane."""
        return pixels_per_mm(tags)

    def is_rotated(self, tags: Tags) -> bool:
        """True where the principal point is in the image rotated by 180 degrees."""
        return self.principal_point_follows_orientation and tags.orientation == UPSIDE_DOWN


UPSIDE_DOWN = 3
"""EXIF Orientation of an image that is stored rotated by 180 degrees."""


def rotated_180(point_px: Sequence[float], size_px: tuple[int, int]) -> tuple[float, float]:
    """A position of an image (width, height) in the image rotated by 180 degrees, pixel centres at whole numbers."""
    return size_px[0] - 1 - point_px[0], size_px[1] - 1 - point_px[1]


def number_text(value: float) -> str:
    """A number as tags hold it."""
    return f"{value:.10g}"
