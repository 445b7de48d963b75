import pytest

from agalign.cameras.pix4d import CAMERA
from agalign.cameras.xmp import Packet

from .test_vendors import packet

VALUES = {(CAMERA, "PrincipalPoint"): ("2.4", "1.8"), (CAMERA, "BandName"): ("Red",)}
OTHER = {(CAMERA, "PrincipalPoint"): ("9", "8"), (CAMERA, "RigRelatives"): ("1", "2", "3")}


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
def test_values_are_changed_in_the_form_they_have(dialect: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.put((CAMERA, "PrincipalPoint"), ["1", "2"])
    again = Packet.parse(mine.serialised()).values()
    assert ",".join(again[CAMERA, "PrincipalPoint"]) == "1,2"
    assert again[CAMERA, "BandName"] == ("Red",)
    assert b"Camera:" in mine.serialised()


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
@pytest.mark.parametrize("theirs", ["attributes", "elements", "sequences"])
def test_taking_anothers_values(dialect: str, theirs: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.take(Packet.parse(packet(OTHER, theirs)), [(CAMERA, "PrincipalPoint"), (CAMERA, "RigRelatives")])
    result = Packet.parse(mine.serialised()).values()
    values = {k: ",".join(v).replace(" ", "") for k, v in result.items() if k[0] == CAMERA}
    assert values == {
        (CAMERA, "PrincipalPoint"): "9,8", (CAMERA, "RigRelatives"): "1,2,3", (CAMERA, "BandName"): "Red",
    }  # fmt: skip


def test_taking_from_one_that_has_none_removes() -> None:
    mine = Packet.parse(packet(VALUES, "elements"))
    mine.take(Packet(), [(CAMERA, "PrincipalPoint")])
    assert {name for _, name in mine.values()} == {"BandName"}


def test_an_empty_packet_stays_empty() -> None:
    empty = Packet.parse(b"<x:xmpmeta><broken</x:xmpmeta>")
    empty.put((CAMERA, "BandName"), ["x"])
    empty.take(Packet.parse(packet(OTHER, "elements")), [(CAMERA, "PrincipalPoint")])
    assert empty.serialised() == b""
    assert empty.values() == {}
