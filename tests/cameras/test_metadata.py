"""Tags of files and values of XMP packets."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from PIL.ExifTags import Base

from agalign.cameras.dji import Dji
from agalign.cameras.metadata import Tags, finite, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.pix4d import NAMESPACE, pixels_per_mm
from agalign.cameras.tiff_directory import EXIF, GPS, add_directories, rational, read_directories, text
from agalign.cameras.xmp import Packet
from agalign.values.capture import CaptureTime

from .test_vendors import packet

ENVELOPE = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"
 xmlns:Camera="{camera}" xmlns:other="http://example.org/other/">{body}</rdf:RDF></x:xmpmeta><?xpacket end="w"?>"""


def enveloped(body: str, camera: str = "http://pix4d.com/camera/1.0") -> bytes:
    return ENVELOPE.format(body=body, camera=camera).encode()


@pytest.mark.parametrize(
    "body",
    [
        '<rdf:Description Camera:PrincipalPoint="2.4,1.8"/>',
        "<rdf:Description><Camera:PrincipalPoint>2.4, 1.8</Camera:PrincipalPoint></rdf:Description>",
        "<rdf:Description><Camera:PrincipalPoint><rdf:Seq><rdf:li>+2.4</rdf:li><rdf:li>1.8</rdf:li></rdf:Seq>"
        "</Camera:PrincipalPoint></rdf:Description>",
        "<rdf:Description><Camera:PrincipalPoint><rdf:Bag><rdf:li>2.4</rdf:li><rdf:li>1.80</rdf:li></rdf:Bag>"
        "</Camera:PrincipalPoint></rdf:Description>",
        '<rdf:Description Camera:BandName="NIR"/><rdf:Description Camera:PrincipalPoint="2.4,1.8"/>',
    ],
)
def test_a_value_may_be_attribute_element_sequence_or_bag(body: str) -> None:
    assert Tags(xmp=Packet.parse(enveloped(body)).values()).numbers(NAMESPACE, "PrincipalPoint") == (2.4, 1.8)


@pytest.mark.parametrize("uri", ["http://pix4d.com/camera/1.0/", "http://pix4d.com/1.0", "http://www.pix4d.com/camera"])
def test_namespaces_are_places_whatever_their_version_and_slash(uri: str) -> None:
    values = Packet.parse(enveloped('<rdf:Description Camera:BandName="Red"/>', uri)).values()
    assert values[NAMESPACE, "BandName"] == ("Red",)


def test_the_same_name_in_another_namespace_is_another_tag() -> None:
    tags = Tags(xmp=Packet.parse(enveloped('<rdf:Description other:Yaw="1"/>')).values())
    assert tags.number("example.org/other", "Yaw") == 1
    assert tags.number("example.org", "Yaw") == 1
    assert tags.number(NAMESPACE, "Yaw") is None
    assert tags.number("example.org/oth", "Yaw") is None


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        b"\0\0\0",
        b"<x:xmpmeta",
        enveloped("<rdf:Description>"),
        b"not xml at all",
        enveloped('<rdf:Description Camera:BandName=""/>'),
        "<x:xmpmeta></x:xmpmeta>",
    ],
)
def test_malformed_or_empty_xmp_is_no_xmp(bad: bytes) -> None:
    assert Packet.parse(bad).values() == {}


@pytest.mark.parametrize(
    ("value", "expected"), [(0.25, 0.25), (3, 3.0), ((1, 4), None), (None, None), ("x", None), (float("inf"), None)]
)
def test_a_finite_number(value: object, expected: float | None) -> None:
    assert finite(value) == expected


@pytest.mark.parametrize(("unit", "density"), [(4, 266.0), (3, 26.6), (2, 266 / 25.4), (5, 266_000.0), (9, None)])
def test_pixel_density_by_unit(unit: int, density: float | None) -> None:
    tags = Tags(exif={"FocalPlaneXResolution": 266.0, "FocalPlaneResolutionUnit": unit})
    assert pixels_per_mm(tags) == (None if density is None else pytest.approx(density))


def test_reading_a_file(flight: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(flight / "0000SET" / "000" / "IMG_0002_4.tif", tmp_path))
    directories = read_directories(path)
    add_directories(path, {50714: rational(4800, 4801, 4799, 4804)}, directories[EXIF], directories[GPS])
    tags = read_tags(path)
    assert (tags.make, tags.model, tags.serial) == ("MicaSense", "RedEdge-M", "SY01-0000001-AG")
    assert tags.numbers(NAMESPACE, "RigRelatives") == (0.55, -0.16, 0.21)
    assert tags.black_level == pytest.approx(4801)


# ---- changes of packets


VALUES = {(NAMESPACE, "PrincipalPoint"): ("2.4", "1.8"), (NAMESPACE, "BandName"): ("Red",)}
OTHER = {(NAMESPACE, "PrincipalPoint"): ("9", "8"), (NAMESPACE, "RigRelatives"): ("1", "2", "3")}


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
@pytest.mark.parametrize("theirs", ["attributes", "elements", "sequences"])
def test_taking_anothers_values(dialect: str, theirs: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.take(Packet.parse(packet(OTHER, theirs)), [(NAMESPACE, "PrincipalPoint"), (NAMESPACE, "RigRelatives")])
    result = Packet.parse(mine.serialised()).values()
    values = {k: ",".join(v).replace(" ", "") for k, v in result.items() if k[0] == NAMESPACE}
    assert values == {
        (NAMESPACE, "PrincipalPoint"): "9,8",
        (NAMESPACE, "RigRelatives"): "1,2,3",
        (NAMESPACE, "BandName"): "Red",
    }


def test_taking_values_from_a_packet_without_them_removes_them() -> None:
    mine = Packet.parse(packet(VALUES, "elements"))
    mine.take(Packet(), [(NAMESPACE, "PrincipalPoint")])
    assert {name for _, name in mine.values()} == {"BandName"}


def test_an_empty_packet_stays_empty() -> None:
    empty = Packet.parse(b"<x:xmpmeta><broken</x:xmpmeta>")
    empty.put((NAMESPACE, "BandName"), ["x"])
    empty.take(Packet.parse(packet(OTHER, "elements")), [(NAMESPACE, "PrincipalPoint")])
    assert empty.serialised() == b""
    assert empty.values() == {}


@pytest.mark.parametrize(
    ("offsets", "expected"),
    [
        ({}, "2026-06-21T10:00:02.000000"),
        ({Base.OffsetTimeOriginal: "+02:00"}, "2026-06-21T10:00:02.000000+02:00"),
        ({Base.OffsetTime: "+02:00"}, "2026-06-21T10:00:02.000000"),  # of the time of another tag
        ({Base.OffsetTimeOriginal: "   :  "}, "2026-06-21T10:00:02.000000"),
        ({Base.OffsetTimeOriginal: "+99:00"}, "2026-06-21T10:00:02.000000"),
    ],
)
def test_the_time_has_the_offset_of_its_own_tag(
    flight: Path, tmp_path: Path, offsets: dict[int, str], expected: str
) -> None:
    path = Path(shutil.copy(flight / "0000SET" / "000" / "IMG_0002_4.tif", tmp_path))
    directories = read_directories(path)
    added = {tag: text(value) for tag, value in offsets.items()}
    add_directories(path, {}, directories[EXIF] | added, directories[GPS])
    assert read_tags(path).captured_at == expected


def test_a_time_is_in_utc_or_by_the_clock_of_the_camera() -> None:
    ten = datetime(2026, 6, 21, 10, tzinfo=UTC)
    for moment in ("2026-06-21T12:00:00+02:00", "2026-06-21T10:00:00Z", "2026-06-21T10:00:00+00:00"):
        assert CaptureTime.of(moment) == (ten, "camera")
    assert CaptureTime.of("2026-06-21T10:00:00") == (ten, "clock of the camera (time zone unknown)")
    for moment in ("", "21 June", "2026-13-01T00:00:00", "0001-01-01T00:00:00+05:00"):
        assert CaptureTime.of(moment) is None


def test_cameras_that_write_utc_have_it_in_their_captures() -> None:
    by_clock = Tags(captured_at="2026-06-21T12:00:00")
    assert MicaSense().captured_at(by_clock) == "2026-06-21T12:00:00+00:00"
    assert MicaSense().captured_at(replace(by_clock, captured_at="2026-06-21T12:00:00+02:00"))[11:13] == "10"
    assert MicaSense().captured_at(Tags()) == ""
    assert Dji().captured_at(by_clock) == by_clock.captured_at
    with_utc = replace(by_clock, xmp={("dji.com/drone-dji", "UTCAtExposure"): ("2026-06-21T10:00:00.5",)})
    assert Dji().captured_at(with_utc) == "2026-06-21T10:00:00.500000+00:00"
