"""Measure which faults the tests detect: change the code in small ways and see whether a test fails.

    pip install "mutmut>=3.8,<4"
    python tools/mutation.py [--count 300] [--seed 0] [--packages verify,capture,flight,values]

The mutants are a random sample of those that mutmut's operators make, one place at a time. Each one runs the tests of
its package, first the file named after its module, then those of the callers, and stops at the first failure. The work
tree is not touched: two copies of it in a temporary folder take the mutants in turn. Not changed: annotations,
decorators, type aliases, docstrings, prose (strings with a space), log messages, imports, `__all__`, and `strict=` of
zip, which only asserts.
"""

import difflib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from queue import Queue

import typer

try:
    import libcst as cst
    from mutmut.mutation.mutators import mutation_operators
except ImportError:
    sys.exit('mutmut is not installed: pip install "mutmut>=3.8,<4"')

ROOT = Path(__file__).resolve().parents[1]
CALLERS = "batch", "cameras", "capture", "flight", "pixels", "test_api.py", "records/test_sidecar.py"
"""Tests of the callers, relative to tests/."""
NOT_COPIED = (".git", ".*_cache", "__pycache__", ".hypothesis", ".venv", "build", "dist", "site", "*.egg-info")
TIMEOUT_S = 600.0
"""A mutant is detected if its tests take longer than this."""
STRICT = re.compile(r",\s*strict=\w+")
TESTS = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-m", "not real and not full"]


@dataclass(frozen=True)
class Mutant:
    """One changed line of a module; `source` is the whole changed module."""

    path: str
    line: int
    operator: str
    diff: str
    source: str


# ---- mutants


def changes_in(node: cst.CSTNode) -> Iterator[tuple[cst.CSTNode, cst.CSTNode, str]]:
    """Yield (node, changed node, name of the operator) of a node and those below it."""
    if _is_skipped(node):
        return
    for kind, operator in mutation_operators:
        if isinstance(node, kind):
            for changed in operator(node):
                yield node, changed, operator.__name__.removeprefix("operator_")
    for child in node.children:
        yield from changes_in(child)


def _is_skipped(node: cst.CSTNode) -> bool:
    match node:
        case cst.Annotation() | cst.Decorator() | cst.Import() | cst.ImportFrom() | cst.TypeAlias():
            return True
        case cst.SimpleString():
            return " " in node.value or node.value.startswith(('"""', "'''"))
        case cst.Call(func=cst.Attribute(value=cst.Name(value="_LOG"))):
            return True
        case cst.Call(func=cst.Name(value="NewType" | "TypeVar" | "cast")):
            return True
        case cst.Assign(targets=[cst.AssignTarget(target=cst.Name(value=name))]):
            bare = name.strip("_")  # CamelCase is a type alias
            return name == "__all__" or (bare[:1].isupper() and not bare.isupper())
    return False


def mutants_of(packages: list[str], seed: int) -> Iterator[Mutant]:
    """Yield the mutants of all modules that compile, in random order."""
    candidates = []
    for path in sorted(p for name in packages for p in (ROOT / "agalign" / name).rglob("*.py")):
        module = cst.parse_module(path.read_text(encoding="utf-8"))
        candidates += [(path, module, *change) for change in changes_in(module)]
    random.Random(seed).shuffle(candidates)
    for path, module, old, new, operator in candidates:
        try:
            source = cst.ensure_type(module.deep_replace(old, new), cst.Module).code
            compile(source, path.name, "exec", dont_inherit=True)
        except (SyntaxError, cst.CSTValidationError, TypeError):
            continue  # for example a positional argument that now follows a keyword
        if STRICT.sub("", source) == STRICT.sub("", module.code):
            continue
        _, _, place, *changed = difflib.unified_diff(module.code.splitlines(), source.splitlines(), n=0, lineterm="")
        line = int(re.findall(r"\d+", place)[0])
        yield Mutant(path.relative_to(ROOT).as_posix(), line, operator, "\n".join(changed), source)


# ---- tests


def files_with_tests(path: str) -> list[str]:
    """The tests of a module, relative to the root: the file named after it first, those of the callers last."""
    package, own = Path(path).parts[1], f"test_{Path(path).name}"
    files = sorted((ROOT / "tests" / package).glob("test_*.py"), key=lambda file: file.name != own)
    callers = [f"tests/{name}" for name in CALLERS if name != package]
    return [*(file.relative_to(ROOT).as_posix() for file in files), *callers]


def is_detected(mutant: Mutant, copies: "Queue[Path]") -> bool:
    """Put a mutant into one of the copies and run its tests."""
    copy = copies.get()
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    argv = [sys.executable, "-m", "pytest", *TESTS, *files_with_tests(mutant.path)]
    unchanged = (copy / mutant.path).read_bytes()
    try:
        (copy / mutant.path).write_text(mutant.source, encoding="utf-8")
        done = subprocess.run(argv, cwd=copy, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return True
    finally:
        (copy / mutant.path).write_bytes(unchanged)
        copies.put(copy)
    return done.returncode != 0


def main(count: int = 300, seed: int = 0, packages: str = "verify,capture,flight,values") -> None:
    mutants = list(islice(mutants_of(packages.split(","), seed), count))
    tried, detected = Counter[str](), Counter[str]()
    copies: Queue[Path] = Queue()
    with tempfile.TemporaryDirectory(prefix="agalign-mutation-") as folder, ThreadPoolExecutor(2) as pool:
        for name in ("0", "1"):
            copy = Path(folder).resolve() / name / "agalign"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*NOT_COPIED))
            copies.put(copy)
        for m in {Path(m.path).parts[1]: m for m in mutants}.values():
            if is_detected(replace(m, source=(ROOT / m.path).read_text(encoding="utf-8")), copies):
                sys.exit(f"the tests of {m.path} do not pass on the unchanged code")
        results = pool.map(is_detected, mutants, [copies] * len(mutants))
        for number, (m, killed) in enumerate(zip(mutants, results, strict=True), start=1):
            status = "detected" if killed else f"survived\n{m.diff}"
            print(f"{number}/{len(mutants)} {m.path}:{m.line} {status}", flush=True)
            for group in (Path(m.path).parts[1], m.operator, "all"):
                tried[group] += 1
                detected[group] += killed
    for group in sorted(tried):
        print(f"{group:24} {detected[group]:5} of {tried[group]:5}, {detected[group] / tried[group]:.1%}")


if __name__ == "__main__":
    typer.run(main)
