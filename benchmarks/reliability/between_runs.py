"""Damage one file between two runs, run a command, and compare the output folder with that of an undisturbed command.

    python benchmarks/reliability/between_runs.py [--targets "sidecar,stack"] [--states "empty,a link"]
        [--commands "same run,verify"] [--figures]

A small synthetic flight is aligned once. Then each kind of file, of the output and of the input, gets each state, and
each command runs on a fresh copy. Counted are results that `agalign verify` confirms although they are not what the
command makes of undamaged files (laundered), files that are gone or have fewer bands (lost), and tracebacks. The table
also lists what the command said. Root can write to read-only files, so that they are left out for it.
"""

import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Ending, print_head, print_row, run, table
from figures_csv import FiguresOption, end_check

from agalign.cli import main as cli
from agalign.cli.terminal import ExitCode
from agalign.records.sidecar_file import find_sidecars, read_sidecar, verify_outputs, write_sidecar
from agalign.synthetic import flight as synthetic

SIZE_PX = 240, 180
OPTIONS = *("--layout", "both", "--qa", "--tie-points", "--bands", "green,red,nir", "--relief", "never"), *("-j", "1")
FOLDER = Path("0000SET", "000")
FIRST, SECOND = "IMG_0001", "IMG_0002"
OF_CAPTURE = {
    "sidecar": ".json",
    "stack": ".tif",
    "band file": "_4.tif",
    "picture": ".png",
    "preview": ".preview.jpg",
    "quality raster": ".qa.tif",
    "tie points": ".ties.csv",
    "index": "_sum.tif",
    "picture of the index": "_sum.png",
}
"""Suffixes of the files of a capture by what they are."""
OF_RUN = {"run record": "agalign-run.json", "report": "index.html", "summary": "summary.csv", "indices": "indices.csv"}
INPUTS = {"input, reference": "_2.tif", "input, moving band": "_4.tif"}
MODEL = "model"
TARGETS = (*OF_CAPTURE, *OF_RUN, MODEL, *INPUTS)
MINE = b"a file of the user"


@dataclass(frozen=True)
class Place:
    """A flight and its output, in a folder of their own."""

    folder: Path

    @property
    def flight(self) -> Path:
        return self.folder / "flight"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def path(self, target: str, capture: str = FIRST) -> Path:
        """Return the file of a kind."""
        if target in INPUTS:
            return self.flight / FOLDER / f"{capture}{INPUTS[target]}"
        if target == MODEL:
            return self.out / "models" / "RedEdge-M_SY01-0000001-AG.safetensors"
        if target in OF_RUN:
            return self.out / OF_RUN[target]
        return self.out / FOLDER / f"{capture}{OF_CAPTURE[target]}"


# ---- commands


def said(*arguments: object) -> Ending:
    """Run the command line in this process."""
    out, errors, before = io.StringIO(), io.StringIO(), sys.argv
    sys.argv, code = ["agalign", *map(str, arguments)], 0
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(out):
            cli.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        sys.argv = before
    return Ending(code, errors.getvalue(), out.getvalue())


def _export(place: Place) -> Ending:
    return said("export", place.out, "--for", "metashape", "-o", place.folder / "export")


COMMANDS: dict[str, Callable[[Place], Ending]] = {
    "same run": lambda p: said(p.flight, "-o", p.out, *OPTIONS),
    "changed run": lambda p: said(p.flight, "-o", p.out, *OPTIONS, "--crop", "none"),
    "verify": lambda p: said("verify", p.out),
    "report": lambda p: said("report", p.out),
    "indices": lambda p: said("indices", p.out, "--formula", "sum=G+R"),
    "export": _export,
}


# ---- states


def _edited(path: Path) -> None:
    """Change a number of a text, or some bytes in the middle of another file, and keep size and time."""
    times, data = path.stat(), bytearray(path.read_bytes())
    if path.suffix in (".json", ".csv"):
        text = bytes(data)
        for old in (b'"fixed_to_moving": [[1', b"0.0", b"1"):
            if old in text:
                data[:] = text.replace(old, old[:-1] + b"9", 1)
                break
    else:
        middle = len(data) // 2
        data[middle : middle + 64] = bytes(b ^ 0x15 for b in data[middle : middle + 64])
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def _of_other_version(path: Path, _: Place, target: str) -> None:
    if target == "sidecar":
        write_sidecar(path, read_sidecar(path).model_copy(update={"agalign": "0.0.9", "estimated_with": "0"}))
    else:
        path.write_text(json.dumps({**json.loads(path.read_text()), "schema": "agalign-run/0", "agalign": "0.0.9"}))


def _link(path: Path, place: Place, _: str) -> None:
    (place.folder / "mine").write_bytes(MINE)
    path.unlink()
    path.symlink_to(place.folder / "mine")


def _folder(path: Path, *_: object) -> None:
    path.unlink()
    path.mkdir()
    (path / "mine").write_bytes(MINE)


def _of_other_capture(path: Path, place: Place, target: str) -> None:
    shutil.copyfile(place.path(target, SECOND), path)


State = Callable[[Path, Place, str], object]
STATES: dict[str, State] = {
    "missing": lambda path, *_: path.unlink(),
    "empty": lambda path, *_: path.write_bytes(b""),
    "truncated": lambda path, *_: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "edited": lambda path, *_: _edited(path),
    "a file of the user": lambda path, *_: path.write_bytes(MINE),
    "another capture": _of_other_capture,
    "another version": _of_other_version,
    "a link": _link,
    "a folder": _folder,
    "read-only": lambda path, *_: path.chmod(0o444),
}
"""Changes of a file."""


def has_state(target: str, state: str) -> bool:
    """Return True if a kind of file can be in a state; root can write to files that are read-only."""
    if state == "another version":
        return target in ("sidecar", "run record")
    if state == "another capture":
        return target not in OF_RUN and target != MODEL
    return state != "read-only" or os.geteuid() != 0


# ---- verdicts


def _content(path: Path) -> object:
    """Return what must be equal: JSON without seconds and times of files, else the bytes; None without a file."""
    if not path.is_file():
        return None
    if path.suffix != ".json":
        return path.read_bytes()
    skipped = {"seconds", "checksum", "input_states"}
    try:
        text = path.read_text()
        content = json.loads(text, object_hook=lambda part: {k: v for k, v in part.items() if k not in skipped})
        content["products"] = sorted(content["products"], key=itemgetter("file"))
    except (ValueError, KeyError, TypeError):
        return path.read_bytes()
    return content


def contents(place: Place) -> dict[str, object]:
    """Return the contents of the files of the captures by name."""
    files = (p for p in (place.out / FOLDER).iterdir() if p.is_file())
    return {path.name: _content(path) for path in files}


def _bands(place: Place) -> int:
    with contextlib.suppress(Exception):
        return len(read_sidecar(place.path("sidecar")).bands)
    return 0


def faults_of(
    ending: Ending, place: Place, target: str, state: str, expected: dict[str, object], *, is_run: bool
) -> Iterator[str]:
    """Yield what is wrong after a command on damaged files, given the contents after it on undamaged ones."""
    if ending.has_traceback or ending.code is None:
        yield "traceback"
    here, path = contents(place), place.path(target)
    mine = place.folder / "mine" if state == "a link" else path / "mine"
    if state in ("a link", "a folder") and (not mine.exists() or mine.read_bytes() != MINE):
        yield "lost"
    harmed = path.name if target in OF_CAPTURE else ""
    others = {name for name in expected if name != harmed and not name.startswith(FIRST) and name not in here}
    if others or (target in INPUTS and state != "edited" and _bands(place) < 3):
        yield "lost"
    problems = [text for p, texts in verify_outputs(place.out) if p.stem == FIRST for text in texts]
    if target in INPUTS:
        is_other = state in ("edited", "another capture")
        if is_run and is_other and "input files" not in ending.errors and ending.code == 0:
            yield "laundered"
        return
    if state == "another version" and not is_run:  # a good result of that version
        return
    own = {name: content for name, content in expected.items() if name.startswith(FIRST)}
    wrong = [name for name, content in own.items() if here.get(name) != content]
    if wrong and not problems and FIRST in {p.stem for p in find_sidecars(place.out)}:
        yield f"laundered ({wrong[0]})"


def last_line(ending: Ending) -> str:
    """Return the most telling line that a command printed."""
    lines = [line for line in ending.errors.splitlines() if "again; changed since" in line] or ending.complaints
    told = [line for line in lines if "raw numbers" not in line] or ending.out.splitlines()[-1:] or [""]
    return told[0].removeprefix("agalign: ")[-110:].strip()


def main(
    targets: str = ",".join(t.replace(",", ";") for t in TARGETS),
    states: str = ",".join(STATES),
    commands: str = ",".join(COMMANDS),
    *,
    figures: FiguresOption = False,
) -> None:
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        first = Place(Path(name).resolve() / "undamaged")
        synthetic.make_flight(first.flight, 2, SIZE_PX, rng_seed=4)
        for words in ((first.flight, "-o", first.out, *OPTIONS), ("indices", first.out, "--formula", "sum=G+R")):
            if (ending := said(*words)).code not in (0, 3):
                raise SystemExit(f"the run without damage ended with {ending.code}: {ending.errors}")
        wanted, expected = commands.split(","), dict[str, dict[str, object]]()
        for command in wanted:
            place = Place(Path(name).resolve() / "place")
            shutil.copytree(first.folder, place.folder)
            unchanged = contents(place)
            COMMANDS[command](place)
            expected[command] = contents(place)
            shutil.rmtree(place.folder)
        print_head("file", "state", "command", "exit code", "message", "wrong")
        for target in (t.replace(";", ",") for t in targets.split(",")):
            for state in (state for state in states.split(",") if has_state(target, state)):
                for command in wanted:
                    shutil.copytree(first.folder, place.folder)
                    STATES[state](place.path(target), place, target)
                    ending = COMMANDS[command](place)
                    is_run = command.endswith("run")
                    is_refused = ending.code in (ExitCode.NOTHING, ExitCode.USAGE)
                    here = unchanged if is_refused else expected[command]
                    wrong = [*faults_of(ending, place, target, state, here, is_run=is_run)]
                    message = last_line(ending).replace(str(place.folder), "").replace("|", "/")
                    print_row(target, state, command, ending.code, message, ", ".join(wrong))
                    counts.update({"tries": 1} | dict.fromkeys((w.partition(" ")[0] for w in wrong), 1))
                    shutil.rmtree(place.folder)
    kinds = "tries", "laundered", "lost", "traceback"
    print(table([kinds, tuple(counts[kind] for kind in kinds)]))
    failures = sum(counts[kind] for kind in kinds[1:])
    end_check("one damaged file between two commands", f"{counts['tries']} tries", failures, figures=figures)


if __name__ == "__main__":
    run(main)
