import pytest

from agalign.cameras.xmp import Packet

from .test_vendors import packet

VALUES = {("Camera", "PrincipalPoint"): ("2.4", "1.8"), ("Camera", "BandName"): ("Red",)}
OTHER = {("Camera", "PrincipalPoint"): ("9", "8"), ("Camera", "RigRelatives"): ("1", "2", "3")}


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
def test_values_are_changed_in_the_form_they_have(dialect: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.put(("Camera", "PrincipalPoint"), ["1", "2"])
    again = Packet.parse(mine.serialised()).values()
    assert ",".join(again["Camera", "PrincipalPoint"]) == "1,2"
    assert again["Camera", "BandName"] == ("Red",)
    assert b"Camera:" in mine.serialised()


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
@pytest.mark.parametrize("theirs", ["attributes", "elements", "sequences"])
def test_taking_anothers_values(dialect: str, theirs: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.take(Packet.parse(packet(OTHER, theirs)), [("Camera", "PrincipalPoint"), ("Camera", "RigRelatives")])
    values = {k: ",".join(v).replace(" ", "") for k, v in Packet.parse(mine.serialised()).values().items()}
    assert values == {
        ("Camera", "PrincipalPoint"): "9,8", ("Camera", "RigRelatives"): "1,2,3", ("Camera", "BandName"): "Red",
    }  # fmt: skip


def test_taking_from_one_that_has_none_removes() -> None:
    mine = Packet.parse(packet(VALUES, "elements"))
    mine.take(Packet(), [("Camera", "PrincipalPoint")])
    assert set(mine.values()) == {("Camera", "BandName")}


def test_an_empty_packet_stays_empty() -> None:
    empty = Packet.parse(b"<x:xmpmeta><broken</x:xmpmeta>")
    empty.put(("Camera", "BandName"), ["x"])
    empty.take(Packet.parse(packet(OTHER, "elements")), [("Camera", "PrincipalPoint")])
    assert empty.serialised() == b""
    assert empty.values() == {}
