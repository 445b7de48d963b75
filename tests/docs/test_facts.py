"""Facts that pages state are those of the program: messages, options, exit codes, events, stages, limits, paths."""

import ast
import importlib
import inspect
import operator
import re
import signal
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from agalign.batch.products import PRODUCTS
from agalign.capture import common_parallax, reference
from agalign.cli.main import COMMANDS
from agalign.cli.terminal import ExitCode
from agalign.fit import dense, displacement_field, windows
from agalign.flight import panel_readings
from agalign.host.files import INDICES_FILE
from agalign.method import refine
from agalign.pixels import masks, raster
from agalign.rasters.parallax_file import PARALLAX_KIND
from agalign.records.sidecar import FilePart
from agalign.report.summary_csv import SUMMARY_COLUMNS
from agalign.spectral_indices.indices_csv import update_table
from agalign.spectral_indices.rasters import IndexReport
from agalign.values.alignment import MIN_RETRIEVAL, MIN_TIMES_CHANCE
from agalign.verify import checks

from ..program import agalign_here
from .blocks import PAGES, ROOT, each_page, text_of

PACKAGE = ROOT / "agalign"
OPTIONS_OF_OTHERS = {
    *("--cpus", "--gpus", "--memory", "--read-only", "--tmpfs", "--user"),  # docker run
    *("--data", "--faults", "--floor", "--grids", "--kills", "--kinds", "--pairs", "--plot"),  # benchmarks
    *("--ranges", "--scenes", "--size"),
    *("--extra-index-url", "--index-url", "--strict"),  # pip, mypy
    *("--radiometric-calibration", "--tags"),  # OpenDroneMap, rio info
}
"""Options in the text of pages that are not those of agalign."""
WORDS_OF_A_MESSAGE = 4
"""Code of as many words is a quoted message, if it is none of these."""
NOT_A_MESSAGE = re.compile(r"(agalign|python3?|pip|rio|docker|grep|sphinx-build|if __name__) |--|x ↦")


def code_in(page: Path) -> list[str]:
    """The code in the text of a page."""
    return re.findall(r"`([^`]+)`", re.sub(r"\s+", " ", text_of(page)))


EXIT_CODES = "reference/exit-codes.md"


def table(page: str, head: str) -> list[list[str]]:
    """The cells of the rows of the table with the head that begins so."""
    rows = text_of(ROOT / "docs" / page).partition(f"\n| {head} |")[2].partition("\n\n")[0].splitlines()[2:]
    assert rows, f"{page}: has no table '{head}'"
    return [[cell.strip() for cell in row.strip("| ").split(" | ")] for row in rows]


def template(text: str) -> str:
    """A text with a placeholder for each quoted name, number, field and dots, which differ between messages."""
    text = re.sub(r"\{[^{}]*\}|'[^']*'|\d[\d.,]*|…", "\0", text)
    return re.sub("\0%?", "\0", " ".join(text.split()))


@cache
def strings_of_the_program() -> tuple[str, ...]:
    """The templates of all texts in the package."""
    parts: list[str] = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts.append("".join(v.value if isinstance(v, ast.Constant) else "{}" for v in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                parts.append(node.value)
    return tuple(map(template, parts))


@each_page()
def test_quoted_messages_are_printed_by_the_program(page: Path) -> None:
    for code in code_in(page):
        if len(code.split()) >= WORDS_OF_A_MESSAGE and not NOT_A_MESSAGE.match(code):
            # `FILE: reason` begins with a name.
            message = template(code.removeprefix("FILE: "))
            assert any(message in text for text in strings_of_the_program()), code


@cache
def options_of_the_program() -> frozenset[str]:
    helps = (agalign_here(*command, "--help").stdout for command in ([], *([c] for c in COMMANDS)))
    return frozenset(re.findall(r"--[a-z][\w-]+", "".join(helps)))


@each_page()
def test_options_in_the_text_exist(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    named = set(re.findall(r"(?<![\w-])--[a-z][\w-]+", text_of(page)))
    assert named <= options_of_the_program() | OPTIONS_OF_OTHERS


def test_exit_codes() -> None:
    signals = {int(ExitCode.SIGNAL + n) for n in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    codes = {int(c) for c in ExitCode if c is not ExitCode.SIGNAL} | signals
    listed = {int(code) for codes_of_a_row, _ in table(EXIT_CODES, "exit code") for code in codes_of_a_row.split(", ")}
    assert listed == codes
    for page in PAGES:
        named = re.findall(r"exit code[s]? (\d+)", text_of(page), re.IGNORECASE)
        assert set(map(int, named)) <= codes, page


def calls(module: str, function: str) -> Iterator[ast.Call]:
    """The calls of a function or method of this name in a module."""
    for node in ast.walk(ast.parse((PACKAGE / module).read_text(encoding="utf-8"))):
        name = getattr(node.func, "attr", getattr(node.func, "id", "")) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and name == function:
            yield node


def listed_events() -> dict[str, str]:
    """The fields of each event, as the page states them."""
    entries = re.findall(r"^\* (`.*?): (.+(?:\n  .+)*)", text_of(ROOT / "docs" / EXIT_CODES), re.MULTILINE)
    return {event: text for events, text in entries for event in re.findall(r"`(\w+)`", events)}


def test_events_of_all_commands_and_their_fields() -> None:
    fields: dict[str, set[str]] = {}
    modules = [str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")]
    for module in modules:
        events = [(call.args[0], call) for call in calls(module, "event")]
        events += [(ast.Constant("problem"), call) for call in calls(module, "problem") if call.keywords]
        for name, call in events:
            if isinstance(name, ast.Constant):
                names = {k.arg for k in call.keywords if k.arg is not None}
                fields.setdefault(str(name.value), set()).update(names)
    listed = {event: set(re.findall(r"`(\w+)`", text)) for event, text in listed_events().items()}
    assert set(listed) == {*fields, "panel", "sky"}  # these two have their names from a loop
    for event, names in fields.items():
        assert names <= listed[event], event


def test_stages_of_a_capture() -> None:
    stages = set()
    paths = *(PACKAGE / "capture").glob("*.py"), *(PACKAGE / "method").glob("*.py"), PACKAGE / "batch/capture_task.py"
    for path in paths:
        for name in ("progress", "report"):
            for call in calls(str(path.relative_to(PACKAGE)), name):
                stages |= {str(a.value) for a in call.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    listed = listed_events()["stage"].partition("`stage` (")[2].partition(")")[0]
    assert set(re.findall(r"`(\w+)`", listed)) == stages - {""}


LIMITS = {
    "explanation/method.md": (
        f"narrower than {masks._MIN_SATURATED_PX} px are not masked",
        f"standard deviation of {displacement_field._NOISE_PX / displacement_field._SMOOTHNESS**0.5:.2f} px",
        f"by more than {refine._FINAL_CONVERGED_PX:g} px",
        f"the p95 of the windows' parallax is at least {common_parallax.MIN_PARALLAX_PX:g} px",
        f"nodes every {displacement_field._LATTICE_PX} px",
        f"fitted to windows of {displacement_field._FIELD_WINDOW_PX} px",
        f"Images above {reference.LONGEST_SIDE_PX} px",
        f"fewer than {reference.COARSE_RATIO:g} pixels per reference pixel",
    ),
    "explanation/verification.md": (
        f"| at least {MIN_RETRIEVAL:g}, and {MIN_TIMES_CHANCE:g} times chance |",
        f"at most {checks._MAX_ERROR_PX:g} px in {checks._MIN_ACCURATE_SHARE:.0%} of the common area",
        f"Their side is at most {windows._WINDOW_PX} px, and {windows.LARGE_WINDOW_PX} px in blurred images",
        f"| at least {checks._MIN_COMMON_COVERAGE:.0%} |",
        f"| at least {checks._MIN_CLOSE_SHARE:.0%} |",
        f"| fewer than {checks._MIN_CLUSTER}, or fewer than {checks._MAX_CLUSTER_SHARE:.0%} of the windows |",
        f"| at most {checks.MAX_ALIAS_PEAK:.0%} of the first",
        f"| at most the larger of {checks.MAX_UNEXPECTED_PX:g} px and {checks._MAX_UNEXPECTED_STD:g} standard errors",
        f"{raster._MAX_BANDS} bands per file",
    ),
    "how-to/close-range.md": (
        f"parallax of up to {dense._SEARCH_NEARER:.0%} of",
        f"and {dense._SEARCH_FARTHER:.0%} behind it",
        f"1 / (1 / d + {dense._SEARCH_NEARER:g} W / (f b))",
    ),
    "how-to/reflectance.md": (f"calibration panels at most {panel_readings.MAX_LIGHT_APART_S / 3600:g} hours away",),
}
"""{page: sentences with a limit of the program}."""


@pytest.mark.parametrize("page", LIMITS)
def test_limits(page: str) -> None:
    text = re.sub(r"[\s*]+", " ", text_of(ROOT / "docs" / page))
    assert [limit for limit in LIMITS[page] if limit not in text] == []


@each_page()
def test_files_in_the_text_exist(page: Path) -> None:
    for code in code_in(page):
        if re.fullmatch(r"[a-z_./]+/\w+\.(py|sh|j2|js)", code):
            assert any((folder / code).is_file() for folder in (ROOT, PACKAGE)), code


def test_equations_of_the_paper() -> None:
    """Each name in the table is in the module before it, and its docstring names the equation of its row."""
    names = []
    for row in table("explanation/paper.md", "the paper"):
        equations, module = re.findall(r"Eq\. \d+", row[0]), None
        for code in re.findall(r"`([^`]+)`", row[1]):
            if code.endswith(".py"):
                module = importlib.import_module(f"agalign.{code.removesuffix('.py').replace('/', '.')}")
                continue
            value = operator.attrgetter(code.partition("(")[0])(module)
            assert not equations or equations[0] in (inspect.getdoc(value) or ""), code
            names.append(code)
    assert {"contrastive_loss", "descend", "bilinear", "match_seed", "Level.draw"} <= set(names)


def test_extras() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    listed = text_of(ROOT / "docs/tutorial/install.md").partition("\nExtras (MB):\n\n")[2].partition("\n\n")[0]
    names_of_entries = [re.split("[(:]", entry)[0] for entry in listed.splitlines()]
    assert {name for names in names_of_entries for name in re.findall(r"`(\w+)`", names)} == set(extras)
    commands = re.findall(r"pip install '?\.\[([\w,]+)\]", "".join(page.read_text(encoding="utf-8") for page in PAGES))
    assert commands
    assert {name for names in commands for name in names.split(",")} <= set(extras)


def columns(page: str, heading: str) -> set[str]:
    """The names in the first column of the first table below a heading."""
    below = text_of(ROOT / "docs" / page).partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return set(re.findall(r"`(\w+)`", " ".join(line.split("|")[1] for line in below.splitlines() if line[:2] == "| ")))


def test_columns_of_the_tables_that_a_run_writes(tmp_path: Path) -> None:
    assert columns("reference/outputs.md", "summary.csv") == set(SUMMARY_COLUMNS)
    update_table(tmp_path, [IndexReport("a", "ndvi")], [])
    head = (tmp_path / INDICES_FILE).read_text(encoding="utf-8-sig").splitlines()[0]
    assert columns("reference/outputs.md", "indices.csv") == set(head.split(","))


def test_kinds_of_products() -> None:
    listed = re.findall(r"`(\w+)`", FilePart.model_fields["kind"].description or "")
    assert set(listed) == {PARALLAX_KIND, *(p.kind for p in PRODUCTS)}


def test_the_tables_of_places_name_what_their_modules_define() -> None:
    section = text_of(ROOT / "CONTRIBUTING.md").partition("\n## Where to find what\n")[2].partition("\n## ")[0]
    places = section.partition("\nOwn implementations")[0]
    rows = [
        line for line in places.splitlines() if line.startswith("|") and not line.startswith(("| question |", "|-"))
    ]
    min_rows = 150
    assert len(rows) > min_rows
    for row in rows:
        _, modules, names = (re.findall(r"`([^`]+)`", cell) for cell in row[2:-2].split(" | "))
        text = "\n".join((ROOT / "agalign" / module).read_text(encoding="utf-8") for module in modules)
        defined = r"^\s*(?:def|class|function) {0}\b|^\s*(?:[A-Za-z_, ]*\b)?{0}\b[^=\n(]*="
        assert text, row
        assert [name for name in names if not re.search(defined.format(name), text, re.MULTILINE)] == [], row
