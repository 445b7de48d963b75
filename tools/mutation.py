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
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

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
    "agalign/values/issues.py": ("tests/verify/test_acceptance.py", "tests/products/test_failures.py"),
    "agalign/values/image.py": ("tests/pixels/test_masks.py", "tests/pixels/test_resample.py"),
    "agalign/values/mapping.py": ("tests/pixels/test_resample.py",),
    "agalign/values/text.py": ("tests/products/test_failures.py",),
}
"""Modules whose behaviour is also tested outside tests/<package>; those tests run after the package's own."""
PRELOADED = (
    "cv2", "defusedxml", "filelock", "jinja2", "numpy", "PIL.Image", "pydantic", "pytest",
    "rasterio", "rich", "safetensors.torch", "scipy.ndimage", "scipy.optimize", "scipy.spatial", "skimage", "tifffile",
    "torch", "typer", "xarray",
)  # fmt: skip
NOT_COPIED = (".git", ".*_cache", "__pycache__", ".hypothesis", ".venv", "build", "dist", "site", "*.egg-info")
TIMEOUT_FACTOR, TIMEOUT_S = 3.0, 30.0
"""A mutant times out after this many times the duration of its tests on unchanged code, plus this many seconds."""
BASELINE_LIMIT_S = 1800.0


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


def run_tests(copy: Path, tests: tuple[str, ...]) -> int:
    """Run pytest in this (forked) process group on a copy; returns its exit code, 99 where another agalign is found."""
    os.setsid()
    log = os.open(copy.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.chdir(copy)
    sys.path[:] = [str(copy), *(p for p in sys.path if Path(p).resolve() not in (ROOT, ROOT / "tools"))]
    os.environ |= {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    spec = importlib.util.find_spec("agalign")
    if spec is None or not Path(spec.origin or "").is_relative_to(copy):
        return 99
    import pytest

    options = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "-m", "not real", "--hypothesis-seed=0"]
    return int(pytest.main([*options, *tests]))


class Slot:
    """One copy of the work tree, and the process that runs tests in it."""

    def __init__(self, copy: Path) -> None:
        self.copy = copy
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*NOT_COPIED))
        subprocess.run([sys.executable, "-m", "compileall", "-q", str(copy / "agalign")], check=True)

    @contextlib.contextmanager
    def changed(self, path: str, source: str) -> Iterator[None]:
        """The copy with one module replaced; its time is put back too, so that its compiled file is valid again."""
        target = self.copy / path
        before, stat = target.read_bytes(), target.stat()
        target.write_text(source, encoding="utf-8")
        try:
            yield
        finally:
            target.write_bytes(before)
            os.utime(target, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    def start(self, tests: tuple[str, ...]) -> int:
        """Fork a process that runs the tests; returns its id."""
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            return pid
        code = 98
        try:
            code = run_tests(self.copy, tests)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def status_by_mypy(self, mutant: Mutant) -> str:
        with self.changed(mutant.path, mutant.source):
            command = ["mypy", "--cache-dir", str(self.copy.with_name("mypy"))]
            done = subprocess.run(command, cwd=self.copy, capture_output=True, check=False)
        return "type error" if done.returncode == 1 else "survived"


@dataclass
class Run:
    """Tests of a mutant, or of the unchanged code."""

    mutant: Mutant | None
    tests: tuple[str, ...]
    limit_s: float
    pid: int = 0
    began: float = 0.0
    changed: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    def start(self, slot: Slot) -> None:
        if self.mutant is not None:
            self.changed.enter_context(slot.changed(self.mutant.path, self.mutant.source))
        self.began, self.pid = time.monotonic(), slot.start(self.tests)


def run_all(slots: list[Slot], runs: list[Run]) -> Iterator[tuple[Run, str]]:
    """Do the runs, one in each slot at a time; yields each with its status."""
    busy: dict[int, Run] = {}
    queue = list(reversed(runs))
    try:
        while queue or busy:
            for k, slot in enumerate(slots):
                if k not in busy and queue:
                    busy[k] = queue.pop()
                    busy[k].start(slot)
                elif k in busy and (status := _status(busy[k])):
                    done = busy.pop(k)
                    done.changed.close()
                    if status == "broken":
                        sys.exit(f"{done.tests} could not run:\n{slot.copy.with_suffix('.log').read_text()[-2000:]}")
                    yield done, status
            time.sleep(0.05)
    finally:
        for run in busy.values():
            _kill(run.pid)


def _status(run: Run) -> str:
    """Empty while it runs."""
    pid, raw = os.waitpid(run.pid, os.WNOHANG)
    if pid == 0:
        if run.seconds < run.limit_s:
            return ""
        _kill(run.pid)
        return "timeout"
    code = os.waitstatus_to_exitcode(raw)
    if code == 0:
        return "survived"
    # 5 is pytest's for no tests. Any other code or signal is the change's doing, as the unchanged code passed.
    return "broken" if code in (5, 98, 99) else "killed"


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


def _durations(slots: list[Slot], mutants: list[Mutant], cache: Path) -> dict[str, float]:
    """Seconds that each file of tests takes on the unchanged code, which must pass; those in `cache` are not run."""
    seconds: dict[str, float] = json.loads(cache.read_text(encoding="utf-8")) if cache.is_file() else {}
    files = sorted({file for m in mutants for file in files_with_tests(m.path, {})} - set(seconds))
    for run, status in run_all(slots, [Run(None, (file,), BASELINE_LIMIT_S) for file in files]):
        if status != "survived":
            sys.exit(f"{run.tests[0]} does not pass on the unchanged code")
        seconds[run.tests[0]] = run.seconds
        cache.write_text(json.dumps(seconds), encoding="utf-8")
        print(f"unchanged  {run.seconds:5.1f} s {run.tests[0]}", flush=True)
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
    with tempfile.TemporaryDirectory(prefix="agalign-mutation-") as folder:
        copies = [Slot(Path(folder).resolve() / name / "agalign") for name in ("0", "1", "mypy")]
        slots, for_mypy = copies[:2], copies[2]
        durations = _durations(slots, todo, asked.results.with_suffix(".durations.json"))
        runs = []
        for m in todo:
            tests = files_with_tests(m.path, durations, asked.max_test_seconds)
            runs.append(Run(m, tests, TIMEOUT_FACTOR * sum(durations[f] for f in tests) + TIMEOUT_S))
        for number, (run, status) in enumerate(run_all(slots, runs), start=1):
            seconds, m = round(run.seconds, 1), run.mutant
            assert m is not None
            if status == "survived" and asked.mypy:
                status = for_mypy.status_by_mypy(m)
            results[m.key] = Result(m.key, m.path, m.line, m.operator, m.diff, status, seconds)
            with asked.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(results[m.key])) + "\n")
            print(f"{number}/{len(runs)} {status:9} {seconds:5.1f} s {m.path}:{m.line}", flush=True)
    _print_table([results[m.key] for m in mutants])


if __name__ == "__main__":
    main()
