"""Tags of a TIFF as typed fields: the standard ones, EXIF, GPS, and XMP read by namespace."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, ParseError

import tifffile
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from agalign.errors import UnreadableFileError

Namespace = Literal["Camera", "MicaSense", "DLS", "drone-dji"]

_NAMESPACES: dict[str, Namespace] = {
    "http://pix4d.com/camera/1.0": "Camera",
    "http://pix4d.com/1.0": "Camera",
    "http://micasense.com/MicaSense/1.0": "MicaSense",
    "http://micasense.com/DLS/1.0": "DLS",
    "http://www.dji.com/drone-dji/1.0": "drone-dji",
}
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""EXIF FocalPlaneResolutionUnit (0xA210): inch, cm, mm, micrometre."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class Tags:
    """What the metadata of one file says. Absent or unusable tags are empty strings, empty mappings or None."""

    make: str = ""
    model: str = ""
    serial: str = ""
    captured_at: str = ""
    """ISO 8601 as written by the camera, without a time zone where it gives none."""
    xmp: Mapping[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    exif: Mapping[str, Any] = field(default_factory=dict)

    def text(self, namespace: Namespace, name: str) -> str:
        """An XMP value as text; a sequence's items are joined by commas."""
        return ",".join(self.xmp.get((namespace, name), ()))

    def numbers(self, namespace: Namespace, name: str) -> tuple[float, ...]:
        """The finite numbers in an XMP value, whether it is one text, a list in a text, or a sequence."""
        numbers = (float(n) for n in _NUMBER.findall(self.text(namespace, name)))
        return tuple(n for n in numbers if math.isfinite(n))

    def number(self, namespace: Namespace, name: str) -> float | None:
        """The first number in an XMP value."""
        numbers = self.numbers(namespace, name)
        return numbers[0] if numbers else None

    @property
    def pixels_per_mm(self) -> float | None:
        """Density of the pixels in the focal plane, from EXIF FocalPlaneXResolution and its unit."""
        resolution = rational(self.exif.get("FocalPlaneXResolution"))
        unit = self.exif.get("FocalPlaneResolutionUnit", 2)
        mm = _MM_PER_UNIT.get(int(unit)) if isinstance(unit, int) else None
        return resolution / mm if resolution and mm else None


def rational(value: Any) -> float | None:
    """An EXIF number or numerator-denominator pair as a finite float, else None."""
    try:
        number = value[0] / value[1] if isinstance(value, (tuple, list)) else float(value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if math.isfinite(number) else None


def read_tags(path: Path) -> Tags:
    """The tags of a TIFF's first page. Raises UnreadableFileError where it is no TIFF or is cut short."""
    try:
        with tifffile.TiffFile(path) as tiff:
            page = tiff.pages[0]
            values = {tag.code: tag.value for tag in page.tags.values()}  # type: ignore[union-attr]
    except Exception as error:  # a damaged file makes tifffile fail in any way: struct.error, KeyError, MemoryError …
        raise UnreadableFileError(
            f"{path}: not a readable TIFF ({error or 'empty'}); copy it from the card again"
        ) from None
    exif = values.get(34665)
    exif = exif if isinstance(exif, dict) else {}
    return Tags(
        make=_text(values.get(271)),
        model=_text(values.get(272)),
        serial=_text(exif.get("BodySerialNumber")),
        captured_at=_iso_time(exif, values.get(306)),
        xmp=parse_xmp(values.get(700, b"")),
        exif=exif,
    )


def parse_xmp(packet: Any) -> dict[tuple[str, str], tuple[str, ...]]:
    """An XMP packet (bytes or text) as {(namespace, name): values}, from all rdf:Description blocks.

    A value may be an attribute, an element's text, or an rdf:Seq or rdf:Bag. A malformed packet is an empty one:
    cameras do write them, and the images are still good.
    """
    text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
    if not isinstance(text, str):
        return {}
    start, end = text.find("<x:xmpmeta"), text.rfind("</x:xmpmeta>")
    if start < 0 or end < 0:
        return {}
    try:
        root = fromstring(text[start : end + len("</x:xmpmeta>")])
    except (ParseError, DefusedXmlException, ValueError):
        return {}
    values: dict[tuple[str, str], tuple[str, ...]] = {}
    for description in root.iter(f"{_RDF}Description"):
        for name, value in description.attrib.items():
            _keep(values, name, (value,))
        for element in description:
            items = [item.text or "" for item in element.iter(f"{_RDF}li")]
            _keep(values, element.tag, tuple(items) if items else (_own_text(element),))
    return values


def _keep(values: dict[tuple[str, str], tuple[str, ...]], tag: str, found: tuple[str, ...]) -> None:
    uri, _, name = tag.removeprefix("{").rpartition("}")
    namespace = _NAMESPACES.get(uri.rstrip("/"))
    cleaned = tuple(v.strip() for v in found)
    if namespace and any(cleaned):
        values.setdefault((namespace, name), cleaned)


def _own_text(element: Element) -> str:
    return (element.text or "").strip()


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return str(value).strip("\0 ") if isinstance(value, (str, int)) else ""


def _iso_time(exif: Mapping[str, Any], fallback: Any) -> str:
    moment = _text(exif.get("DateTimeOriginal")) or _text(fallback)
    match = re.fullmatch(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)", moment)
    if not match:
        return ""
    year, month, day, clock = match.groups()
    fraction = _text(exif.get("SubsecTimeOriginal") or exif.get("SubsecTime"))
    return f"{year}-{month}-{day}T{clock}" + (f".{fraction}" if fraction.isdigit() else "")
