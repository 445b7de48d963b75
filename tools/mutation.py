"""Measure which faults the tests detect: change the code in small ways and see whether a test fails.

    pip install "mutmut>=3.8,<4"
    python tools/mutation.py [--count 300] [--seed 0] [--packages verify capture flight values] [--list]
                             [--results FILE] [--mypy]

The mutants are a random sample of those that mutmut's operators make (mutants.py). Each one runs the tests of its
package, first the file named after its module, then those of the callers, and stops at the first failure. The work
tree is not touched: two copies of it in a temporary folder take the mutants in turn. Results are appended to FILE, one
JSON object a line; mutants with a result there are not run again. `--mypy` runs mypy on each survivor.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue

from mutants import Mutant, sample

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("verify", "capture", "flight", "values")
CALLERS = "batch", "cameras", "capture", "flight", "pixels", "test_api.py", "products/test_sidecar.py"
"""Tests of the callers, relative to tests/."""
NOT_COPIED = (".git", ".*_cache", "__pycache__", ".hypothesis", ".venv", "build", "dist", "site", "*.egg-info")
TIMEOUT_FACTOR, TIMEOUT_S = 3.0, 30.0
"""A mutant times out after this many times the duration of its tests on unchanged code, plus this many seconds."""
TESTS = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-m"]


@dataclass(frozen=True)
class Result:
    key: str
    path: str
    line: int
    operator: str
    diff: str
    status: str
    """killed, survived, timeout; `type error` where the tests pass and mypy fails."""
    seconds: float


def files_with_tests(path: str) -> list[str]:
    """The tests of a module, relative to the root: the file named after it first, those of the callers last."""
    package = Path(path).parts[1]
    files = sorted(
        (ROOT / "tests" / package).glob("test_*.py"), key=lambda file: file.name != f"test_{Path(path).name}"
    )
    callers = [f"tests/{name}" for name in CALLERS if name != package]
    return [*(file.relative_to(ROOT).as_posix() for file in files), *callers]


def status_of(tests: list[str], copy: Path, limit_s: float | None) -> str:
    """Run tests in a copy of the work tree; returns the status of the mutant that it contains."""
    command = [sys.executable, "-m", "pytest", *TESTS, "not real and not full", *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    if done.returncode == 5:  # no tests
        raise RuntimeError(f"{tests} could not run:\n{done.stdout[-2000:]}")
    # Any other code or signal is caused by the change, as the unchanged code passes.
    return "killed" if done.returncode else "survived"


def run_mutant(mutant: Mutant, copies: "Queue[Path]", limit_s: float, with_mypy: bool) -> Result:
    """Put a mutant into one of the copies and run its tests."""
    began, copy = time.monotonic(), copies.get()
    target = copy / mutant.path
    unchanged = target.read_bytes()
    try:
        target.write_text(mutant.source, encoding="utf-8")
        status = status_of(files_with_tests(mutant.path), copy, limit_s)
        if with_mypy and status == "survived":
            done = subprocess.run(["mypy"], cwd=copy, capture_output=True, check=False)
            status = "type error" if done.returncode == 1 else status
    finally:
        target.write_bytes(unchanged)
        copies.put(copy)
    seconds = round(time.monotonic() - began, 1)
    return Result(mutant.key, mutant.path, mutant.line, mutant.operator, mutant.diff, status, seconds)


def limits_s(paths: set[str], copy: Path) -> dict[str, float]:
    """Longest duration of the tests of each package of these modules, which must pass on the unchanged code."""
    result = {}
    for package in sorted({Path(path).parts[1] for path in paths}):
        tests = next(files_with_tests(path) for path in sorted(paths) if Path(path).parts[1] == package)
        began = time.monotonic()
        if status_of(tests, copy, None) != "survived":
            sys.exit(f"the tests of {package} do not pass on the unchanged code")
        result[package] = TIMEOUT_FACTOR * (time.monotonic() - began) + TIMEOUT_S
    return result


def _print_table(results: list[Result]) -> None:
    print(f"\n{'':24} {'mutants':>8} {'killed':>8} {'timeout':>8} {'type error':>11} {'survived':>9} {'score':>7}")
    groups = [(Path(r.path).parts[1], r.operator) for r in results]
    for name in (*sorted({g[0] for g in groups}), *sorted({g[1] for g in groups}), "all"):
        of = Counter(r.status for r, group in zip(results, groups, strict=True) if name in (*group, "all"))
        score = (of["killed"] + of["timeout"]) / of.total()
        counts = f"{of.total():8} {of['killed']:8} {of['timeout']:8} {of['type error']:11} {of['survived']:9}"
        print(f"{name:24} {counts} {score:7.1%}")
    for r in sorted((r for r in results if r.status in ("survived", "type error")), key=lambda r: (r.path, r.line)):
        print(f"\n{r.status}: {r.path}:{r.line}\n{r.diff}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Mutation test of the packages that decide about an alignment.")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--packages", nargs="+", default=list(PACKAGES), metavar="NAME")
    parser.add_argument("--list", action="store_true", help="print the sample and end")
    parser.add_argument("--results", type=Path, metavar="FILE", default=Path("mutation.jsonl"))
    parser.add_argument("--mypy", action="store_true", help="run mypy on survivors")
    asked = parser.parse_args()
    mutants, candidates = sample(ROOT, asked.packages, asked.count, asked.seed)
    print(f"{len(mutants)} of {candidates} mutants, seed {asked.seed}", flush=True)
    if asked.list:
        for m in mutants:
            print(f"\n{m.path}:{m.line}\n{m.diff}")
        return
    lines = asked.results.read_text(encoding="utf-8").splitlines() if asked.results.is_file() else []
    results = {r.key: r for r in (Result(**json.loads(line)) for line in lines)}
    todo = [m for m in mutants if m.key not in results]
    copies: Queue[Path] = Queue()
    with tempfile.TemporaryDirectory(prefix="agalign-mutation-") as folder, ThreadPoolExecutor(2) as pool:
        for name in ("0", "1"):
            copy = Path(folder).resolve() / name / "agalign"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*NOT_COPIED))
            copies.put(copy)
        limits = limits_s({m.path for m in todo}, copy)
        jobs = [pool.submit(run_mutant, m, copies, limits[Path(m.path).parts[1]], asked.mypy) for m in todo]
        for number, job in enumerate(as_completed(jobs), start=1):
            r = job.result()
            results[r.key] = r
            with asked.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(r)) + "\n")
            print(f"{number}/{len(jobs)} {r.status:9} {r.seconds:5.1f} s {r.path}:{r.line}", flush=True)
    _print_table([results[m.key] for m in mutants])


if __name__ == "__main__":
    main()
