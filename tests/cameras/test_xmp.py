import pytest

from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.xmp import Packet

from .test_vendors import packet

VALUES = {(NAMESPACE, "PrincipalPoint"): ("2.4", "1.8"), (NAMESPACE, "BandName"): ("Red",)}
OTHER = {(NAMESPACE, "PrincipalPoint"): ("9", "8"), (NAMESPACE, "RigRelatives"): ("1", "2", "3")}


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
def test_values_are_changed_in_the_form_they_have(dialect: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.put((NAMESPACE, "PrincipalPoint"), ["1", "2"])
    again = Packet.parse(mine.serialised()).values()
    assert ",".join(again[NAMESPACE, "PrincipalPoint"]) == "1,2"
    assert again[NAMESPACE, "BandName"] == ("Red",)
    assert b"Camera:" in mine.serialised()


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
@pytest.mark.parametrize("theirs", ["attributes", "elements", "sequences"])
def test_taking_anothers_values(dialect: str, theirs: str) -> None:
    mine = Packet.parse(packet(VALUES, dialect))
    mine.take(Packet.parse(packet(OTHER, theirs)), [(NAMESPACE, "PrincipalPoint"), (NAMESPACE, "RigRelatives")])
    result = Packet.parse(mine.serialised()).values()
    values = {k: ",".join(v).replace(" ", "") for k, v in result.items() if k[0] == NAMESPACE}
    assert values == {
        (NAMESPACE, "PrincipalPoint"): "9,8", (NAMESPACE, "RigRelatives"): "1,2,3", (NAMESPACE, "BandName"): "Red",
    }  # fmt: skip


def test_taking_from_one_that_has_none_removes() -> None:
    mine = Packet.parse(packet(VALUES, "elements"))
    mine.take(Packet(), [(NAMESPACE, "PrincipalPoint")])
    assert {name for _, name in mine.values()} == {"BandName"}


def test_an_empty_packet_stays_empty() -> None:
    empty = Packet.parse(b"<x:xmpmeta><broken</x:xmpmeta>")
    empty.put((NAMESPACE, "BandName"), ["x"])
    empty.take(Packet.parse(packet(OTHER, "elements")), [(NAMESPACE, "PrincipalPoint")])
    assert empty.serialised() == b""
    assert empty.values() == {}
