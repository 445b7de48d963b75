import errno
import json
import os
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from agalign.errors import OutputError
from agalign.host.files import (
    RUN_FILE,
    complete_file,
    indented,
    is_inside,
    read_regular,
    remove_partial_files,
    scratch_file,
    write_csv,
    write_text,
)


def test_a_file_is_complete_or_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "below" / "a.png"
    write_text(path, "before")

    def half() -> None:
        with complete_file(path) as partial:
            partial.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half()
    assert path.read_text() == "before"
    with complete_file(path) as partial:
        assert partial.suffix == ".png"
        assert partial.name.startswith(".")
        partial.write_text("after")
    assert path.read_text() == "after"
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_a_file_above_the_limit_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"four")
    assert read_regular(tmp_path / "a.json", 4) == b"four"
    with pytest.raises(OSError, match="too many for this file"):
        read_regular(tmp_path / "a.json", 3)


def test_a_text_is_the_same_bytes_on_every_system(tmp_path: Path) -> None:
    write_text(tmp_path / "a.csv", "größe\n1\n")
    assert (tmp_path / "a.csv").read_bytes() == "größe\n1\n".encode()


def test_a_table_has_a_column_for_each_cell(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="sun_deg"):
        write_csv(tmp_path / "a.csv", ("band", "status"), [{"band": "Red", "sun_deg": 40.0}])
    write_csv(tmp_path / "a.csv", ("band", "status"), [{"band": "Red"}, ("NIR", "=1")])
    assert (tmp_path / "a.csv").read_text() == "band,status\nRed,\nNIR,'=1\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows writes no folder to disk")
def test_a_folder_that_cannot_be_synchronised_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fsync = os.fsync

    def of_files_only(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(said, os.strerror(said))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", of_files_only)
    said = errno.EINVAL
    write_text(tmp_path / "a.txt", "a")
    said = errno.EIO
    with pytest.raises(OutputError, match="cannot be written"):
        write_text(tmp_path / "b.txt", "b")


def test_two_threads_at_a_time_do_not_meet(tmp_path: Path) -> None:
    path, both = tmp_path / "a.txt", threading.Barrier(2)

    def write(text: str) -> Path:
        with complete_file(path) as partial:
            both.wait()
            partial.write_text(text)
        return partial

    with ThreadPoolExecutor(2) as pool:
        one, other = pool.map(write, ("one", "other"))
    assert one != other
    assert path.read_text() in ("one", "other")
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    "name",
    [
        "",
        "../a",
        "a/../../b",
        "/etc/passwd",
        "/vsicurl/http://x/y",
        r"C:\a",
        r"\\host\a",
        r"a\..\..\b",
        "a\0b",
        "9" * 5000,
        "9/" * 1000,
    ],
)
def test_names_outside_a_folder(name: str) -> None:
    assert not is_inside(name)
    assert all(map(is_inside, ("a.tif", "red/a.tif", "..a.tif", "with space é.tif")))


@pytest.mark.skipif(sys.platform != "linux", reason="the state of a process is read from /proc")
def test_a_zombie_does_not_keep_its_partial_file(tmp_path: Path) -> None:
    """Workers whose fork server ends at the same time are zombies until the first process of the system waits."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with scratch_file(tmp_path / "a.tif") as own:
            partial = tmp_path / own.name.replace(str(os.getpid()), str(process.pid))
        partial.touch()
        remove_partial_files(tmp_path)
        assert partial.exists()
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        remove_partial_files(tmp_path)
        assert not partial.exists()


def test_partial_files_of_this_run_alone_are_removed(tmp_path: Path) -> None:
    """Kept are those of running processes and of other machines, and those of another run in a folder below."""
    run, folder = tmp_path / "another run", tmp_path / "folder"
    with scratch_file(folder / "a.tif") as partial:
        pass
    others = (
        partial.name.replace(str(os.getpid()), str(os.getppid())),
        partial.name.replace("-part-", "-part-elsewhere"),
    )
    kept = {folder / "b.tif", run / RUN_FILE, run / partial.name, *(tmp_path / name for name in others)}
    run.mkdir()
    for path in (partial, *kept):
        path.write_text("half")
    remove_partial_files(tmp_path)
    assert {p for p in tmp_path.rglob("*") if p.is_file()} == kept
    remove_partial_files(run)
    assert not (run / partial.name).exists()


def test_indented_json_has_lists_of_numbers_on_one_line() -> None:
    value = {
        "numbers": [[1.5, -2], [None, True]],
        "texts": ["a, [b]: {c}", 'say "d\\"'],
        "none": [[], {}],
        "of": [{"x": 1}],
    }
    text = indented(json.dumps(value, separators=(",", ":")))
    assert json.loads(text) == value
    assert text.split("\n") == [
        "{",
        ' "numbers": [[1.5,-2],[null,true]],',
        ' "texts": [',
        '  "a, [b]: {c}",',
        r'  "say \"d\\\""',
        " ],",
        ' "none": [',
        "  [],",
        "  {}",
        " ],",
        ' "of": [',
        "  {",
        '   "x": 1',
        "  }",
        " ]",
        "}",
    ]
