"""What is printed about arguments and files that cannot be used, and at the end: one line in plain words."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import typer
from synthetic_flights.aligned import make_aligned

from agalign import __main__
from agalign.batch.capture_report import CaptureReport
from agalign.cameras.discover import FolderScan, Problem, discover
from agalign.cli import align_run, main
from agalign.cli.align_run import RunTotals, conclude, print_problems
from agalign.cli.command import Command, help_of
from agalign.cli.terminal import Terminal, exits
from agalign.config import RunOptions, Settings
from agalign.errors import ConfigurationError, InputError, OutputError, UnreadableFileError
from agalign.host.files import PANELS_FILE, write_model
from agalign.records.cautions import RunFacts
from agalign.records.panels_and_sky import PanelPart, PanelsFile
from agalign.records.run_record import Finished, RunPart, begun
from agalign.records.sidecar_file import run_sidecars, write_sidecar
from agalign.report.pages import pair_totals
from agalign.report.pair_totals import PairTotals

from ..conftest import raising, seeded, write_capture
from ..program import agalign_here
from ..records.test_cautions import panel, reflectance_by
from ..records.test_sidecar import NIR, example

GREEN = "(did you mean 'Green'?); choose from Blue, Green, Red, NIR, Red edge"


@pytest.mark.parametrize(
    ("command", "code", "line"),
    [
        ("align x --jobs many", 2, "--jobs: give a whole number; 'agalign align --help' lists the options"),
        ("align x --jobs -1", 2, "--jobs: give 0 or more"),
        ("align x --accept-predicted much", 2, "--accept-predicted: give a number"),
        ("align x --accept-predicted inf", 2, "--accept-predicted: give 1000000 or less"),
        ("align x --seed rigg", 2, "--seed: 'rigg' is unknown; choose from auto, rig, geo, structure"),
        ("align x --crop [red]", 2, "--crop: '[red]' is unknown; choose from flight, common, none"),
        ("align x --nope", 2, "no such option: --nope"),
        ("align", 2, "folder is missing"),
        ("--nope", 2, "no such option: --nope"),
        ("align ", 2, "folder: is empty; give a path"),
        ("align x -o ", 2, "--out: is empty; give a path"),
        ("align x -o", 2, "option '-o' requires an argument; 'agalign align --help' lists the options"),
        ("align x y", 2, "got unexpected extra argument(s) (y)"),
        ("export nowhere --for excel", 2, "--for: 'excel' is unknown"),
        ("align x --radiometry refl", 2, "--radiometry: 'refl' is unknown; choose from off, auto, camera, sun, panel"),
        ("align x --relief allways", 2, "--relief: 'allways' is unknown; choose from auto, always, never"),
        ("align x --outptu o", 2, "no such option: --outptu (did you mean '--out'?)"),
        ("align {flight} -o {tmp}/o --index nvdi", 2, "unknown index 'nvdi' (did you mean 'ndvi'?); choose from ndvi"),
        ("indices {flight} --index nvdi", 2, "unknown index 'nvdi' (did you mean 'ndvi'?); choose from ndvi"),
        ("align {flight} -o {tmp}/o --index ndvi,NDVI", 2, "'ndvi' is given twice"),
        ("indices {flight} --index ndvi,ndvi", 2, "'ndvi' is given twice"),
        ("indices {flight} --index ,", 2, "no index is given"),
        ("indices {flight} --formula import", 2, "is not a formula"),
        ("indices {flight} --formula N/R --formula N/G", 2, "'formula' is given twice"),
        ("align {flight} -o {flight}", 2, "is the folder of the images"),
        ("info {tmp}", 1, ".png file in it or below it; there are only 2 no suffix, 1 .safe"),
        ("align {flight} -o {tmp}/o --reference SWIR", 2, "no band 'SWIR', as --reference asks; choose"),
        ("align {flight} -o {tmp}/o --reference Gren", 2, "no band 'Gren', as --reference asks " + GREEN),
        ("align {flight} -o {tmp}/o --bands gren,nir", 2, "no band 'gren', as --bands asks " + GREEN),
        ("align {flight} -o {tmp}/o --bands Green", 2, "--bands Green: leaves less than the two bands"),
        ("align {flight} -o {tmp}/o --bands Green,NIR --reference red", 2, "asks; choose from Green, NIR"),
        ("align {flight} -o {tmp}/o --pattern {{capture}}_{{band}}.png", 2, "matches none of 10 images, such as IMG_"),
        ("align {flight} -o {tmp}/o --include *.xyz", 1, "none of 10 images, such as 0000SET/000/IMG_0001_1.tif"),
        ("align {flight} --dry-run --georeference", 2, "no capture has a height above the ground; give --ground-elev"),
        ("align {flight} --dry-run --radiometry panel", 2, "--radiometry panel: no calibration panel for Blue, Green"),
        ("align {flight} -o {tmp}/o --model nosuch", 1, "nosuch: cannot be read as a model (No such file or directory"),
        ("align {flight} -o {tmp}/o --model {tmp}", 1, "cannot be read as a model (it is not a regular file); give"),
        ("align {flight} -o {tmp}/o --device gpu", 2, "unknown device 'gpu'; use auto, cpu, cuda"),
        ("align {flight} -o {tmp}/o --device cuda:99", 2, "device 'cuda:99' cannot be used"),
        ("align {flight} --dry-run --device cuda:99", 2, "device 'cuda:99' cannot be used"),
        ("align {flight} -o {tmp}/o --pattern x", 2, "pattern"),
        ("ndiv {tmp}", 2, "did you mean 'ndvi'"),
        ("{tmp}/file {tmp}/other -o {tmp}/o", 2, "give the folder of the images, not the files: agalign {tmp}"),
        ("verify", 2, "give the output folder of a run; 'agalign verify --help' lists the options"),
        ("nowhere", 1, "nowhere: does not exist; give the folder of the images"),
        ("info nowhere", 1, "nowhere: does not exist; give the folder of the images"),
        ("report nowhere", 1, "nowhere: does not exist; give the output folder of a run"),
        ("ndvi nowhere", 1, "nowhere: does not exist; give the output folder of a run"),
        ("export nowhere --for odm", 1, "nowhere: does not exist; give the output folder of a run"),
        ("verify {tmp}", 1, "no sidecars there; give the output folder of a run"),
        ("align {flight} -o {tmp}/file", 1, "file"),
        ("info {tmp}/broken.safetensors", 1, "broken.safetensors"),
        ("info https://example.org/flight", 2, "only local files and folders are used; mount it or copy the files"),
    ],
)
def test_wrong_arguments_are_one_line(flight: Path, tmp_path: Path, command: str, code: int, line: str) -> None:
    for name in ("file", "other", "broken.safetensors"):
        (tmp_path / name).write_bytes(b"nothing")
    given = {"flight": flight, "tmp": tmp_path}
    done = agalign_here(*(argument.format(**given) for argument in command.split(" ")))
    assert (done.returncode, done.stdout) == (code, "")
    *before, only = done.stderr.splitlines()
    assert before in ([], [f"2 captures, 10 bands in {flight}"])
    assert only.startswith("agalign: ")
    assert len(only) < 400
    assert line.format(**given) in only
    assert "nput should" not in only
    assert "Value error" not in only
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("command", ["report {}", "align {}", "align {flight} -o {}"])
def test_links_that_lead_back_to_themselves_are_one_line(flight: Path, tmp_path: Path, command: str) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    done = agalign_here(*(argument.format(loop, flight=flight) for argument in command.split(" ")))
    assert done.returncode == 2
    assert "loop: its symbolic links lead back to themselves; give the path of a file or folder" in done.stderr


def test_the_results_of_a_linked_folder_are_beside_the_link(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "linked").symlink_to(flight)
    done = agalign_here("align", tmp_path / "linked", "--dry-run")
    assert f"Into {tmp_path / 'linked-aligned'}:" in done.stderr + done.stdout


@pytest.mark.parametrize("command", ["report", "indices", "verify"])
def test_a_folder_of_runs_is_not_a_run(tmp_path: Path, command: str) -> None:
    """With the pages of a run in it, it would not be searched for images any more."""
    make_aligned(tmp_path / "one", 1)
    (tmp_path / "one" / "agalign-run.json").touch()
    done = agalign_here(command, tmp_path)
    assert done.returncode == 1
    assert f"{tmp_path}: contains runs, such as {tmp_path / 'one'}, and is none itself; give the folder" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


@pytest.mark.parametrize("command", ["report {}", "indices {}", "verify {}", "export {} --for odm"])
def test_a_folder_in_a_run_is_not_a_run(tmp_path: Path, command: str) -> None:
    """The run may be locked, and its tables and report have the captures of all its folders."""
    part, inner = tmp_path / "run" / "set", tmp_path / "run" / "inner"
    for folder, of_run in ((part, tmp_path / "run"), (inner, inner)):
        make_aligned(folder, 1)
        (of_run / "agalign-run.json").touch()
    files = sorted(tmp_path.rglob("*"))
    done = agalign_here(*(part if argument == "{}" else argument for argument in command.split()))
    assert done.returncode == 1
    assert f"{part}: is a part of the run in {tmp_path / 'run'}; give that folder" in done.stderr
    assert sorted(tmp_path.rglob("*")) == files
    # A run in the folder of another is a run of its own.
    assert run_sidecars(inner)


NOT_LOCAL = (
    *("s3://bucket/x", "s3:/bucket", "http://localhost:9/x", "https://x/y", "file:///x", "FILE:/x", "gs://b", "az://b"),
    *("/vsizip/a.zip", "/vsimem/x", "/vsicurl/http://x/y", "zip+https://x/y.zip"),
)


@pytest.mark.parametrize("path", [*NOT_LOCAL, "x" * 256, f"a/{'é' * 128}", "y/" * 2500], ids=lambda path: path[:16])
@pytest.mark.parametrize(
    "command",
    [
        *("{}", "{} -o o", "align f -o {}", "align f --config {}", "align f --model {}", "info {}", "demo {}"),
        *("onto {} b.tif", "onto a.tif b.tif {}", "onto a.tif b.tif -o {}", "report {}", "verify {}", "indices {}"),
        *("indices o -o {}", "export {} --for odm", "export o --for odm -o {}", "evaluate {}", "learn a.csv -o {}"),
    ],
)
def test_a_path_that_is_not_local_or_too_long_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, path: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = agalign_here(*(path if argument == "{}" else argument for argument in command.split()))
    assert (done.returncode, done.stdout) == (2, "")
    said = "only local files and folders|one of GDAL's virtual paths" if path in NOT_LOCAL else "; give a shorter path"
    assert re.search(rf"^agalign: .*({said}).*\n$", done.stderr), done.stderr
    assert len(done.stderr) < 500
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit the address space")
def test_a_limited_address_space_is_one_line(flight: Path, tmp_path: Path) -> None:
    """With 1.2 GB, the libraries of a run print many lines and end the process."""
    command = 'ulimit -v 1200000; exec "$0" -m agalign "$1" -o "$2"'
    arguments = ["sh", "-c", command, sys.executable, str(flight), str(tmp_path / "out")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    said = "out of memory: the address space is limited to 1.2 GB, and aligning needs 2 GB; raise the limit"
    assert done.stderr == f"agalign: {said} (ulimit -v unlimited)\n"
    assert not (tmp_path / "out").exists()


def test_a_folder_whose_default_output_has_too_long_a_name_is_one_line(flight: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(flight, tmp_path / ("x" * 250))
    done = agalign_here(folder)
    assert done.returncode == 2
    assert done.stderr.endswith("give a shorter path, or choose another output folder with -o\n")
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


@pytest.mark.parametrize("command", ["align x --nope", "x --jobs y", "align", "exprot"])
def test_usage_errors_are_events_of_the_json_log(command: str) -> None:
    plain, logged = agalign_here(*command.split()), agalign_here(*command.split(), "--log-json")
    assert plain.returncode == logged.returncode == 2
    event = json.loads(logged.stderr)
    assert plain.stderr == f"agalign: {event['message']}\n"
    assert abs((datetime.now(UTC) - datetime.fromisoformat(event.pop("time"))).total_seconds()) < 600
    assert event == {"event": "problem", "message": event["message"]}


class TerminalText(io.StringIO):
    """What is printed to a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_narrow_terminal_shows_every_date(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A table is wrapped, not cut."""
    captures = json.loads(agalign_here("info", flight, "--json").stdout)["captures"]
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(io, "StringIO", TerminalText)
    printed = agalign_here("info", flight).stdout
    rows = [line for line in printed.splitlines() if line.startswith("│")]
    assert {len(row) for row in rows} == {80}
    assert "…" not in printed
    for part in (part for capture in captures for part in capture["captured_at"][:19].split("T")):
        assert any(part in row for row in rows)


def test_a_folder_without_captures_is_described(tmp_path: Path) -> None:
    image = np.full((60, 80), 7, np.uint8)
    cv2.imwrite(str(tmp_path / "photo.jpg"), np.dstack([image] * 3))
    cv2.imwrite(str(tmp_path / "single_red.tif"), image)
    for name in ("a.raw", "b.raw", "notes.txt"):
        (tmp_path / name).touch()
    done = agalign_here("info", tmp_path)
    assert done.returncode == 1
    said = " ".join(done.stdout.split())
    assert "2 .raw files: not an image that agalign reads" in said
    assert "1 .txt file: not" in said
    assert "1 .jpg file: a colour photograph" in said
    assert "1 .tif file: a band with no companion; copy the other files of single from the card" in said
    assert "agalign info" not in done.stderr


def test_an_unreadable_file_is_shown_as_missing(tmp_path: Path) -> None:
    write_capture(tmp_path, "red", "green", "nir", name="IMG_0001")
    (tmp_path / "IMG_0001_nir.tif").write_bytes(b"II*\0broken")
    done = agalign_here("info", tmp_path)
    assert done.returncode == 3
    assert "IMG_0001_nir.tif (unreadable)" in done.stdout
    assert "1 capture, 2 bands, 1 problem" in done.stdout
    (capture,) = json.loads(agalign_here("info", tmp_path, "--json").stdout)["captures"]
    assert capture["unreadable_files"] == ["IMG_0001_nir.tif"]


def test_an_unreadable_file_of_another_number_is_not_of_a_capture(tmp_path: Path) -> None:
    for name in ("f1", "f10"):
        write_capture(tmp_path, "red", "green", name=name)
    (tmp_path / "f10_green.tif").write_bytes(b"II*\0broken")
    (capture,) = json.loads(agalign_here("info", tmp_path, "--json").stdout)["captures"]
    assert (capture["label"], capture["unreadable_files"]) == ("f1", [])


def test_info_begins_with_the_cameras(flight: Path) -> None:
    done = agalign_here("info", flight)
    text = " ".join(done.stdout.split())
    assert text.startswith("MicaSense RedEdge-M (SY01-0000001-AG")
    assert "2 captures of 5 bands, 480 x 360 px" in text
    lens = discover(flight).captures[0].reference.lens
    radiometry = "radiometry: radiance by calibration (± 17 %), reflectance by light sensor (± 20 %)"
    assert f"GSD {1e4 / lens.fx_px:.1f} cm at a height of 100 m, {radiometry}" in text
    assert "[Green]" in done.stdout
    facts = json.loads(agalign_here("info", flight, "--json").stdout)
    assert facts["cameras"][0]["captures"] == 2
    assert facts["captures"][0]["seeds"] == ["rig", "structure", "identity"]
    assert [b["name"] for b in facts["captures"][0]["bands"] if b["reference"]] == ["Green"]


def test_expert_options_are_a_panel_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    *_, last = agalign_here("align", "--help").stdout.split("╭─ ")
    assert last.startswith("Expert")
    expert = ["--recipe", "--sharing", "--model-family", "--each-alone", "--rng-seed"]
    assert re.findall(r"^│ (--[a-z-]+)", last, re.MULTILINE) == expert


@pytest.mark.parametrize("command", main.COMMANDS.values(), ids=main.COMMANDS)
def test_every_option_of_a_command_has_a_help_text(command: Command) -> None:
    """And its docstring describes no other option."""
    helps = {p.name: get_args(p.annotation)[1].help for p in command.parameters()}
    assert all(helps.values())
    assert set(help_of(command.function)[1]) <= set(helps)


def test_the_list_of_commands_has_whole_sentences() -> None:
    """Their ends are found by full stops: that of an abbreviation would cut a sentence."""
    listed = agalign_here("--help").stdout
    for command in main.COMMANDS.values():
        assert command.summary in " ".join(listed.split())
    without_arguments = agalign_here()
    assert (without_arguments.returncode, without_arguments.stderr.strip()) == (2, listed.strip())


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("x: is empty"), 1, "x: is empty"),
        (ConfigurationError("--x: no"), 2, "--x: no"),
        (MemoryError(), 1, "out of memory"),
        (RuntimeError("std::bad_alloc"), 1, "out of memory"),
        (ImportError("libx.so"), 1, "a library cannot be loaded (libx.so)"),
        (OSError(28, "No space left on device"), 1, "output: No space left on device"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("of 1"), 1, "please report this"),
    ],
)
def test_each_end_has_a_code(error: BaseException, code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, exits(Terminal()):
        raise error
    assert ended.value.exit_code == code
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_text_from_files_is_escaped_in_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    terminal.problem("\x1b[31mred\a\n[b]")
    terminal.table(["Capture"], [["Köln, 雨 [1]"]])
    printed = capsys.readouterr()
    assert printed.err == "agalign: \\x1b[31mred\\x07\\n[b]\n"
    assert "│ Köln, 雨 [1] │" in printed.out


def test_many_files_with_one_problem_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    texts = {f"f{n:04d}.tif": f"is empty, {n} bytes" for n in range(4000)} | {"x.tif": "cannot be read"}
    problems = (Problem(Path(f"in/{n}"), UnreadableFileError(f"in/{n}: {text}")) for n, text in texts.items())
    scan = FolderScan(Path("in"), (), tuple(problems))
    print_problems(scan, Terminal())
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "agalign: in/f0000.tif: is empty, 0 bytes"
    assert lines[10:] == [
        "agalign: in/x.tif: cannot be read",
        "agalign: in: 3990 more files with the same problem as f0009.tif; 'agalign info --json' lists all",
    ]
    print_problems(scan, Terminal(log_json=True))
    assert len(capsys.readouterr().err.splitlines()) == 4001


def record_of(**states: str) -> RunPart:
    """The record of a run with captures in these states."""
    record = begun(Path(), Settings())
    record.count({label: Finished(state) for label, state in states.items()})
    return record


@pytest.mark.parametrize(
    ("radiometry", "age_s", "text"),
    [
        ("reflectance by panel", 3180.0, "1 capture, at most 53 min from a panel"),
        ("reflectance by panel", 1700.0, "1 capture, at most 28 min from a panel"),
        ("reflectance by panel and light sensor", 3180.0, "1 capture, at most 53 min from a panel"),
        ("reflectance by light sensor", None, "1 capture"),
    ],
)
def test_the_age_of_a_panel_is_printed_and_warned_of(
    radiometry: str, age_s: float | None, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = reflectance_by(radiometry.removeprefix("reflectance by "), radiometry=radiometry)
    totals = RunTotals(True, {"IMG_1": 2}, record_of(IMG_1="done"))
    few_saturated = NIR | {"reason": None, "saturated": 0.001}
    sidecar = example(output=output | {"panel_age_s": age_s}, bands=[few_saturated])
    totals.add(CaptureReport("IMG_1", "done", sidecar, tmp_path / "IMG_1.json"))
    totals.pairs.add("IMG_1", sidecar)
    conclude(totals, tmp_path, Terminal())
    printed = capsys.readouterr()
    assert f"Written as {radiometry}: {text}" in printed.out.splitlines()
    assert "saturated" not in printed.err
    text = "check: 2 bands of 1 capture: the light may have changed since the nearest calibration panel (up to 53 min)"
    is_warned = text in printed.err and "try: record a panel before and after each flight" in printed.err
    assert is_warned == (radiometry == "reflectance by panel" and age_s == 3180.0)


def test_the_totals_count_missing_bands_and_captures_without_a_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a disk that is full after the third of four captures, which shows a panel."""
    record = record_of(IMG_0="done", IMG_1="done", IMG_2="panel")
    totals = RunTotals(False, {f"IMG_{number}": 2 for number in range(4)}, record)
    blue = {"band": "Blue", "file": "b.tif", "band_index": 1, "width": 10, "height": 8}
    aligned = NIR | {"status": "aligned", "reason": None}
    complete = example(capture="IMG_0", bands=[aligned | {"saturated": 0.031}, aligned | {"band": "Red"}])
    other = example(capture="IMG_1", bands=[aligned], missing_bands=["Green"], reference=blue)
    for sidecar in (other, complete):  # in the order in which they finish
        path = tmp_path / f"{sidecar.capture}.json"
        totals.add(CaptureReport(sidecar.capture, "done", write_sidecar(path, sidecar), path))
    facts = {"folder": ".", "capture": "IMG_2", "captured_at": "", "cues": ["its name"], "bands": []}
    part = PanelPart.model_validate(facts | {"seen_by": "look", "serial": "", "picture": "IMG_2.png"})
    write_model(tmp_path / PANELS_FILE, PanelsFile(panels=[part]))
    totals.pairs = pair_totals(tmp_path)
    assert [label for label, *_ in totals.pairs._references] == ["IMG_0", "IMG_1"], "that of the report"
    assert conclude(totals, tmp_path, Terminal()) == 3
    printed = capsys.readouterr()
    assert "3 of 6 band pairs aligned; 1 capture not written" in printed.out
    assert re.search(r"^│ Green +│ +0 │ +0 │ +0 │ +0 │ +1 │ +- │ +- │ +- │$", printed.out, re.MULTILINE)
    reference = "IMG_1 Blue: other reference: on the grid of Blue; most captures of the flight are on that of Green"
    assert reference in printed.err
    assert "1 of 3 captures could not be written" in printed.err
    assert "IMG_0 NIR: check: 3.1% of the pixels are saturated" in printed.err


@pytest.mark.parametrize(("of_run", "code"), [("IMG_1", 0), ("IMG_2", 3)])
def test_the_exit_code_is_that_of_the_captures_of_the_run(of_run: str, code: int, tmp_path: Path) -> None:
    """The other one is a result of an earlier run, which is listed."""
    pairs = PairTotals(RunFacts((panel(NIR=15.46),)))
    totals = RunTotals(True, {of_run: 1}, record_of(**{of_run: "done"}), pairs=pairs)
    aligned = NIR | {"status": "aligned", "reason": None}
    totals.pairs.add("IMG_1", example(bands=[aligned]))
    totals.pairs.add("IMG_2", example(bands=[aligned], output=reflectance_by("light sensor")))
    assert conclude(totals, tmp_path, Terminal()) == code


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX")
def test_a_signal_during_an_import_ends_the_command_after_it() -> None:
    """Python ignores exceptions in callbacks of its import locks."""
    code = "os.kill(os.getpid(), signal.SIGTERM); steps.append('import')"
    interrupted = compile(code, "<frozen importlib._bootstrap>", "exec")
    steps: list[str] = []

    def command() -> None:
        with exits(Terminal(quiet=True)):
            exec(interrupted, {"os": os, "signal": signal, "steps": steps})
            raise typer.Exit(0)

    with pytest.raises(typer.Exit) as ended:
        command()
    assert (ended.value.exit_code, steps) == (128 + signal.SIGTERM, ["import"])


@pytest.mark.parametrize(
    ("error", "is_complete", "said"),
    [
        (MemoryError(), True, "the report does not fit into memory; 'agalign report"),
        (OutputError("index.html: cannot be written"), False, "index.html: cannot be written"),
    ],
)
def test_a_report_that_cannot_be_written_is_not_announced(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    is_complete: bool,
    said: str,
) -> None:
    """Where only the memory is too small for the report, the run is complete."""
    monkeypatch.setattr("agalign.batch.run.write_pages", raising(error))
    totals = align_run.run(discover(flight), tmp_path, seeded("rig"), Terminal(), RunOptions())
    conclude(totals, tmp_path, Terminal())
    printed = capsys.readouterr()
    assert said in printed.err + caplog.text
    assert "Report:" not in printed.out
    assert totals.states == {"done": 2}
    assert (said in printed.err) != is_complete


def test_the_system_ends_the_program_at_the_interrupt_key_while_modules_are_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Python ignores the exception in callbacks of its import locks: the run would go on."""
    handlers = []
    monkeypatch.setattr(main, "main", lambda: handlers.append(signal.getsignal(signal.SIGINT)))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        __main__.main()
    finally:
        signal.signal(signal.SIGINT, before)
    assert handlers == [signal.SIG_DFL]
