"""Damage to the files of a run is found by their checksums, and named."""

import hashlib
import json
import os
from pathlib import Path

import pytest

from agalign.errors import InputError
from agalign.products.sidecar import ProductPart
from agalign.products.sidecar_file import content_checksum, verify_outputs, write_sidecar

from .test_sidecar import example

DATA = b"pixels of a stack"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A run of one capture with one file."""
    (tmp_path / "IMG_1.tif").write_bytes(DATA)
    part = ProductPart(kind="stack", file="IMG_1.tif", bytes=len(DATA), sha256=hashlib.sha256(DATA).hexdigest())
    write_sidecar(tmp_path / "IMG_1.json", example().model_copy(update={"products": [part]}))
    return tmp_path


def problems(out: Path) -> list[str]:
    return [text.replace(f"{out}{os.sep}", "") for _, texts in verify_outputs(out) for text in texts]


def test_what_was_written_passes(out: Path) -> None:
    assert problems(out) == []


def test_a_changed_byte_is_found(out: Path) -> None:
    (out / "IMG_1.tif").write_bytes(DATA.replace(b"p", b"q", 1))
    assert problems(out) == ["IMG_1.tif: is not what was written; delete it and run again"]


def test_a_changed_number_in_a_sidecar_is_found(out: Path) -> None:
    path = out / "IMG_1.json"
    path.write_text(path.read_text().replace('"width": 10', '"width": 11'))
    assert problems(out) == ["IMG_1.json: was changed after it was written; run again with --overwrite"]


def test_missing_and_strange_files_are_named(out: Path) -> None:
    (out / "IMG_1.tif").unlink()
    assert problems(out) == ["IMG_1.tif: cannot be read (No such file or directory); run again"]
    os.mkfifo(out / "IMG_1.tif")
    assert problems(out) == ["IMG_1.tif: cannot be read (it is not a regular file); run again"]


def test_a_sidecar_that_cannot_be_read_stops_no_other(out: Path) -> None:
    (out / "IMG_0.json").write_text('{"schema": "agalign/1"')
    assert len(problems(out)) == 1
    (out / "IMG_1.tif").unlink()
    assert len(problems(out)) == 2


def test_what_could_not_be_written_is_named(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "IMG_1.json", example().model_copy(update={"not_written": ["picture"]}))
    assert problems(tmp_path) == ["IMG_1.json: its picture could not be written; run again"]


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no sidecars there"):
        list(verify_outputs(tmp_path))


def test_seconds_do_not_change_the_checksum() -> None:
    one = {"bands": [{"band": "NIR", "seconds": 1.0}], "seconds": 2.0, "checksum": "x"}
    other = {"seconds": 3.0, "bands": [{"seconds": 4.0, "band": "NIR"}]}
    assert content_checksum(json.dumps(one)) == content_checksum(json.dumps(other))
    assert content_checksum(json.dumps(one)) != content_checksum(json.dumps(other | {"bands": []}))
