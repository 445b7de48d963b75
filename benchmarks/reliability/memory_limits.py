"""Limit the address space of a run, as `ulimit -v` does, from too little to load the libraries to enough.

    python benchmarks/reliability/memory_limits.py [--from 1.0] [--to 2.0] [--step 0.05] [--figures]

A run must finish, or end within a minute with a line that gives the reason. Linux only.
"""

import re
import resource
import signal
import sys
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import command, ended, flight_and_out, run, table
from figures_csv import FiguresOption, TableRow, write_figures

from agalign.synthetic import flight as synthetic

CAPTURES, SIZE_PX = 4, (240, 180)
MAX_S = 60


def run_within(limit_gb: float, flight: Path, out: Path, *options: str) -> tuple[str, str, float]:
    """(how it ended, its first line, seconds) of a run with so much address space."""
    limit = partial(resource.setrlimit, resource.RLIMIT_AS, (int(limit_gb * 1e9),) * 2)
    ending = ended(command(flight, out, "--bands", "green,red", *options), MAX_S, preexec_fn=limit)
    if ending.code is None:
        return f"not ended after {MAX_S} s", "", ending.seconds
    # The limit itself is in the line.
    line = next(iter([*ending.complaints, *ending.errors.splitlines()[-1:]]), "")
    line = re.sub(r"limited to [0-9.]+ GB", "limited to … GB", line.replace(f"{out}/", "").replace(f"{flight}/", ""))
    code = ending.code
    how = f"exit code {code}" if code >= 0 else f"ended by {signal.Signals(-code).name}"
    if ending.has_traceback:
        how += ", with a traceback or a request for a report"
    elif code and not ending.complaints:
        how += ", without a reason"
    return how, line.removeprefix("agalign: "), ending.seconds


def main(
    first_gb: Annotated[float, typer.Option("--from")] = 1.0,
    last_gb: Annotated[float, typer.Option("--to")] = 2.0,
    step_gb: Annotated[float, typer.Option("--step")] = 0.05,
    *,
    figures: FiguresOption = False,
) -> None:
    rows: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    with flight_and_out() as (flight, out):
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        for jobs in (1, 2):
            for step in range(round((last_gb - first_gb) / step_gb) + 1):
                limit_gb = first_gb + step * step_gb
                # A time limit asks for worker processes; a flight of four captures is done in threads otherwise.
                workers = () if jobs == 1 else ("--timeout", "100")
                new = out.with_name(f"out{jobs}-{step}")
                how, line, seconds = run_within(limit_gb, flight, new, "-j", str(jobs), *workers)
                print(f"-j {jobs} {limit_gb:.2f} GB: {how}, {seconds:.1f} s: {line}", flush=True)
                rows[how, line].append((limit_gb, seconds))
    lines = [("limit, GB", "runs", "slowest, s", "how it ended", "first line")]
    for (how, line), seen in rows.items():
        limits_gb, seconds_of = zip(*seen, strict=True)
        ends = dict.fromkeys(f"{gb:.2f}" for gb in (min(limits_gb), max(limits_gb)))
        lines.append((" to ".join(ends), len(seen), f"{max(seconds_of):.0f}", how, line))
    print(table(lines))
    if figures:
        runs = sum(map(len, rows.values()))
        failures = sum(len(seen) for (how, _), seen in rows.items() if not re.fullmatch(r"exit code \d+", how))
        name = f"address space limited to {first_gb:g} to {last_gb:g} GB"
        write_figures([TableRow("reliability", name, f"{runs} runs", {"failures": failures})])


if __name__ == "__main__":
    run(main)
