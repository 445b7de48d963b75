"""Damage to the files of a run is found by their checksums, and named."""

import hashlib
import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from pydantic_core import to_json
from scipy.interpolate import CloughTocher2DInterpolator, RectBivariateSpline

from agalign.config import CheckSettings, Settings
from agalign.errors import InputError, OutputError, SidecarError
from agalign.records.captures import bands_of
from agalign.records.sidecar import FilePart, Sidecar
from agalign.records.sidecar_file import (
    content_checksum,
    find_sidecars,
    read_checked,
    read_sidecar,
    verify_outputs,
    write_sidecar,
)
from agalign.values import geometry
from agalign.values.capture import Band, Capture, source_file
from agalign.values.issues import COVERAGE, RETRIEVAL, Issue
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping

from ..builders import joint_result
from ..conftest import read_json
from ..run_outputs import aligned

ALIGNED = {"status": "aligned", "reason": None}
NIR = {"band": "NIR", "file": "n.tif", "band_index": 1, "status": "failed", "seconds": 0, "wavelength_nm": None}


def example(**changes: Any) -> Sidecar:
    """A sidecar with the reference band, unless it is one of the `bands` in the changes."""
    reference = {"band": "Green", "file": "g.tif", "band_index": 1, "width": 10, "height": 8}
    camera = {"make": "", "model": "", "serial": ""}
    output = {"file": "IMG_1.tif", "crop": (0, 0, 10, 8), "nodata": None}
    names = {"agalign": "0", "capture": "IMG_1", "capture_id": "x", "flight_id": "", "captured_at": ""}
    bands = {
        "estimated_with": "0",
        "accept_predicted_px": 1.0,
        "camera": camera,
        "status": "ok",
        "missing_bands": [],
        "reference": reference,
    }
    facts = names | bands | {"output": output, "bands": [NIR | {"reason": None}]} | changes
    name = facts["reference"]["band"]
    if name not in [band["band"] for band in facts["bands"]]:
        facts["bands"] = [*facts["bands"], NIR | {"reason": None, "band": name, "status": "reference"}]
    return Sidecar.model_validate_json(to_json(facts))


def test_the_sidecars_of_a_run_inside_of_another_are_its_own(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "0000SET", tmp_path / "second" / "0000SET"):
        folder.mkdir(parents=True, exist_ok=True)
        write_sidecar(folder / "IMG_1.json", example())
    (tmp_path / "second" / "agalign-run.json").touch()
    assert find_sidecars(tmp_path) == [tmp_path / "0000SET" / "IMG_1.json", tmp_path / "IMG_1.json"]
    assert find_sidecars(tmp_path / "second") == [tmp_path / "second" / "0000SET" / "IMG_1.json"]


@pytest.mark.slow
def test_a_sidecar_names_its_images(flight: Path, aligned_flight: Path) -> None:
    folder = Path(read_json(aligned_flight / "agalign-run.json")["input"])
    assert folder == flight
    for path in find_sidecars(aligned_flight):
        content = read_json(path)
        for part in (content["reference"], *content["bands"]):
            assert (folder / part["file"]).is_file()


def test_files_of_equal_names_in_two_folders_are_distinct() -> None:
    bands = tuple(Band(name, Path("in", name, "IMG_6.jpg"), 1, 10, 8, "uint8") for name in ("RGB", "NDRE"))
    capture = Capture("IMG_6", Path(), bands, 0, root=Path("in"))
    assert [source_file(capture, b) for b in bands] == ["RGB/IMG_6.jpg", "NDRE/IMG_6.jpg"]
    there = capture.with_absolute_paths()
    assert [source_file(there, b) for b in there.bands] == ["RGB/IMG_6.jpg", "NDRE/IMG_6.jpg"]
    assert source_file(replace(capture, root=None), bands[0]) == Path("in/RGB/IMG_6.jpg").absolute().as_posix()


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "IMG_1.json"
    write_sidecar(path, example())
    assert read_sidecar(path).model_copy(update={"checksum": None}) == example()
    assert read_json(path)["schema"] == "agalign/3"
    assert not list(path.parent.glob(".*"))
    with pytest.raises(OutputError, match=r"IMG_1\.json"):
        write_sidecar(path / "IMG_1.json", example())


def test_the_schema_accepts_and_refuses() -> None:
    schema = Sidecar.json_schema()
    data = example().model_dump(by_alias=True, mode="json")
    jsonschema.validate(data, schema)
    for change in ({"status": "fine"}, {"schema": "agalign/1"}, {"bands": [{"band": "x"}]}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(data | change, schema)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "JSON"),
        ("[]", "schema"),
        ('{"schema": "agalign/9"}', "agalign/9"),
        ('{"schema": "agalign/3"}', "agalign: "),
        ('{"schema": "agalign/1"}', "schema is 'agalign/1', not 'agalign/3'; run again into a new folder"),
        ('{"schema": "agalign/2", "agalign": "0.1", "bands": [3]}', "schema is 'agalign/2' of agalign 0.1, not"),
    ],
)
def test_bad_sidecars_are_named(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(SidecarError, match=rf"bad\.json: .*{word}"):
        read_sidecar(path)


def test_other_json_files_are_passed_over(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "a" / "IMG_1.json", example())
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    shutil.copy(tmp_path / "a" / "IMG_1.json", tmp_path / "a" / ".agalign-part-host-1-0123.json")  # of another command
    assert find_sidecars(tmp_path) == [tmp_path / "a" / "IMG_1.json"]


def test_a_rejected_result_is_not_accepted_in_the_sidecar() -> None:
    """The homography of a `seed_only` band is the seed's; `joint` has the one that was doubted."""
    bands = tuple(Band(name, Path(f"{name}.tif"), 1, 64, 48, "uint16") for name in ("green", "nir"))
    capture, mapping = Capture("c", Path(), bands, 0), PixelMapping(geometry.translation(3, 4))
    issues = (Issue(RETRIEVAL, 0.1, 0.2), Issue(COVERAGE, math.nan, 0.6))
    settings = Settings(check=CheckSettings(accept_predicted_px=0.25))
    for status, of_status in (("seed_only", issues), ("aligned", ())):
        alignment = aligned(mapping, (64, 48), status, issues=of_status, joint=joint_result())
        sidecar = Sidecar.estimated(capture, {"nir": alignment}, settings)
        assert sidecar.accept_predicted_px == 0.25
        part = json.loads(sidecar.model_dump_json())["bands"][1]
        assert part["status"] == status
        np.testing.assert_array_equal(part["homography"]["fixed_to_moving"], mapping.fixed_to_moving)
        np.testing.assert_array_equal(part["joint"]["fixed_to_moving"], np.eye(3))
        assert [issue["kind"] for issue in part["issues"]] == [issue.code for issue in of_status]
        assert [issue["value"] for issue in part["issues"]] == [0.1, None][: len(of_status)]


def test_the_grid_is_fine_where_a_lens_bends_it() -> None:
    """Interpolated as its documentation describes, it is the mapping to two hundredths of a px."""
    size_px, wide = (1037, 777), Lens(1490.0, 1490.0, 1056.0, 790.0, (-0.11, 0.012, 0.0, 0.0, -0.02))
    plain = Lens(870.0, 870.0, 518.0, 388.0)
    bands = (
        Band("green", Path("g.tif"), 1, *size_px, "uint16", lens=plain),
        Band("rgb", Path("c.jpg"), 1, 2112, 1582, "uint8", lens=wide),
        Band("red", Path("r.tif"), 1, *size_px, "uint16", lens=plain),
    )
    mappings = {
        "rgb": PixelMapping(geometry.compose(wide.matrix, geometry.invert(plain.matrix)), plain, wide),
        "red": PixelMapping(geometry.translation(5.0, 2.0), plain, plain),
    }
    alignments = {name: aligned(mapping, size_px) for name, mapping in mappings.items()}
    at_px = np.random.default_rng(0).uniform((0, 0), (1036, 776), (500, 2))
    for part in Sidecar.estimated(Capture("c", Path(), bands, 0), alignments, Settings()).bands[1:]:
        reference_px, moving_px = np.array(part.grid.reference_px), np.array(part.grid.moving_px)
        x, y = np.unique(reference_px[:, 0]), np.unique(reference_px[:, 1])
        assert (len(x), len(y)) == ((57, 43) if part.band == "rgb" else (17, 13))
        splines = (RectBivariateSpline(y, x, v.reshape(len(y), len(x))) for v in moving_px.T)
        for there in (
            CloughTocher2DInterpolator(reference_px, moving_px)(at_px),
            np.stack([s.ev(at_px[:, 1], at_px[:, 0]) for s in splines], axis=-1),
        ):
            assert np.percentile(np.abs(there - mappings[part.band](at_px)), 99) < 0.02


def test_the_reference_is_one_of_the_bands(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_sidecar(path, example())
    data = read_json(path)
    path.write_text(json.dumps(data | {"reference": data["reference"] | {"band": "Ghost"}}))
    for read in (read_sidecar, read_checked):
        with pytest.raises(SidecarError, match=r"a\.json: bands: none of them is the reference band 'Ghost'"):
            read(path)


@pytest.mark.parametrize("name", ["../a.tif", "/vsicurl/http://example.org/a.tif", "C:/a.tif"])
def test_a_sidecar_names_no_file_elsewhere(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.json"
    write_sidecar(path, example())
    data, file = read_json(path), {"file": name, "bytes": 1}
    for changes in (
        {"output": data["output"] | {"file": name}},
        {"capture": name},
        {"bands": [data["bands"][0] | {"place": {"file": name, "band_index": 1}}]},
        {"products": [file | {"kind": "stack", "sha256": ""}]},
        {"parallax": file | {"kind": "parallax", "sha256": ""}},
    ):
        path.write_text(json.dumps(data | changes))
        with pytest.raises(SidecarError, match="names a file outside its folder"):
            read_sidecar(path)


DATA = b"pixels of a stack"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A run of one capture with one file."""
    (tmp_path / "IMG_1.tif").write_bytes(DATA)
    part = FilePart(kind="stack", file="IMG_1.tif", bytes=len(DATA), sha256=hashlib.sha256(DATA).hexdigest())
    write_sidecar(tmp_path / "IMG_1.json", example(products=[part]))
    return tmp_path


def problems(out: Path) -> list[str]:
    return [text.replace(f"{out}{os.sep}", "") for _, texts in verify_outputs(out) for text in texts]


def test_damage_is_found_by_checksums_and_named(out: Path) -> None:
    image, sidecar = out / "IMG_1.tif", out / "IMG_1.json"
    assert problems(out) == []
    image.write_bytes(DATA.replace(b"p", b"q", 1))
    assert problems(out) == ["IMG_1.tif: is not what was written; delete it and run again"]
    image.unlink()
    assert problems(out) == ["IMG_1.tif: cannot be read (No such file or directory); run again"]
    (out / "IMG_0.json").write_text('{"schema": "agalign/1"')
    assert len(problems(out)) == 2, "a sidecar that cannot be read stops no other"
    (out / "IMG_0.json").unlink()
    os.mkfifo(image)
    assert problems(out) == ["IMG_1.tif: cannot be read (it is not a regular file); run again"]
    write_sidecar(sidecar, example(not_written=["picture"]))
    assert problems(out) == ["IMG_1.json: its picture could not be written; run again"]
    write_sidecar(sidecar, example(output=None))
    assert problems(out) == ["IMG_1.json: its rasters were not written; run again"]
    assert [b.problem for b in bands_of(example(bands=[NIR | ALIGNED], output=None), out)] == [
        f"the pixels of {name} were not written; run again" for name in ("NIR", "Green")
    ]
    write_sidecar(sidecar, example(not_written=["picture"]))
    sidecar.write_text(sidecar.read_text().replace('"width": 10', '"width": 11'))
    assert "IMG_1.json: was changed after it was written; run again" in problems(out)
    sidecar.unlink()
    with pytest.raises(InputError, match="no sidecars there"):
        problems(out)


@pytest.mark.parametrize("mask_qa", [True, False])
def test_the_bands_of_a_failed_capture_say_why_it_failed(mask_qa: bool) -> None:
    """Not that pixels of the reference were not written, or that it was aligned without quality flags."""
    failed = example(bands=[NIR | {"status": "failed", "reason": "it is blank"}], output=None)
    problems = [band.problem for band in bands_of(failed, Path(), mask_qa=mask_qa)]
    assert problems == ["NIR is failed (it is blank)", "its capture has no aligned pixels: NIR is failed (it is blank)"]


def test_a_sidecar_that_does_not_exist_is_not_to_be_deleted(tmp_path: Path) -> None:
    with pytest.raises(SidecarError, match=r"IMG_7\.json: does not exist; give the sidecar of a capture"):
        read_sidecar(tmp_path / "IMG_7.json")


def test_seconds_do_not_change_the_checksum() -> None:
    one = {"bands": [{"band": "NIR", "seconds": 1.0}], "seconds": 2.0, "checksum": "x"}
    other = {"seconds": 3.0, "bands": [{"seconds": 4.0, "band": "NIR"}]}
    assert content_checksum(json.dumps(one)) == content_checksum(json.dumps(other))
    assert content_checksum(json.dumps(one)) != content_checksum(json.dumps(other | {"bands": []}))
