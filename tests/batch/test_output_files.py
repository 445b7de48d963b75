"""What a run does with the path of an output, by what is there."""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import agalign
from agalign.batch.output_files import State, refuse_foreign_run_files, refuse_to_overwrite, remove_outputs
from agalign.records.sidecar_file import read_sidecar, write_sidecar
from agalign.values.capture import Capture

from ..conftest import Shared, seeded, write_capture

Case = tuple[Path, Sequence[Capture]]
"""A path of an output of the first capture, and the captures of a run."""
WRITING = agalign.WriteSettings(error_map=True)
NOT_WRITING = agalign.WriteSettings(layout="bands")


@pytest.fixture
def case(shared: Shared, tmp_path: Path) -> Case:
    """The error map of the first of two captures, which does not exist, beside the results of both."""

    def align(folder: Path) -> None:
        for name in "fg":
            write_capture(folder / "in", "green", "red", name=name, size_px=(200, 160))
        agalign.align_folder(folder / "in", folder / "out", settings=seeded("identity"))

    done = shared("two results", align)
    shutil.copytree(done / "out", tmp_path / "out")
    return tmp_path / "out" / "f.error.tif", agalign.discover(done / "in").captures


def no_file(case: Case) -> Case:
    return case


def link_to_none(case: Case) -> Case:
    case[0].symlink_to("none.tif")
    return case


def sidecar(case: Case) -> Case:
    return case[0].with_name("f.json"), case[1]


def as_listed(case: Case) -> Case:
    """Zeros of the size in the sidecar: the next command finds and repairs them."""
    stack = case[0].with_name("f.tif")
    stack.write_bytes(bytes(stack.stat().st_size))
    return stack, case[1]


def with_mark(case: Case) -> Case:
    """A file that a killed run has left, which no sidecar lists."""
    return Path(shutil.copy(case[0].with_name("f.tif"), case[0])), case[1]


def changed(case: Case) -> Case:
    stack = case[0].with_name("f.tif")
    stack.write_bytes(bytes(9))
    return stack, case[1]


def of_user(case: Case) -> Case:
    return Path(shutil.copy(case[1][0].reference.path, case[0])), case[1]


def pipe(case: Case) -> Case:
    os.mkfifo(case[0])
    return case


def link_to_a_folder(case: Case) -> Case:
    case[0].symlink_to(".")
    return case


def of_user_in_an_edited_sidecar(case: Case) -> Case:
    path, captures = of_user(case)
    sidecar = read_sidecar(path.with_name("f.json"))
    part = sidecar.products[0].model_copy(update={"file": path.name, "bytes": path.stat().st_size})
    text = sidecar.model_copy(update={"products": [*sidecar.products, part]}).model_dump_json(by_alias=True)
    path.with_name("f.json").write_text(text)  # the checksum stays
    return path, captures


def index(case: Case) -> Case:
    """Of a formula with the name of another output, such as a band."""
    path, captures = with_mark(case)
    sidecar = read_sidecar(path.with_name("f.json"))
    part = sidecar.products[0].model_copy(update={"kind": "index", "file": path.name})
    write_sidecar(path.with_name("f.json"), sidecar.model_copy(update={"products": [*sidecar.products, part]}))
    return path, captures


def other_result(case: Case) -> Case:
    sidecar = case[0].with_name("f.json")
    write_sidecar(sidecar, read_sidecar(sidecar).model_copy(update={"input_samples": {"green": "0"}}))
    return sidecar, case[1]


def image(case: Case) -> Case:
    """The folder of the images is in the output folder, and one has the name of an output."""
    path, captures = of_user(case)
    bands = (replace(captures[0].bands[0], path=path), *captures[0].bands[1:])
    return path, [replace(captures[0], bands=bands)]


def taken(case: Case) -> Case:
    path, (first, _) = case
    return path, [first, replace(first, name="F")]


def too_long(case: Case) -> Case:
    path, (first, _) = case
    return path, [replace(first, name="f" * 250)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "state", "written", "not_written"),
    [
        (no_file, State.NO_FILE, "write", "keep"),
        (link_to_none, State.NO_FILE, "write", "keep"),
        (sidecar, State.SIDECAR, "write", "remove"),
        (as_listed, State.AS_LISTED, "write", "remove"),
        (with_mark, State.WITH_MARK, "write", "remove"),
        (changed, State.CHANGED, "write", "keep"),
        (of_user, State.OF_USER, "was not written by agalign", "keep"),
        (of_user_in_an_edited_sidecar, State.OF_USER, "was not written by agalign", "keep"),
        (pipe, State.OF_USER, "was not written by agalign", "keep"),
        (link_to_a_folder, State.OF_USER, "was not written by agalign", "keep"),
        (index, State.INDEX, "is an index, which another output of this name", "remove"),
        (other_result, State.OTHER_RESULT, "belongs to a different capture", "belongs to a different capture"),
        (image, State.IMAGE, "is an image to be aligned", "is an image to be aligned"),
        (taken, State.TAKEN, "would be written of f and of F", "would be written of f and of F"),
        (too_long, State.TOO_LONG, "the name of its output", "the name of its output"),
    ],
)
def test_what_is_there_decides(
    case: Case, make: Callable[[Case], Case], state: State, written: str, not_written: str
) -> None:
    """An action that is none of those of the table is the message of a refusal."""
    path, captures = make(case)
    out, existed = path.parent, os.path.lexists(path)
    for settings, action in ((WRITING, written), (NOT_WRITING, not_written)):
        if action not in ("write", "keep", "remove"):
            with pytest.raises(agalign.ConfigurationError, match=action):
                refuse_to_overwrite(captures, out, settings)
        else:
            refuse_to_overwrite(captures, out, settings)
    if not_written in ("keep", "remove"):
        remove_outputs(captures[0], out, NOT_WRITING)
        assert os.path.lexists(path) is (existed and not_written == "keep")
    actions = [a if a in ("write", "keep", "remove") else "refuse" for a in (written, not_written)]
    assert [state.written, state.not_written] == actions


@pytest.mark.slow
def test_a_pipe_is_no_damaged_sidecar(case: Case) -> None:
    path, captures = sidecar(case)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(agalign.ConfigurationError, match="was not written by agalign"):
        refuse_to_overwrite(captures, path.parent, WRITING)
    remove_outputs(captures[0], path.parent, WRITING)
    assert path.is_fifo()


@pytest.mark.slow
def test_an_index_that_is_deleted_as_advised_is_no_obstacle(case: Case) -> None:
    path, captures = index(case)
    path.unlink()
    refuse_to_overwrite(captures, path.parent, WRITING)


@pytest.mark.parametrize("name", ["agalign-run.json", "index.html", "panels.json"])
def test_a_pipe_is_no_page_of_an_earlier_run(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(agalign.ConfigurationError, match=f"{name}: was not written by agalign"):
        refuse_foreign_run_files(tmp_path)


def test_the_cases_cover_every_state() -> None:
    (mark,) = (m for m in test_what_is_there_decides.pytestmark if m.name == "parametrize")
    assert {state for _, state, *_ in mark.args[1]} == {*State}
