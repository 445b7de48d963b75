import json
from pathlib import Path

import jsonschema
import pytest

import agalign
from agalign.errors import OutputError, SidecarError
from agalign.products.sidecar import (
    CameraPart,
    OutputPart,
    ReferencePart,
    Sidecar,
    find_sidecars,
    read_sidecar,
    write_sidecar,
)

SHIPPED = Path(agalign.__file__).with_name("sidecar.schema.json")


def example() -> Sidecar:
    return Sidecar(
        agalign="0", capture="IMG_1", capture_id="x", flight_id="", captured_at="",
        camera=CameraPart(make="", model="", serial=""), status="ok", missing_bands=[],
        reference=ReferencePart(band="Green", file="g.tif", band_index=1, width=10, height=8),
        bands=[], output=OutputPart(file="IMG_1.tif", bytes=1, crop=(0, 0, 10, 8), nodata=None), settings="0",
    )  # fmt: skip


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "IMG_1.json"
    write_sidecar(path, example())
    assert read_sidecar(path) == example()
    assert json.loads(path.read_text())["schema"] == "agalign/1"
    assert not list(path.parent.glob(".*"))


def test_the_shipped_schema_is_the_models() -> None:
    assert json.loads(SHIPPED.read_text()) == Sidecar.model_json_schema(mode="serialization")


def test_the_schema_accepts_and_refuses() -> None:
    schema = json.loads(SHIPPED.read_text())
    data = example().model_dump(by_alias=True, mode="json")
    jsonschema.validate(data, schema)
    for change in ({"status": "fine"}, {"schema": "agalign/2"}, {"bands": [{"band": "x"}]}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(data | change, schema)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "JSON"),
        ("[]", "schema"),
        ('{"schema": "agalign/9"}', "agalign/9"),
        ('{"schema": "agalign/1"}', "agalign: "),
    ],
)
def test_bad_sidecars_are_named(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(SidecarError, match=r"bad\.json") as caught:
        read_sidecar(path)
    assert word in str(caught.value)
    with pytest.raises(SidecarError, match=r"missing\.json"):
        read_sidecar(tmp_path / "missing.json")


def test_other_json_files_are_passed_over(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "a" / "IMG_1.json", example())
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    assert find_sidecars(tmp_path) == [tmp_path / "a" / "IMG_1.json"]


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file"):
        write_sidecar(tmp_path / "file" / "IMG_1.json", example())
