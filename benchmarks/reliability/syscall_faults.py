"""Let single system calls of a run fail, run the same command again, and compare with an undisturbed run.

    python benchmarks/reliability/syscall_faults.py [--faults 200] [--figures]

`strace` lists the calls of an undisturbed run that have a file or folder below the output folder as their argument.
In each further run it makes one of them fail, drawn at random: `-P FILE -e inject=write:error=EIO:when=3`. Temporary
files have the same names in every run. Linux only. Without strace, or where the system does not allow tracing, nothing
is measured.
"""

import os
import random
import re
import shutil
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Ending, ended, run, table
from figures_csv import FiguresOption, end_check
from kills import differences, snapshot, torn

from agalign.host.files import SUMMARY_FILE
from agalign.synthetic import flight as synthetic

CAPTURES, SIZE_PX = 2, (240, 180)
OPTIONS = (
    "--layout",
    "both",
    "--error-map",
    "--tie-points",
    "--bands",
    "green,red",
    "--relief",
    "never",
    "-j",
    "1",
    "-q",
)
_USUAL = "EIO", "ENOSPC", "EINTR"
ERRORS = dict.fromkeys(("write", "pwrite64", "fsync", "rename", "openat", "close"), _USUAL)
ERRORS["rename"] = "EIO", "ENOSPC", "EACCES"
MAX_S = 60
PROGRAM = """
import itertools, os, secrets, types
from agalign.cli.main import main
from agalign.host import files

# Names of partial files contain both.
numbers = itertools.count()
secrets.token_hex = lambda _bytes=None: f"{next(numbers):016x}"
files.os = types.SimpleNamespace(**(vars(os) | {"getpid": lambda: 1}))
main()
"""
_CALL = re.compile(r'^\d+\s+(\w+)\((?:\d+<([^>]*)>|(?:AT_FDCWD[^,]*, )?"([^"]*)")')


def run_traced(argv: list[str], folder: Path, *tracing: str) -> tuple[Ending, str]:
    """Run the program; with arguments of strace, traced by it, and return the trace too."""
    trace = folder / "trace.txt"
    trace.write_text("")
    strace = ["strace", "-f", "-y", *tracing, "-o", str(trace)] if tracing else []
    ending = ended([*strace, sys.executable, "-c", PROGRAM, *argv], MAX_S)
    return ending, trace.read_text(errors="replace")


def calls_in(out: Path, trace: str) -> Iterator[tuple[str, str, bool]]:
    """Yield (name, path, whether strace made it fail) of each system call with a file or folder below `out`."""
    for line in trace.splitlines():
        match = _CALL.match(line)
        path = (match[2] or match[3]) if match else ""
        if match and f"{path}/".startswith(f"{out}/"):
            yield match[1], path, "(INJECTED)" in line


def plan(calls: dict[str, Counter[str]], faults: int, rng: random.Random) -> list[tuple[str, str, str, int]]:
    """(call, error, path, number of the call from 1) of each fault: pairs of call and error in turn, each with a random
    file, and a random call of those on the file; none twice.
    """
    pairs = [(call, error) for call, errors in ERRORS.items() for error in errors if calls.get(call)]
    result: dict[tuple[str, str, str, int], None] = {}
    for call, error in islice(cycle(pairs), 10 * faults):
        path = rng.choice(sorted(calls[call]))
        result[call, error, path, rng.randint(1, calls[call][path])] = None
    return list(result)[:faults]


def compared(out: Path, expected: dict[str, object]) -> Counter[str]:
    """Return the numbers of missing, left-over, unreadable and different files; the summary, which holds seconds, is
    different if it lacks a line.
    """
    result, summary = differences(out, expected), out / SUMMARY_FILE
    result["different"] += not summary.exists() or len(summary.read_text().splitlines()) != 1 + CAPTURES
    return result


def faults_of(ending: Ending, out: Path, expected: dict[str, object]) -> Counter[str]:
    """What is wrong right after a run with a fault."""
    if ending.code is None:
        return Counter(hung=1)
    result = Counter(torn=torn(out), traceback=int(ending.has_traceback))
    if ending.code == 0 and not ending.complaints:
        result["unnoticed"] = sum(compared(out, expected).values())
    elif ending.code not in (1, 3) or not ending.complaints:
        result["bad exit"] = 1
    result["left over"] = any(p.name.startswith(".agalign") for p in out.rglob("*"))
    return result


def main(faults: int = 200, rng_seed: int = 0, *, figures: FiguresOption = False) -> None:
    if shutil.which("strace") is None or sys.platform != "linux":
        raise SystemExit("strace is not installed (apt-get install strace)")
    rng, rows = random.Random(rng_seed), defaultdict[str, Counter[str]](Counter)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        flight, out = folder / "flight", folder / "out"
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        argv = [str(flight), "-o", str(out), *OPTIONS]
        whole, trace = run_traced(argv, folder, "-e", "trace=" + ",".join(ERRORS))
        if whole.code != 0 or whole.complaints:
            raise SystemExit(f"the run without faults ended with {whole.code}: {whole.errors}")
        expected = snapshot(out)
        calls: dict[str, Counter[str]] = defaultdict(Counter)
        for call, path, _ in calls_in(out, trace):
            calls[call][path] += 1
        print({name: paths.total() for name, paths in calls.items()}, f"{len(expected)} files", flush=True)
        for number, (call, error, path, at) in enumerate(plan(calls, faults, rng), start=1):
            shutil.rmtree(out, ignore_errors=True)
            inject = f"inject={call}:error={error}:when={at}"
            ending, trace = run_traced(argv, folder, "-P", path, "-e", f"trace={call}", "-e", inject)
            here = faults_of(ending, out, expected)
            again, _ = run_traced(argv, folder)
            after = compared(out, expected)
            after["bad exit"] = int(again.code != 0 or bool(again.complaints))
            failed = (os.path.relpath(p, out) for _, p, injected in calls_in(out, trace) if injected)
            hit = re.sub(r"part-[\w-]+", "part-*", next(failed, ""))
            wrong = +(here + Counter({f"{k} afterwards": v for k, v in after.items()}))
            rows[call]["runs"] += bool(hit)
            rows[call]["refused"] += ending.code in (1, 3) and bool(ending.complaints)
            rows[call]["as if nothing happened"] += ending.code == 0
            rows[call]["violations"] += wrong.total()
            print(
                f"{number}: {call} {error} {at} ({hit or 'not reached'}): {ending.code} {ending.complaints[:1]} "
                f"{ending.seconds + again.seconds:.1f} s {dict(wrong) or ''}",
                flush=True,
            )
            if wrong:
                print(ending.errors, "\nafterwards:", again.code, again.errors, flush=True)
    kinds = "runs", "refused", "as if nothing happened", "violations"
    runs, _, _, violations = (sum(row[kind] for row in rows.values()) for kind in kinds)
    head = "call", "runs", "error reported", "finished", "violations"
    print(table([head, *((call, *(row[kind] for kind in kinds)) for call, row in rows.items())]))
    print(f"\n{runs} runs over {CAPTURES} captures of {SIZE_PX[0]} x {SIZE_PX[1]}, one failed call each")
    name = "one failing system call on an output file, then the same command again"
    end_check(name, f"{runs} runs", violations, figures=figures)


if __name__ == "__main__":
    run(main)
