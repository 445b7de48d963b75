"""Measures figures of docs/figures/figures.csv again by their commands, and prints old and new values.

    pip install -e '.[bench]' && python benchmarks/remeasure.py DATA [--tables accuracy,runs] [--stale]

DATA has a folder for each flight of the commands, at any depth. --stale leaves out figures that the present code has
measured. The new values replace the old ones in the file, command by command; a command that fails leaves its own.
"""

import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from common import print_head, print_row, run
from figures_csv import ROOT, is_current, read_figures


def argv_of(command: str, data: Path) -> list[str]:
    """Return a command with the folders for its placeholders. Raises FileNotFoundError without one."""
    return [sys.executable, *(_word(word, data) for word in shlex.split(command)[1:])]


def _word(word: str, data: Path) -> str:
    if word == "DATA":
        return str(data)
    if not word.startswith("DATA"):
        return word
    name = word.removeprefix("DATA/")
    found = [path for path in sorted(data.rglob(name)) if path.is_dir()]
    if not found:
        raise FileNotFoundError(f"{data}: contains no folder {name}")
    return str(found[0])


def changes(old: dict[str, str], new: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """Yield (fact, old value, new value) of all facts in either one."""
    for fact in {**old, **new}:
        yield fact, old.get(fact, "-"), new.get(fact, "-")


def main(data: Path, tables: str = "", *, stale: bool = False) -> None:
    commands = {}
    for row in read_figures():
        table = row["fact"].split(" / ")[0]
        if (not tables or table in tables.split(",")) and not (stale and is_current(table, row["digest"])):
            commands[row["command"]] = True
    print_head("fact", "old", "new", "")
    for command in commands:
        old = {row["fact"]: row["value"] for row in read_figures() if row["command"] == command}
        try:
            done = subprocess.run([*argv_of(command, data), "--figures"], cwd=ROOT, stdout=sys.stderr, check=False)
        except FileNotFoundError as error:
            print(f"{command}: not measured ({error})", file=sys.stderr)
            continue
        if done.returncode != 0:
            print(f"{command}: ended with exit code {done.returncode}", file=sys.stderr)
            continue
        new = {row["fact"]: row["value"] for row in read_figures() if row["command"] == command}
        for fact, before, after in changes(old, new):
            print_row(fact, before, after, "" if before == after else "changed")


if __name__ == "__main__":
    run(main)
