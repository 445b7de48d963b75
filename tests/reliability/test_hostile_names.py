"""Texts from files in the names of outputs, and links in output folders: no writer leaves its folder."""

import json
import os
import re
import shutil
import sys
from html import escape
from pathlib import Path
from typing import Any

import pytest
from PIL.ExifTags import Base
from synthetic_flights.aligned import make_aligned

import agalign
from agalign.batch import capture_task
from agalign.batch.index_run import index_tasks, run_indices
from agalign.batch.model_files import ModelFiles
from agalign.batch.output_files import remove_outputs
from agalign.batch.run import run_flight
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, byte_string, read_directories, text
from agalign.exports.programs import export
from agalign.host.files import file_name
from agalign.host.text import without_controls
from agalign.records.sidecar_file import file_part, find_sidecars
from agalign.spectral_indices.formulas import index_named
from agalign.values.capture import Band, CameraIdentity, Capture

from ..builders import in_full_run
from ..conftest import Shared, read_json, seeded, write_signed
from ..program import agalign_here

HOSTILE = ("../../pwn", "/tmp/p", "..", "a\r\n\x1b[31mb", "x" * 300, "CON", "", ".hidden", "a/b", "a:b", "C:\\b", "é‮/")


def renamed_tags(path: Path, hostile: str) -> None:
    """Make every text of a file's tags that can become part of a path this one."""
    directories = read_directories(path)
    packet = directories[0][XMP].data.decode()
    in_xml = escape(without_controls(hostile))
    for old in ("RedEdge-M", "syntheticflight00001"):
        packet = packet.replace(old, in_xml)
    packet = packet.replace("<Camera:BandName>", f"<Camera:BandName>{in_xml}").replace("synthetic0", f"{in_xml}0")
    first = {XMP: byte_string(packet.encode()), Base.Model: text(hostile)}
    add_directories(path, first, directories[EXIF] | {Base.BodySerialNumber: text(hostile)}, directories[GPS])


@pytest.fixture
def hostile_run(flight: Path, shared: Shared) -> Path:
    """A folder with `in`, a capture for each text, and `out`, its run with every output; all captures count as `ok`."""

    def fill(folder: Path) -> None:
        for number, hostile in enumerate(HOSTILE):
            for band in (2, 3, 4):
                path = folder / "in" / f"IMG_{number:04d}_{band}.tif"
                path.parent.mkdir(exist_ok=True)
                shutil.copyfile(flight / "0000SET" / "000" / f"IMG_0001_{band}.tif", path)
                renamed_tags(path, hostile)
        write = dict.fromkeys(("tie_points", "georeference", "qa", "error_map"), True)
        settings = seeded("rig", layout="both", ground_elevation_m=0.0, **write)
        reports = agalign.align_folder(folder / "in", folder / "deep" / "er" / "out", settings=settings)
        assert [r.error for r in reports] == [None] * len(HOSTILE)
        for path in find_sidecars(folder / "deep" / "er" / "out"):
            content = path.read_text().replace('"degraded"', '"ok"').replace('"seed_only"', '"aligned"')
            write_signed(path, content)

    return shared("hostile", fill)


def is_plain(name: str) -> bool:
    """True for a name that every file system accepts: letters, digits, `._-`; no leading dot, no device of Windows."""
    return len(name.encode()) < 200 and bool(re.fullmatch(r"(?!con(\.|$)|\.)[\w.-]+", name, re.IGNORECASE))


def files_in(folder: Path) -> set[Path]:
    return {p for p in folder.rglob("*") if not p.is_dir()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        *(f"export {{out}} -o {{new}} --for {name}" for name in ("odm", "metashape", "pix4d")),
        "report {out}",
        "verify {out}",
        "indices {out} --index ndvi --formula con=(N-R)/(N+R)",
        in_full_run("indices {out} --index ndvi -o {new}"),
        "info {in} --json",
        in_full_run("evaluate {pairs} -m sift -o {new}.csv"),
    ],
)
def test_every_writer_stays_in_its_folder(hostile_run: Path, tmp_path: Path, command: str) -> None:
    """The files of the run, those of the command, and no others."""
    root = shutil.copytree(hostile_run, tmp_path / "a" / "b")
    images = ",".join(str(root / "in" / f"IMG_0000_{band}.tif") for band in (2, 3))
    (root / "pairs.csv").write_text(f"fixed,moving,name,homography\n{images},../../pwn,1 0 0 0 1 0 0 0 1\n")
    out, new, before = root / "deep" / "er" / "out", root / "some" / "where" / "new", files_in(tmp_path)
    places = {"out": out, "new": new, "in": root / "in", "pairs": root / "pairs.csv"}
    result = agalign_here(*(part.format_map(places) for part in command.split()))
    # The bands have other names in each capture.
    needs_equal_bands = any(word in command for word in ("odm", "metashape", "pix4d"))
    assert result.returncode == (3 if needs_equal_bands else 0), result.stderr
    written = files_in(tmp_path) - before
    assert all(p.is_relative_to(out) or p.is_relative_to(new) or p.parent == new.parent for p in written), written
    assert all(is_plain(p.name) for p in written)


@pytest.mark.slow
def test_a_run_writes_plain_names_inside(hostile_run: Path) -> None:
    written = files_in(hostile_run) - files_in(hostile_run / "in")
    assert all(p.is_relative_to(hostile_run / "deep" / "er" / "out") and is_plain(p.name) for p in written)


def test_names_of_files_are_plain_and_different(tmp_path: Path) -> None:
    taken: dict[str, str] = {}
    names, again = ([file_name(text, taken) for text in (*HOSTILE, "A", "a", "a_b")] for _ in range(2))
    assert len({name.lower() for name in names}) == len(names)
    assert names == again
    expected = {"IMG_0001_2.tif": "IMG_0001_2.tif", "nul.TIF": "_nul.TIF", "x" * 300 + ".tif": "x" * 120 + ".tif"}
    assert {text: file_name(text) for text in expected} == expected
    models = ModelFiles(tmp_path)
    for serial in (*HOSTILE, *HOSTILE):
        path = models.new([Capture("x", Path(), (), 0, CameraIdentity("", "", serial))])
        assert path.name not in names
        models.add(path, "")
        names.append(path.name)
    assert all(map(is_plain, names))


def test_equal_names_do_not_overwrite_each_other(tmp_path: Path) -> None:
    """Labels of captures that are equal as one name, and a name that is the checksummed one of another text."""
    out = tmp_path / "out"
    make_aligned(out, 1)
    content = read_json(out / "0000SET" / "IMG_0001.json") | {"status": "ok"}
    for band in content["bands"]:
        band["place"] = None
    for folder, name in (("0000SET/x", "y"), ("0000SET", "x_y"), ("0000SET_x", "y")):
        content["capture"] = name
        (out / folder).mkdir(exist_ok=True)
        file = out / folder / f"{name}.tif"
        file.write_text(folder)
        content["products"] = [file_part("band", file, out / folder).model_dump()]
        write_signed(out / folder / f"{name}.json", json.dumps(content))
    (out / "0000SET" / "IMG_0001.json").unlink()
    report = export(out, tmp_path / "images", "odm")
    for files in (report.files, (p for p in out.rglob("*.tif") if p.stem != "IMG_0001")):
        assert sorted(p.read_text() for p in files) == ["0000SET", "0000SET/x", "0000SET_x"]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_links_are_not_followed_out_of_the_folder(flight: Path, tmp_path: Path) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    (outside / "IMG_0001.json").write_text("{}")
    out.mkdir()
    for name, target, said in (
        ("0000SET", outside, r"out/0000SET/000: a link leads out of .*/out; remove the link"),
        ("models", outside, "a link leads out"),
        (".agalign.lock", outside / "IMG_0001.json", r"\.agalign\.lock: "),
    ):
        (out / name).symlink_to(target)
        with pytest.raises(agalign.OutputError, match=said):
            agalign.align_folder(flight, out, settings=seeded("rig"))
        (out / name).unlink()
    assert [(p.name, p.read_text()) for p in outside.iterdir()] == [("IMG_0001.json", "{}")]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
@pytest.mark.parametrize("stage", ["estimate", "render"])
def test_a_link_in_the_place_of_a_folder_is_not_followed_during_a_run(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    function = getattr(capture_task, stage)

    def with_link(*args: Any) -> Any:
        shutil.rmtree(out / "0000SET", ignore_errors=True)
        (out / "0000SET").symlink_to(outside)
        return function(*args)

    monkeypatch.setattr(capture_task, stage, with_link)
    run = run_flight(agalign.discover(flight), out, seeded("rig"), agalign.RunOptions(jobs=1))
    report = next(run)
    run.close()
    assert re.search("out/0000SET/000: a link leads out of", report.error or "")
    (out / "0000SET").unlink()
    with pytest.raises(agalign.OutputError, match="out/0000SET/000: a link leads out of"):
        agalign.align_capture(agalign.discover(flight).captures[0], out, settings=seeded("rig"))
    assert not any(outside.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_links_in_an_output_folder_are_not_read_written_or_emptied(tmp_path: Path) -> None:
    out, secret = tmp_path / "out", tmp_path / "secret"
    secret.mkdir()
    (secret / "key").write_text("secret")
    make_aligned(out, 1)
    sidecar = out / "0000SET" / "IMG_0001.json"
    content = read_json(sidecar) | {"status": "ok"}
    content["products"] += [{"kind": "band", "file": "link/key", "bytes": 1, "sha256": ""}]
    write_signed(sidecar, json.dumps(content))
    (out / "0000SET" / "link").symlink_to(secret)
    with pytest.raises(agalign.OutputError, match="link/key: a link leads out of"):
        export(out, tmp_path / "to", "odm")
    target = tmp_path / "indices"
    target.mkdir()
    (target / "0000SET").symlink_to(secret)
    (result,) = run_indices(index_tasks(out, [index_named("ndvi")], target))
    assert "a link leads out" in result[0].problem
    band = Band("Green", tmp_path / "IMG_0001_2.tif", 1, 9, 9, "uint16")
    remove_outputs(Capture("IMG_0001", Path("0000SET"), (band,), 0), out, agalign.WriteSettings())
    assert not sidecar.exists()
    assert [p.name for p in secret.iterdir()] == ["key"]


BAD = os.fsdecode(b"f\xf6lder")
"""A name in Latin-1, as old archives have: Python reads its byte outside ASCII as a surrogate."""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow no such names")
@pytest.mark.parametrize(
    "command",
    ["info {bad}", "align {bad}", "align {flight} -o {bad}", "report {bad}", "export {flight} --for odm -o {bad}"],
)
def test_an_argument_that_is_not_utf_8_is_one_line(command: str, flight: Path, tmp_path: Path) -> None:
    places = {"bad": tmp_path / BAD, "flight": flight}
    done = agalign_here(*(part.format_map(places) for part in command.split()))
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"agalign: .*/f\\udcf6lder\S*: its name is not valid UTF-8; rename it\n", done.stderr)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow no such names")
def test_files_and_working_folders_that_are_not_utf_8_are_named(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / BAD).mkdir()
    for number, image in enumerate(sorted(flight.rglob("IMG_0001_*.tif"))):
        os.link(image, tmp_path / f"IMG_000{number % 2}{BAD}_{number}.tif")
        os.link(image, tmp_path / BAD / image.name)
    done = agalign_here("info", tmp_path, "--exclude", "*/IMG*_1.tif")
    *problems, last = done.stderr.splitlines()
    assert all(re.search(r"udcf6lder\S+: its name is not valid UTF-8; rename it$", line) for line in problems)
    assert "no capture of two or more bands" in last
    monkeypatch.chdir(tmp_path / BAD)
    done = agalign_here(".")
    assert (done.returncode, done.stderr.count("\n")) == (1, 2), done.stderr
    assert done.stderr.endswith("f\\udcf6lder-aligned: its name is not valid UTF-8; rename it\n")
    assert not (tmp_path / f"{BAD}-aligned").exists()
