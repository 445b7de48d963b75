"""Measure which faults the tests detect: change the code in small ways and see whether a test fails.

    pip install "mutmut>=3.8,<4"
    python tools/mutation.py [--count 300] [--seed 0] [--packages verify capture flight values] [--list]
                             [--results FILE [--resume] [--retry-survivors]] [--max-test-seconds S] [--mypy]

The mutants are a random sample of those that mutmut's operators make (mutants.py). Each one runs the tests of its
package, first the file named after its module and then the fastest, and stops at the first failure. The work tree is
not touched: two copies of it in a temporary folder take the mutants in turn. The libraries are imported once, and a
process is forked for each mutant; this needs Linux or macOS. Results are appended to FILE, one JSON object a line; an
interrupted run continues with `--resume`, and `--retry-survivors` also runs the survivors again, after tests were
added. With `--max-test-seconds`, a file of tests that takes longer on unchanged code runs only against the module that
it is named after: faster, and a survivor may then be one that a slow test would detect. `--mypy` runs mypy on each
survivor.
"""

import argparse
import contextlib
import importlib
import importlib.util
import json
import math
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue

os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch reads it when it is imported

from mutants import Mutant, sample

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("verify", "capture", "flight", "values")
ELSEWHERE = {
    "agalign/capture/align.py": ("tests/test_api.py",),
    "agalign/capture/reference.py": ("tests/test_api.py",),
    "agalign/flight/model.py": ("tests/batch/test_flight.py",),
    "agalign/values/alignment.py": ("tests/capture/test_band_pair.py", "tests/products/test_sidecar.py"),
    "agalign/values/capture.py": ("tests/cameras/test_cameras.py", "tests/cameras/test_discover.py"),
    "agalign/values/issues.py": ("tests/verify/test_checks.py", "tests/products/test_failures.py"),
    "agalign/values/image.py": ("tests/pixels/test_masks.py", "tests/pixels/test_resample.py"),
    "agalign/values/mapping.py": ("tests/pixels/test_resample.py",),
    "agalign/values/text.py": ("tests/products/test_failures.py",),
}
"""Modules that are also tested outside tests/<package>; those tests run after the package's own."""
PRELOADED = ("cv2", "numpy", "pydantic", "pytest", "rasterio", "scipy.optimize", "skimage", "torch", "typer", "xarray")
"""Libraries that take long to import."""
NOT_COPIED = (".git", ".*_cache", "__pycache__", ".hypothesis", ".venv", "build", "dist", "site", "*.egg-info")
TIMEOUT_FACTOR, TIMEOUT_S = 3.0, 30.0
"""A mutant times out after this many times the duration of its tests on unchanged code, plus this many seconds."""
BASELINE_LIMIT_S = 1800.0
LOG = Path("../tests.log")
"""Output of the tests, next to a copy."""


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


def files_with_tests(path: str, seconds: dict[str, float], max_seconds: float = math.inf) -> tuple[str, ...]:
    """The tests of a module, relative to the root: the file named after it, then the others of its package and those
    elsewhere that take up to `max_seconds`, the fastest first.
    """
    folder, own = ROOT / "tests" / Path(path).parts[1], f"test_{Path(path).name}"
    files = {*(p.relative_to(ROOT).as_posix() for p in folder.glob("test_*.py")), *ELSEWHERE.get(path, ())}
    files = {f for f in files if Path(f).name == own or seconds.get(f, 0.0) <= max_seconds}
    return tuple(sorted(files, key=lambda f: (Path(f).name != own, seconds.get(f, 0.0), f)))


@dataclass(frozen=True)
class Job:
    """Tests of a mutant, or of the unchanged code."""

    mutant: Mutant | None
    tests: tuple[str, ...]
    limit_s: float
    mypy: bool = False
    """Also run mypy if the tests pass."""


def work_in(copies: "Queue[Path]") -> None:
    """Take one of the copies of the work tree for this process."""
    os.chdir(copies.get())


def do(job: Job) -> tuple[Job, str, float]:
    """Run a job in the copy of this process; returns it with its status and seconds."""
    began = time.monotonic()
    with changed(job.mutant):
        status = run_tests(job)
        if job.mypy and status == "survived":
            done = subprocess.run(["mypy"], capture_output=True, check=False)
            status = "type error" if done.returncode == 1 else status
    return job, status, time.monotonic() - began


@contextlib.contextmanager
def changed(mutant: Mutant | None) -> Iterator[None]:
    """The copy with one module replaced; its time is put back too, so that its compiled file is valid again."""
    if mutant is None:
        yield
        return
    target = Path(mutant.path)
    before, stat = target.read_bytes(), target.stat()
    target.write_text(mutant.source, encoding="utf-8")
    try:
        yield
    finally:
        target.write_bytes(before)
        os.utime(target, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def run_tests(job: Job) -> str:
    """Run pytest in a fork of this process; returns the status of the mutant."""
    deadline_s = time.monotonic() + job.limit_s
    pid = os.fork()
    if pid == 0:
        _run_pytest(job.tests)
    while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
        if time.monotonic() > deadline_s:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return "timeout"
        time.sleep(0.05)
    code = os.waitstatus_to_exitcode(ended[1])
    if code in (5, 98, 99):  # 5 is pytest's for no tests
        raise RuntimeError(f"{job.tests} could not run:\n{LOG.read_text()[-2000:]}")
    # Any other code or signal is caused by the change, as the unchanged code passed.
    return "killed" if code else "survived"


def _run_pytest(tests: tuple[str, ...]) -> None:
    """End this process with the exit code of pytest, 99 where another agalign is found, 98 without any."""
    code = 98
    try:
        os.setsid()
        log, here = os.open(LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), Path.cwd()
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.path[:] = [str(here), *(p for p in sys.path if Path(p).resolve() not in (ROOT, ROOT / "tools"))]
        os.environ |= {"PYTHONPATH": str(here), "PYTHONDONTWRITEBYTECODE": "1"}
        spec = importlib.util.find_spec("agalign")
        if spec is None or not Path(spec.origin or "").is_relative_to(here):
            os._exit(99)
        import pytest

        options = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "-m", "not real and not full", "--hypothesis-seed=0"]
        code = int(pytest.main([*options, *tests]))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def done_by(pool: Executor, jobs: list[Job]) -> Iterator[tuple[Job, str, float]]:
    """Jobs with status and seconds, in the order in which they end."""
    return (future.result() for future in as_completed([pool.submit(do, job) for job in jobs]))


def measured(pool: Executor, files: Iterable[str], cache: Path) -> dict[str, float]:
    """Seconds that each file of tests takes on the unchanged code, which must pass; those in `cache` are not run."""
    seconds: dict[str, float] = json.loads(cache.read_text(encoding="utf-8")) if cache.is_file() else {}
    jobs = [Job(None, (file,), BASELINE_LIMIT_S) for file in sorted(set(files) - set(seconds))]
    for job, status, took in done_by(pool, jobs):
        if status != "survived":
            sys.exit(f"{job.tests[0]} does not pass on the unchanged code")
        seconds[job.tests[0]] = took
        cache.write_text(json.dumps(seconds), encoding="utf-8")
        print(f"unchanged  {took:5.1f} s {job.tests[0]}", flush=True)
    return seconds


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


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Mutation test of the packages that decide about an alignment.")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--packages", nargs="+", default=list(PACKAGES), metavar="NAME")
    parser.add_argument("--list", action="store_true", help="print the sample and end")
    parser.add_argument("--results", type=Path, metavar="FILE", default=Path("mutation.jsonl"))
    parser.add_argument("--resume", action="store_true", help="keep the results in FILE")
    parser.add_argument("--retry-survivors", action="store_true", help="the same, but run survivors again")
    parser.add_argument("--max-test-seconds", type=float, default=math.inf, metavar="S")
    parser.add_argument("--mypy", action="store_true", help="run mypy on survivors")
    return parser.parse_args()


def _earlier(asked: argparse.Namespace) -> dict[str, Result]:
    """Results of an earlier run by the mutant's key; the file is emptied of what is run again."""
    lines: list[str] = []
    if (asked.resume or asked.retry_survivors) and asked.results.is_file():
        lines = asked.results.read_text(encoding="utf-8").splitlines()
    else:
        asked.results.with_suffix(".durations.json").unlink(missing_ok=True)
    kept = {r.key: r for r in (Result(**json.loads(line)) for line in lines)}
    if asked.retry_survivors:
        kept = {k: r for k, r in kept.items() if r.status == "killed"}
    asked.results.write_text("".join(json.dumps(asdict(r)) + "\n" for r in kept.values()), encoding="utf-8")
    return kept


def main() -> None:
    asked = _arguments()
    missing = [name for row in ELSEWHERE.items() for name in (row[0], *row[1]) if not (ROOT / name).is_file()]
    if missing:
        sys.exit(f"ELSEWHERE names files that do not exist: {', '.join(missing)}")
    mutants, candidates = sample(ROOT, asked.packages, asked.count, asked.seed)
    print(f"{len(mutants)} of {candidates} mutants, seed {asked.seed}", flush=True)
    if asked.list:
        for m in mutants:
            print(f"\n{m.path}:{m.line}\n{m.diff}")
        return
    results = _earlier(asked)
    todo = [m for m in mutants if m.key not in results]
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    sys.dont_write_bytecode = True
    fork = multiprocessing.get_context("fork")
    copies: Queue[Path] = fork.Queue()
    with tempfile.TemporaryDirectory(prefix="agalign-mutation-") as folder:
        for name in ("0", "1"):
            copy = Path(folder).resolve() / name / "agalign"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*NOT_COPIED))
            subprocess.run([sys.executable, "-m", "compileall", "-q", str(copy / "agalign")], check=True)
            copies.put(copy)
        with ProcessPoolExecutor(2, fork, work_in, (copies,)) as pool:
            files = {file for m in todo for file in files_with_tests(m.path, {})}
            durations = measured(pool, files, asked.results.with_suffix(".durations.json"))
            jobs = []
            for m in todo:
                tests = files_with_tests(m.path, durations, asked.max_test_seconds)
                limit_s = TIMEOUT_FACTOR * sum(durations[f] for f in tests) + TIMEOUT_S
                jobs.append(Job(m, tests, limit_s, asked.mypy))
            for number, (job, status, seconds) in enumerate(done_by(pool, jobs), start=1):
                m = job.mutant
                results[m.key] = Result(m.key, m.path, m.line, m.operator, m.diff, status, round(seconds, 1))
                with asked.results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(results[m.key])) + "\n")
                print(f"{number}/{len(jobs)} {status:9} {seconds:5.1f} s {m.path}:{m.line}", flush=True)
    _print_table([results[m.key] for m in mutants])


if __name__ == "__main__":
    main()
