"""Damaged XMP packets, lists of bands in tags, and missing tags of the radiance."""

import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from agalign.batch.capture_task import missing_radiometry
from agalign.cameras.discover import FolderScan, discover
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.tiff_directory import byte_string, rational, short, text
from agalign.cameras.xmp import Packet
from agalign.flight.groups import camera_overviews, flights_of
from agalign.pixels.radiometry import with_radiometry
from agalign.values.capture import Capture

from .test_vendors import SIZE, packet, tagged, write_file

PACKET = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0" Camera:RigName="RedEdge-M">
   <Camera:BandName>{band}</Camera:BandName>
   <Camera:CentralWavelength>{nm}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>20</Camera:WavelengthFWHM>
   <Camera:PrincipalPoint>{x},0.2271</Camera:PrincipalPoint>
   <Camera:PerspectiveFocalLength>5.45</Camera:PerspectiveFocalLength>
   <Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>
   <Camera:RigRelatives>0.1, 0.2, 0.3</Camera:RigRelatives>
   <Camera:VignettingCenter><rdf:Seq><rdf:li>80.0</rdf:li><rdf:li>60.0</rdf:li></rdf:Seq></Camera:VignettingCenter>
  </rdf:Description>
  <rdf:Description rdf:about="" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:CaptureId>{capture}</MicaSense:CaptureId>
   <MicaSense:FlightId>flight1</MicaSense:FlightId>
   <MicaSense:RadiometricCalibration>1e-4,0,0</MicaSense:RadiometricCalibration>
  </rdf:Description>
  <rdf:Description rdf:about="" xmlns:DLS="http://micasense.com/DLS/1.0/">
   <DLS:HorizontalIrradiance>80.0</DLS:HorizontalIrradiance>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""
Change = Callable[[str], str]
"""A change of a packet."""
Bands = dict[int, tuple[str, int]]
"""{number of the file: (band, wavelength in nm)}."""
NOON = "2026:06:21 12:00:00"
BANDS = {2: ("Green", 560), 3: ("Red", 668), 4: ("NIR", 840)}


def replaced(old: str, new: str) -> Change:
    def change(packet: str) -> str:
        assert old in packet
        return packet.replace(old, new, 1)

    return change


DAMAGES: dict[str, Change] = {
    "two end tags": lambda p: p + "\n</x:xmpmeta>",
    "an end tag too many in the middle": replaced("</rdf:Description>", "</rdf:Description></rdf:Description>"),
    "no wrapper": lambda p: re.sub(r"</?x:xmpmeta[^>]*>", "", p),
    "xapmeta": lambda p: p.replace("x:xmpmeta", "x:xapmeta"),
    "undeclared prefix of RDF": replaced(' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"', ""),
    "undeclared unknown prefix": replaced("<Camera:Wave", "<foo:Bar>1</foo:Bar><Camera:Wave"),
    "damaged namespace": replaced("http://pix4d.com/camera", "http://pix4x.com/camera"),
    "damaged namespace of RDF": replaced("22-rdf-syntax", "22-rdf-syntay"),
    "ampersand in an attribute": replaced("RedEdge-M", "R&D RedEdge-M"),
    "control characters": replaced("RedEdge-M", "Red\x01Edge\x0b-M"),
    "a tag that is not closed": replaced("</Camera:WavelengthFWHM>", ""),
    "a band's name that is not closed": replaced("</Camera:BandName>", ""),
    "a description that is not closed": replaced("</rdf:Description>", ""),
    "duplicate attribute": replaced(' Camera:RigName="', ' Camera:RigName="x" Camera:RigName="'),
}
"""Damages after which all tags that matter can be read."""


def write_capture(
    folder: Path, number: int = 1, change: Change = str, only: int = 0, bands: Bands = BANDS, at: str = NOON
) -> None:
    """Three bands of a RedEdge-M; `change` is that of the packets of all bands, or of that of one."""
    for k, (band, nm) in bands.items():
        xmp = PACKET.format(band=band, nm=nm, x=0.29 + k / 100, capture=f"capture{number}")
        xmp = change(xmp) if only in (0, k) else xmp
        first = {271: text("MicaSense"), 272: text("RedEdge-M"), 700: byte_string(xmp.encode()), 50714: short(4800)}
        exif = {0xA20E: rational(266.67), 0xA20F: rational(266.67), 0xA210: short(4), 0x829A: rational(0.001)}
        exif |= {0x8827: short(100), 0x9003: text(at)}
        write_file(folder / f"IMG_{number:04d}_{k}.tif", first, exif)


def offers(capture: Capture) -> tuple[object, ...]:
    """What tags give: names, wavelengths, ids, lenses, rig and calibrations."""
    return (
        [(b.name, b.wavelength_nm, b.bandwidth_nm, str(b.lens), str(b.to_rig), b.radiometry) for b in capture.bands],
        (capture.capture_id, capture.flight_id, capture.reference.name),
    )


def intact(folder: Path) -> Capture:
    write_capture(folder)
    (capture,) = discover(folder).captures
    assert [b.name for b in capture.bands] == ["Green", "Red", "NIR"]
    assert all(b.lens is not None and b.radiometry is not None and b.radiometry.by_sun for b in capture.bands)
    return capture


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_packets_give_the_tags_of_intact_ones(tmp_path: Path, name: str) -> None:
    write_capture(tmp_path / "a", change=DAMAGES[name])
    scan = discover(tmp_path / "a")
    (capture,) = scan.captures
    assert offers(capture) == offers(intact(tmp_path / "b"))
    assert not [p.text for p in scan.problems if "foo" not in p.text]


@pytest.mark.parametrize("at", ["<Camera:BandName>Gr", "<Camera:Wave", "<Camera:Pers", "<MicaSense:Fl", "</x:xmpmeta"])
def test_a_cut_packet_keeps_the_camera_and_names_what_is_missing(tmp_path: Path, at: str) -> None:
    for number in (1, 2, 3):
        write_capture(tmp_path, number, lambda p: p[: p.index(at) + len(at)] if number == 2 else p, only=2)  # noqa: B023
    scan = discover(tmp_path)
    assert [[b.name for b in c.bands] for c in scan.captures] == [["Green", "Red", "NIR"]] * 3
    assert {c.reference.name for c in scan.captures} == {"Green"}
    assert len(flights_of(scan.captures)) == 1
    assert len(camera_overviews(scan.captures)) == 1
    assert scan.is_complete
    if at == "</x:xmpmeta":
        assert not scan.problems
        return
    (problem,) = scan.problems
    assert "IMG_0002_2.tif: its XMP packet is damaged and lacks its end, " in problem.text
    assert "BandName" not in problem.text or "BandName" in at
    assert ("CentralWavelength" in problem.text) == ("BandName" in at)
    assert ("FlightId" in problem.text) == ("MicaSense" in at)


def test_a_cut_value_is_left_out() -> None:
    values = Packet.parse(PACKET[: PACKET.index("{nm}")].format(band="Green") + "5").values()
    assert values[NAMESPACE, "BandName"] == ("Green",)
    assert (NAMESPACE, "CentralWavelength") not in values
    in_list = PACKET[: PACKET.index("<rdf:li>60.0")].format(band="Green", nm=560, x=1)
    assert (NAMESPACE, "VignettingCenter") not in Packet.parse(in_list).values()
    attributes = PACKET[: PACKET.index("RedEdge-M")] + 'Red" Camera:BandName="Green" Camera:RigRelatives="1, 2'
    values = Packet.parse(attributes).values()
    assert (values[NAMESPACE, "RigName"], values[NAMESPACE, "BandName"]) == (("Red",), ("Green",))
    assert (NAMESPACE, "RigRelatives") not in values


def test_a_packet_without_any_tag_has_a_line(tmp_path: Path) -> None:
    write_capture(tmp_path, change=lambda _: "no XML at all", only=3)
    (problem,) = discover(tmp_path).problems
    assert "IMG_0001_3.tif: its XMP packet is damaged and lacks its end, " in problem.text


def test_a_damaged_packet_is_repaired_for_outputs() -> None:
    packet = Packet.parse(DAMAGES["a tag that is not closed"](PACKET))
    again = Packet.parse(packet.serialised())
    assert again.unread is None
    assert again.values() == packet.values()


def test_hostile_packets_cost_nothing() -> None:
    entities = '<!DOCTYPE l [<!ENTITY a "b"><!ENTITY c "&a;&a;">]>'
    values = Packet.parse(entities + PACKET.format(band="&c;", nm=1, x=1, capture=1)).values()
    assert (NAMESPACE, "BandName") not in values
    assert values[NAMESPACE, "CentralWavelength"] == ("1",)
    deep = PACKET.replace("<Camera:BandName>", "<Camera:a>" * 20_000 + "<Camera:BandName>")
    assert Packet.parse(deep).unread
    wide = PACKET.replace("rdf:about", " ".join(f'Camera:n{i}="1"' for i in range(5_000)) + " rdf:about")
    assert len(Packet.parse(wide + "</x>").values()) > 5_000


# ---- lists of bands


def write_stack(path: Path, names: str, wavelengths: str, dialect: str = "sequences") -> FolderScan:
    """A file of three bands; spaces separate the items of its lists."""
    xmp = packet(tagged(NAMESPACE, BandName=names, CentralWavelength=wavelengths), dialect)
    write_file(path, {700: byte_string(xmp)}, shape=(3, *SIZE[::-1]))
    return discover(path.parent)


@pytest.mark.parametrize("dialect", ["sequences", "elements"])
def test_lists_in_tags_have_an_item_for_each_band(tmp_path: Path, dialect: str) -> None:
    scan = write_stack(tmp_path / "field.tif", "Green Red NIR", "560 668 840", dialect)
    (capture,) = scan.captures
    assert {b.name: b.wavelength_nm for b in capture.bands} == {"Green": 560, "Red": 668, "NIR": 840}
    assert not scan.problems


@pytest.mark.parametrize(
    ("names", "wavelengths", "counts"),
    [
        ("Green Red", "560 668 840", "2 names and 3 wavelengths"),
        ("Green", "560", "1 name and 1 wavelength of"),
        ("Green Red", "560 668", "2 names and 2 wavelengths"),
        ("Green Red NIR", "560 840", "3 names and 2 wavelengths"),
    ],
)
def test_lists_of_other_lengths_have_a_line(tmp_path: Path, names: str, wavelengths: str, counts: str) -> None:
    scan = write_stack(tmp_path / "field.tif", names, wavelengths)
    (capture,) = scan.captures
    (problem,) = scan.problems
    assert "field.tif: has 3 bands, and its tags list " + counts in problem.text
    assert len({b.wavelength_nm for b in capture.bands}) == (3 if "3 wave" in counts else 1)
    of_tags = {b.name for b in capture.bands} & {*names.split()}
    assert len(of_tags) == (3 if "3 names" in counts else 0)


# ---- reasons


CHOICES = "auto", "camera", "sun", "panel"


def reason(folder: Path, choice: str) -> str:
    """Why the capture in a folder has no radiometry by a choice."""
    (capture,) = discover(folder).captures
    return missing_radiometry(with_radiometry(capture, choice, {}), choice)


def overview(folder: Path) -> str:
    return camera_overviews(discover(folder).captures)[0].text


@pytest.mark.parametrize("choice", CHOICES)
def test_reasons_name_the_missing_tag_and_give_advice_that_works(tmp_path: Path, choice: str) -> None:
    """Without any calibration no choice is advised; without a light sensor others are."""
    for name in ("a_green", "a_red"):
        write_file(tmp_path / "plain" / f"{name}.tif")
    assert reason(tmp_path / "plain", choice) == "no tags for radiance in green, red; leave --radiometry out"
    write_capture(tmp_path / "no", change=lambda p: re.sub("<MicaSense:Radiom.*>", "", p))
    why = "no tag RadiometricCalibration for radiance"
    assert reason(tmp_path / "no", choice) == f"{why} in Green, Red, NIR; leave --radiometry out"
    assert overview(tmp_path / "no").endswith(f"radiometry: {why}")
    write_capture(tmp_path / "no_sun", change=lambda p: re.sub("<DLS:.*>", "", p))
    assert ("--radiometry" in reason(tmp_path / "no_sun", choice)) == (choice in ("sun", "panel"))
    assert ("no usable tags of a light sensor" in reason(tmp_path / "no_sun", choice)) == (choice == "sun")


def test_the_calibration_of_a_sequoia_is_named(tmp_path: Path) -> None:
    xmp = byte_string(packet(tagged(NAMESPACE, SensorModel="1"), "elements"))
    for part in ("GRE", "RED"):
        first = {271: text("Parrot"), 272: text("Sequoia"), 700: xmp}
        write_file(tmp_path / f"IMG_180413_080658_0000_{part}.TIF", first)
    why = "no tags for radiance (SensorModel and IrradianceList are not used)"
    assert overview(tmp_path).endswith(f"radiometry: {why}")
    assert reason(tmp_path, "sun") == f"{why} in Green, Red; leave --radiometry out"


# ---- a card for each half of a dual camera


OTHER_HALF = {7: ("Green-531", 531), 8: ("Red-650", 650)}


def test_the_halves_of_a_dual_camera_are_joined(tmp_path: Path) -> None:
    for number in (1, 2):
        write_capture(tmp_path / "red", number)
        write_capture(tmp_path / "blue", number, bands=OTHER_HALF)
    captures = discover(tmp_path).captures
    names = {"Green", "Red", "NIR", "Green-531", "Red-650"}
    assert [{b.name for b in c.bands} for c in captures] == [names] * 2
    assert len({c.capture_id for c in captures}) == 2


@pytest.mark.parametrize(
    ("bands", "at", "captures"), [(BANDS, NOON, 1), (OTHER_HALF, "2026:06:22 12:00:00", 2)], ids=["copy", "next day"]
)
def test_an_id_in_another_folder_is_a_copy_only_at_the_same_time(
    tmp_path: Path, bands: Bands, at: str, captures: int
) -> None:
    write_capture(tmp_path / "a")
    write_capture(tmp_path / "b", bands=bands, at=at)
    assert [len(c.bands) for c in discover(tmp_path).captures] == [3, len(bands)][:captures]


@pytest.mark.parametrize(
    "part", [" Camera:a", "<Camera:a", " Camera:a=", 'xmlns:a="', "&", "a", "<a ", ">", " Camera:a\n"], ids=repr
)
def test_a_packet_without_delimiters_takes_no_quadratic_time(part: str) -> None:
    """Half a megabyte takes less than a second; a search from each name to the end takes minutes."""
    text = "<x:xmpmeta><rdf:RDF>" + part * ((1 << 19) // len(part))
    signal.alarm(60)
    try:
        Packet.parse(text)
    finally:
        signal.alarm(0)


def test_values_that_are_empty_are_not_called_unread() -> None:
    empty = '<x:xmpmeta><Camera:A></Camera:A><Camera:B/><Camera:C> </Camera:C> Camera:D="" Camera:E = "" '
    assert Packet.parse(empty).unread == ("its end",)
    assert Packet.parse(empty.replace("Camera:B/>", "Camera:B /x>")).unread == ("its end", "B")


def test_a_name_of_megabytes_is_shortened(tmp_path: Path) -> None:
    capture = write_stack(tmp_path / "a.tif", f"{'x' * 100_000},b,c", "500,600,700").captures[0]
    assert [len(b.name) for b in capture.bands] == [200, 1, 1]
