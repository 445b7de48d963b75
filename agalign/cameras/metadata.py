"""Tags of a TIFF or JPEG as typed fields: the standard ones, EXIF, GPS, and XMP read by namespace."""

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from PIL import ExifTags

from agalign.cameras.tag_text import iso_time, numbers_in
from agalign.cameras.tiff_directory import EXIF, GPS, Directory, read_directories, values
from agalign.cameras.xmp import Name, Packet
from agalign.errors import UnreadableFileError
from agalign.host.text import shortened, without_controls
from agalign.pixels.raster import suffix_format
from agalign.values.capture import Band, CaptureTime, Position

_SERIAL_NUMBERS: Sequence[Name] = (
    ("cipa.jp/exif", "BodySerialNumber"),
    ("ns.adobe.com/exif/1.0/aux", "SerialNumber"),
    ("dji.com/drone-dji", "CameraSerialNumber"),
    ("dji.com/drone-dji", "DroneSerialNumber"),
    ("dji.com/drone-dji", "DroneID"),
    ("pix4d.com/camera", "SerialNumber"),
)
"""XMP values of the serial number of a camera or its aircraft, for files without that of Exif."""


@dataclass(frozen=True)
class Tags:
    """The metadata of one file. Absent or unusable tags are empty strings, empty mappings or None."""

    make: str = ""
    model: str = ""
    serial: str = ""
    position: Position | None = None
    position_to_a_minute: Position | None = None
    """The position to a minute of arc, 1.9 km, if the seconds are not numbers: enough for the direction of the sun."""
    without_signs: Position | None = None
    """The position without the references N or S and E or W, if one is missing: both coordinates are positive."""
    captured_at: str = ""
    """ISO 8601; by the camera's clock without an offset from UTC if the camera writes none."""
    orientation: int = 1
    """EXIF Orientation: 1 if the image is stored upright, 3 if it is rotated by 180 degrees."""
    size_px: tuple[int, int] | None = None
    """(width, height) of a TIFF's first page."""
    black_level: float | None = None
    """Mean of the values of the TIFF tag BlackLevel."""
    xmp: Mapping[Name, tuple[str, ...]] = field(default_factory=dict)
    exif: Mapping[str, Any] = field(default_factory=dict)
    unread: tuple[str, ...] | None = None
    """Names of the values in a damaged XMP packet that could not be read; None for an intact packet."""

    def text(self, namespace: str, name: str) -> str:
        """Return an XMP value as text, with the items of a sequence joined by commas; empty if it is missing.

        `namespace` is as in `xmp.Name`.
        """
        return ",".join(self.xmp.get((namespace, name), ()))

    def first_text(self, names: Iterable[Name]) -> str:
        """Return the text of the first of these XMP values that is not empty."""
        return next((text for name in names if (text := self.text(*name))), "")

    def numbers(self, namespace: str, name: str, count: int | None = None) -> tuple[float, ...]:
        """Return the numbers in an XMP value, a text or a sequence, as `numbers_in`; `count` is their usual number."""
        return numbers_in(self.xmp.get((namespace, name), ()), count)

    def number(self, namespace: str, name: str) -> float | None:
        """Return the first number in an XMP value; None if there is none."""
        return next(iter(self.numbers(namespace, name, 1)), None)

    @property
    def near(self) -> Position | None:
        """The position, at least to a minute of arc."""
        return self.position or self.position_to_a_minute

    @property
    def camera_size_px(self) -> tuple[int, int] | None:
        """(width, height) of the image that the camera wrote, by EXIF; programs that resize images keep these tags."""
        return _size(self.exif, "ExifImageWidth", "ExifImageHeight")

    @property
    def focal_length_mm(self) -> float | None:
        """EXIF FocalLength."""
        return finite(self.exif.get("FocalLength"))


def finite(value: Any) -> float | None:
    """Return a value of Exif as a finite float; None for anything else."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def read_tags(path: Path, page: int = 0) -> Tags:
    """Return the tags of a page of a TIFF, by default the first, or of a JPEG; empty for a PNG.

    Raises UnreadableFileError if the file is not of the format of its suffix or is truncated.
    """
    if suffix_format(path) == "PNG":
        return Tags()
    try:
        directories = read_directories(path, page)
    except Exception as error:  # damaged files cause struct.error, KeyError, MemoryError … in the libraries
        kind = suffix_format(path) or "TIFF"
        what = f"not a readable {kind} ({error or 'empty'})"
        raise UnreadableFileError(f"{path}: {what}", "copy it from the card again") from None
    return tags_of(directories)


def tags_of(directories: Mapping[int, Directory]) -> Tags:
    """Return the tags in the directories of a file, which are from `read_directories`."""
    first, exif, gps = (
        {names.get(tag, str(tag)): values(entry) for tag, entry in directories[key].items()}
        for key, names in ((0, ExifTags.TAGS), (EXIF, ExifTags.TAGS), (GPS, ExifTags.GPSTAGS))
    )
    orientation, packet = first.get("Orientation", 1), Packet.parse(first.get("XMLPacket", b""))
    by_xmp = Tags(xmp=packet.values())
    return replace(
        by_xmp,
        make=_text(first.get("Make")),
        model=_text(first.get("Model")),
        serial=_text(exif.get("BodySerialNumber")) or by_xmp.first_text(_SERIAL_NUMBERS),
        **_position(gps),
        captured_at=_iso_time(exif | {"Make": first.get("Make")}, "DateTimeOriginal", "OffsetTimeOriginal")
        or _iso_time({**exif, **first}, "DateTime", "OffsetTime"),
        orientation=int(orientation) if orientation in range(1, 9) else 1,
        size_px=_size(first, "ImageWidth", "ImageLength"),
        black_level=_mean(first.get("BlackLevel")),
        exif=exif,
        unread=packet.unread,
    )


def exposed_after_s(band: Band, reference: Band) -> float | None:
    """Return the delay of the exposure of a band relative to the reference by their tags, s; None if it is unknown."""
    with suppress(UnreadableFileError):
        times = [CaptureTime.of(read_tags(b.path, b.page).captured_at) for b in (band, reference)]
        if times[0] is not None and times[1] is not None:
            return (times[0].utc - times[1].utc).total_seconds()
    return None


def _size(directory: Mapping[str, Any], *sides: str) -> tuple[int, int] | None:
    width, height = (directory.get(side) for side in sides)
    return (width, height) if isinstance(width, int) and isinstance(height, int) and width > 0 < height else None


def _position(gps: Mapping[str, Any]) -> dict[str, Any]:
    """{name of the field of `Tags`: position}; empty without a fix, for which cameras write no coordinates or zeros."""
    (latitude_deg, is_exact), (longitude_deg, is_exact_too) = _degrees(gps, "Latitude"), _degrees(gps, "Longitude")
    # A coordinate of exactly 0 is a missing one: receivers resolve 0.01 m.
    if not latitude_deg or not longitude_deg or latitude_deg > 90.0 or longitude_deg > 180.0:
        return {}
    is_exact &= is_exact_too
    absolute = Position(latitude_deg, longitude_deg, _altitude_m(gps))
    sign, other = _sign(gps, "Latitude", "NS"), _sign(gps, "Longitude", "EW")
    if sign is None or other is None:
        return {"without_signs": absolute} if is_exact else {}
    signed = Position(sign * latitude_deg, other * longitude_deg, absolute.altitude_m)
    return {"position" if is_exact else "position_to_a_minute": signed}


def _degrees(gps: Mapping[str, Any], axis: str) -> tuple[float | None, bool]:
    """(a coordinate without its sign, False if it is known to a minute only); None if it is missing or negative."""
    value = gps.get(f"GPS{axis}")  # degrees, minutes and seconds
    parts = [finite(part) for part in value] if isinstance(value, tuple) and len(value) == 3 else []
    if not parts or parts[0] is None or parts[1] is None or any(not 0 <= part < 60 for part in parts[1:] if part):
        return None, False
    degrees = parts[0] + parts[1] / 60 + (parts[2] or 0.0) / 3600
    is_exact = parts[2] is not None or parts[1] % 1 != 0  # some programs write minutes with a fraction
    return (degrees if degrees >= 0 else None), is_exact


def _sign(gps: Mapping[str, Any], axis: str, letters: str) -> int | None:
    """1 for the first letter of a reference, N or E, -1 for the second; None for another text."""
    letter = _text(gps.get(f"GPS{axis}Ref")).strip().upper()[:1]
    return {letters[0]: 1, letters[1]: -1}.get(letter)


def _altitude_m(gps: Mapping[str, Any]) -> float | None:
    """Altitude, negative below the ellipsoid or sea level (1, 3 in Exif 3.0); None if it is missing or impossible."""
    max_altitude_m = 20_000.0  # beyond it tags are damaged
    altitude_m = finite(gps.get("GPSAltitude"))
    if altitude_m is None or abs(altitude_m) > max_altitude_m:
        return None
    return -altitude_m if gps.get("GPSAltitudeRef") in (b"\x01", b"\x03") else altitude_m


def _mean(value: Any) -> float | None:
    """The mean of a tag of one or several numbers; None for another type."""
    numbers = value if isinstance(value, tuple) else (value,)
    if not numbers or any(finite(n) is None for n in numbers):
        return None
    return float(sum(numbers)) / len(numbers)


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return shortened(without_controls(str(value)).strip()) if isinstance(value, (str, int)) else ""


def _iso_time(exif: Mapping[str, Any], time: str, offset: str) -> str:
    """The time in a tag, with the offset from UTC in another tag if it is plausible; empty without a time."""
    fraction = _text(exif.get("SubsecTimeOriginal") or exif.get("SubsecTime"))
    if len(fraction) in (7, 8) and _text(exif.get("Make")).lower() == "micasense":
        fraction = fraction.zfill(9)  # its firmware writes nanoseconds without leading zeros
    return iso_time(_text(exif.get(time)), fraction, _text(exif.get(offset)))
