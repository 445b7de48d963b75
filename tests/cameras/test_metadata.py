"""Tags of files and values of XMP packets."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL.ExifTags import Base

from agalign.cameras import read_files
from agalign.cameras.discover import FolderScan, discover
from agalign.cameras.dji import Dji
from agalign.cameras.metadata import Tags, finite, read_tags, tags_of
from agalign.cameras.micasense import CALIBRATION, MicaSense, calibration_of_output
from agalign.cameras.pix4d import NAMESPACE, SAME_ROWS, GridVignetting, perspective_lens, pixels_per_mm
from agalign.cameras.tag_transfer import band_tags
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, rational, read_directories, short, text
from agalign.cameras.xmp import Packet
from agalign.pixels.radiometry import calibrated
from agalign.values import geometry
from agalign.values.capture import Capture, CaptureTime, Panel
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import PixelScale

from .test_vendors import packet

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
ENVELOPE = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"
 xmlns:Camera="{camera}" xmlns:other="http://example.org/other/">{body}</rdf:RDF></x:xmpmeta><?xpacket end="w"?>"""


def enveloped(body: str, camera: str = "http://pix4d.com/camera/1.0") -> bytes:
    return ENVELOPE.format(body=body, camera=camera).encode()


@pytest.mark.parametrize("uri", ["http://pix4d.com/camera/1.0/", "http://pix4d.com/1.0", "http://www.pix4d.com/camera"])
def test_namespaces_are_places_whatever_their_version_and_slash(uri: str) -> None:
    values = Packet.parse(enveloped('<rdf:Description Camera:BandName="Red"/>', uri)).values()
    assert values[NAMESPACE, "BandName"] == ("Red",)


@pytest.mark.parametrize("body", ['<rdf:Description Camera:Yaw="1"/>', '<rdf:Description Camera:BandName="Red"/>'])
def test_a_value_is_added_in_a_namespace_of_the_packet_or_replaced(body: str) -> None:
    packet = Packet.parse(enveloped(body))
    packet.add((NAMESPACE, "Yaw"), "2")
    assert packet.values()[NAMESPACE, "Yaw"] == ("2",)
    packet.add(("example.org/other", "Yaw"), "3")
    assert ("example.org/other", "Yaw") not in packet.values(), "no value used this namespace"


def test_the_same_name_in_another_namespace_is_another_tag() -> None:
    tags = Tags(xmp=Packet.parse(enveloped('<rdf:Description other:Yaw="1"/>')).values())
    assert tags.number("example.org/other", "Yaw") == 1
    assert tags.number("example.org", "Yaw") == 1
    assert tags.number(NAMESPACE, "Yaw") is None
    assert tags.number("example.org/oth", "Yaw") is None


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


# ---- images that a program resized or cropped, with the camera's tags


def resized(source: Path, folder: Path, share: float, *, with_size: bool) -> Path:
    """Reduce the first capture of a flight, with its tags; `with_size` adds the size of the original to Exif."""
    folder.mkdir()
    for path in sorted(source.rglob("IMG_0001_*.tif")):
        pixels = tifffile.imread(path)
        size_px = round(share * pixels.shape[1]), round(share * pixels.shape[0])
        tifffile.imwrite(folder / path.name, cv2.resize(pixels, size_px, interpolation=cv2.INTER_AREA), metadata=None)
        tags = read_directories(path)
        first = {tag: entry for tag, entry in tags[0].items() if tag in (271, 272, 306, 700, 0xC61A)}
        size = {0xA002: short(pixels.shape[1]), 0xA003: short(pixels.shape[0])} if with_size else {}
        add_directories(folder / path.name, first, tags[EXIF] | size, tags[GPS])
    return folder


def only(scan: FolderScan) -> Capture:
    (capture,) = scan.captures
    return capture


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_tags_in_pixels_follow_the_size_that_exif_names(flight: Path, tmp_path: Path, share: float) -> None:
    scan = discover(resized(flight, tmp_path / "small", share, with_size=True))
    full, small = discover(flight).captures[0], only(scan)
    assert not scan.problems
    scale = PixelScale.between(full.bands[0].size_px, small.bands[0].size_px)
    for before, after in zip(full.bands, small.bands, strict=True):
        assert after.lens.fx_px == pytest.approx(share * before.lens.fx_px)
        point = np.array([[100.0, 80.0]])
        np.testing.assert_allclose(
            geometry.apply(after.to_rig, scale.positions(point)), geometry.apply(before.to_rig, point), atol=1e-9
        )
        # Equal numbers at one place of the scene are equal radiances.
        grey = np.full((before.height_px, before.width_px), 20000, np.uint16)
        radiance = calibrated(grey, before.radiometry, 0, 0)
        reduced = calibrated(grey[: after.height_px, : after.width_px], after.radiometry, 0, 0)
        expected = cv2.resize(radiance, after.size_px, interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(reduced, expected, rtol=1e-3)
    assert small.pose.focal_length_px == pytest.approx(share * full.pose.focal_length_px)


def test_the_area_of_a_panel_in_tags_follows_the_size_of_the_image(flight: Path) -> None:
    """In an image of unknown size relative to the camera's, the panel is searched for."""
    corners = ((100.0, 80.0), (140.0, 80.0), (140.0, 120.0), (100.0, 120.0))
    band = replace(discover(flight).captures[0].bands[0], panel=Panel("tags", albedo=0.5, corners_px=corners))
    half, small = PixelScale(0.5, 0.5), replace(band, width_px=band.width_px // 2, height_px=band.height_px // 2)
    of_camera = Tags(exif={"ExifImageWidth": band.width_px, "ExifImageHeight": band.height_px})
    reduced, scale, _ = read_files._of_image(small, of_camera, raw_step=1 << 16)
    assert scale == half
    np.testing.assert_allclose(reduced.panel.corners_px, half.positions(corners))
    assert read_files._without_lens(band, "cropped").panel == Panel("tags", albedo=0.5)


def test_tags_of_the_camera_are_not_written_for_an_image_of_another_size(flight: Path, tmp_path: Path) -> None:
    """agalign uses lens and row gradient scaled; other programs would use the tags as they are."""
    capture = only(discover(resized(flight, tmp_path / "small", 0.5, with_size=True)))
    band, grid = capture.bands[3], OutputGrid(0, 0, *capture.reference.size_px)
    first, exif, _ = band_tags(band, capture.reference, grid, GridVignetting((1, 1), (1e-5,), 0))
    known = Tags(xmp=Packet.parse(first[XMP].data).values())
    assert not known.text(NAMESPACE, "PrincipalPoint")
    assert Base.FocalPlaneXResolution not in exif
    assert known.numbers(NAMESPACE, "VignettingCenter") == (1, 1)
    with_gradient = Tags(xmp={CALIBRATION: ("1e-4", "1e-7", "1e-5")}, exif={"ExposureTime": 1e-3})
    small = replace(band, radiometry=replace(band.radiometry, row_gradient=2 * (1e-7 / 1e-3 - 1e-5)))
    assert calibration_of_output(with_gradient, small, SAME_ROWS)[1:] == pytest.approx((2e-7, 2e-5))


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_the_lens_of_another_image_size_is_left_out_with_a_line(flight: Path, tmp_path: Path, share: float) -> None:
    scan = discover(resized(flight, tmp_path / "small", share, with_size=False))
    (problem,) = scan.problems
    size = " x ".join(map(str, only(scan).bands[0].size_px))
    assert f"is not that of an image of {size} px, and so in 4 other files; lens, rig and radiometry" in problem.text
    assert all(b.lens is None and b.to_rig is None and b.radiometry is None for b in only(scan).bands)
    assert only(scan).pose == replace(discover(flight).captures[0].pose, focal_length_px=None)


@pytest.mark.parametrize(("size_px", "focal_px"), [((1280, 960), 1454.4), ((160, 120), 181.8), ((160, 80), None)])
def test_a_lens_in_mm_without_exif_has_its_centre_near_the_middle(
    size_px: tuple[int, int], focal_px: float | None
) -> None:
    values = {"PrincipalPoint": ("2.3745", "1.8165"), "PerspectiveFocalLength": ("5.45",)}
    tags = Tags(size_px=size_px, xmp={(NAMESPACE, name): value for name, value in values.items()})
    lens = perspective_lens(tags)
    assert (lens and lens.fx_px) == (focal_px and pytest.approx(focal_px, rel=1e-3))
    assert lens is None or lens.is_plausible(size_px)


@pytest.mark.parametrize(
    ("make", "fraction", "expected"),
    [
        ("MicaSense", "11205334", ".011205334"),
        ("MicaSense", "751305499", ".751305499"),
        ("Other", "1120533", ".1120533"),
    ],
)
def test_micasense_writes_nanoseconds_without_leading_zeros(make: str, fraction: str, expected: str) -> None:
    """As the counter of the light sensor shows: from 150.249 to 150.994 s the clock goes on to 16:26:19.756."""
    times = {Base.DateTimeOriginal: text("2021:06:23 16:26:19"), Base.SubsecTime: text(fraction)}
    assert tags_of({0: {Base.Make: text(make)}, EXIF: times, GPS: {}}).captured_at == f"2021-06-23T16:26:19{expected}"
