"""Two flights, one output: what a second run does with the results of the first.

    python benchmarks/reliability/two_flights.py [--captures 4]

The synthetic flight is aligned, then a second run gets the same output: of a flight with another date or serial
number, of the folder below, with other options, by another version, or after captures were added. Printed are the exit
code, how many of the first run's files changed, the number of different sizes of the stacks, and the line about it.
"""

import hashlib
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import command, ended, flight_and_out, print_head, print_row, run

from agalign.products.sidecar_file import find_sidecars, read_result
from agalign.synthetic import flight as synthetic

MAX_S = 120.0


def replaced(folder: Path, pattern: str, before: str, after: str) -> None:
    """Replace a text in the files of a folder."""
    for path in folder.rglob(pattern):
        path.write_bytes(path.read_bytes().replace(before.encode(), after.encode()))


def age(out: Path) -> None:
    """Make the results of a run those of another version, which enters the fingerprint."""
    replaced(out, "*.json", '"agalign": "', '"agalign": "0.')
    replaced(out, "*.json", '"settings": "', '"settings": "0')


def add(flight: Path) -> None:
    """Add the later captures."""
    shutil.copytree(flight.with_name("later"), flight, dirs_exist_ok=True)


def hashes(out: Path) -> dict[str, str]:
    """Return the checksum of each file of captures and models, by name."""
    files = [p for p in out.rglob("*") if p.is_file()]
    return {p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def main(captures: int = 4) -> None:
    cases: dict[str, tuple[Callable[[Path, Path], object], str, tuple[str, ...]]] = {
        "other date": (lambda flight, _: replaced(flight, "*.tif", "2026:06:21", "2025:06:21"), "", ()),
        "other serial number": (lambda flight, _: replaced(flight, "*.tif", "0000001-AG", "0000002-AG"), "", ()),
        "folder below": (lambda *_: None, "0000SET", ()),
        "other options": (lambda *_: None, "", ("--crop", "none")),
        "other version": (lambda _, out: age(out), "", ()),
        "more captures": (lambda flight, _: add(flight), "", ()),
    }
    print_head("second run", "exit code", "files changed", "sizes of the stacks", "line")
    with flight_and_out() as (flight, out):
        made, later = flight.with_name("made"), flight.with_name("later")
        synthetic.make_flight(made, captures, (480, 360), rng_seed=3)
        shutil.copytree(made, later)
        for number in range(3, captures + 1):
            for path in made.rglob(f"IMG_{number:04d}_*"):
                path.unlink()
        for case, (change, below, options) in cases.items():
            for folder in (flight, out):
                shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(made, flight)
            ended(command(flight, out, "-j", "1"), MAX_S)
            change(flight, out)
            before = hashes(out)
            argv = [a for a in command(flight / below, out, "-j", "1", *options) if a != "-q"]
            ending, after = ended(argv, MAX_S), hashes(out)
            changed = sum(after.get(name) != digest for name, digest in before.items())
            sizes = {s.output.crop[2:] for p in find_sidecars(out) if (s := read_result(p)).output is not None}
            lines = [line for line in ending.errors.splitlines() if "done again" in line or "agalign: " in line]
            print_row(case, ending.code, f"{changed} of {len(before)}", len(sizes), "; ".join(lines)[:160])


if __name__ == "__main__":
    run(main)
