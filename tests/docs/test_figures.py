"""Measured figures that pages quote are those of docs/figures/figures.csv, and these are those of the benchmarks.

Tables between comments are generated from that file (`tools/pages.py`). Elsewhere a figure may be followed by a comment
with its fact: `0.050<!-- accuracy / RedEdge-M, row crop / median error --> px`. Tables of the README that have the rows
and columns of a table of figures.csv are compared without comments.
"""

import re
from functools import cache
from pathlib import Path

from bands.results import comparison, read_results
from bands.run import RESULTS
from bands.score import read_sets
from figures_csv import HEAD, is_current, read_figures

from .blocks import ROOT, each_page

MARKED = re.compile(r"([\d.,]*\d)\**<!-- ([^/>]+ / [^>]+) -->")


@cache
def figures() -> dict[str, dict[str, str]]:
    """{fact: row} of the table of all figures."""
    rows = read_figures()
    assert [*rows[0]] == [*HEAD]
    assert len({row["fact"] for row in rows}) == len(rows)
    return {row["fact"]: row for row in rows}


def is_quoted(text: str, value: str) -> bool:
    """Whether a text is the value, or the value rounded to the decimals of the text."""
    text = text.replace(",", "")
    try:
        return f"{float(value):.{len(text.partition('.')[2])}f}" == text
    except ValueError:
        return text == value


def test_every_figure_has_a_unit_a_number_of_cases_and_a_command_that_exists() -> None:
    for fact, row in figures().items():
        assert len(fact.split(" / ")) == 3, fact
        assert re.match(r"[\d,]+ \w+", row["n"]), fact
        script = re.match(r"python (\S+\.py)( |$)", row["command"])
        assert script, fact
        assert (ROOT / script[1]).is_file(), fact


@each_page()
def test_marked_figures(page: Path) -> None:
    for number, fact in MARKED.findall(page.read_text(encoding="utf-8")):
        assert is_quoted(number, figures()[fact]["value"]), f"{number}: {fact}"


def test_tables_of_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    quoted = 0
    tables = re.findall(r"^(\|.+\|)\n\|[-|: ]+\|\n((?:\|.+\|\n)+)", text, re.MULTILINE)
    for head, body in tables:
        heads = [cell.strip() for cell in head.strip("|").split("|")]
        if not heads[0]:  # that of the comparison
            continue
        for row in body.splitlines():
            name, *cells = (cell.strip(" *") for cell in row.strip("|").split("|"))
            for column, cell in zip(heads[1:], cells, strict=True):
                facts = [f for f in figures() if f.split(" / ")[1:] == [name, column.partition(", ")[0]]]
                if number := re.match(r"\d+", heads[0]):  # the number of cases, as in "275 band pairs"
                    facts = [f for f in facts if figures()[f]["n"].split()[0] == number[0]]
                    assert facts, f"{heads[0]}: {name}, {column}"
                for fact in facts:
                    quoted += 1
                    assert is_quoted(cell, figures()[fact]["value"]), f"{cell}: {fact}"
    assert quoted


def test_the_comparison_of_the_readme() -> None:
    """Its columns are facts of two tables, with accepted and wrong pairs as `39 (0)`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (body,) = re.findall(r"^\| \| 45 pairs .*\n\|[-|]+\|\n((?:\|.+\|\n)+)", text, re.MULTILINE)
    for row in body.splitlines():
        name, wrong, median_px, *of_copies = (cell.strip() for cell in row.strip("|").split("|"))
        originals, degraded = "comparison, originals with tags", "drone cameras, degraded copies"
        quoted = [(wrong, f"{originals} / {name} / wrong"), (median_px, f"{originals} / {name} / median error")]
        copies, limited = of_copies
        alone, _, with_predicted = copies.partition("; with predicted ")
        for cell, facts in (
            (alone, f"{degraded} / {name}"),
            (with_predicted, f"{degraded} / {name}, with predicted"),
            (limited, f"{degraded} / {name}, with a limit"),
        ):
            assert bool(cell) == (f"{facts} / accepted" in figures()), facts
            if cell:
                accepted, of_these = re.fullmatch(r"(\d+) \(([\d-]+)\)", cell).groups()
                quoted += [(accepted, f"{facts} / accepted"), (of_these, f"{facts} / wrong")]
        for cell, fact in quoted:
            assert cell in re.split(r"[ ()]+", figures()[fact]["value"]), fact


def test_every_figure_has_the_version_that_was_measured() -> None:
    for fact, row in figures().items():
        assert re.fullmatch("[0-9a-f]{8}", row["commit"]), fact
        assert re.fullmatch("[0-9a-f]{8}", row["digest"]), fact


def test_pages_mark_figures_of_other_versions() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "explanation").glob("*.md")]
    tables = {fact.split(" / ")[0] for fact in figures()}
    shown = {name: text for name in tables for page in pages if (text := section_of(page, name))}
    assert len(shown) > 10
    for name, text in shown.items():
        rows = [row for fact, row in figures().items() if fact.startswith(f"{name} / ")]
        stale = {row["commit"] for row in rows if not is_current(name, row["digest"])}
        marked = {row["commit"] for row in rows if f"`{row['commit']}`" in text}
        assert marked == stale, f"{name}: run python tools/pages.py"


def section_of(page: str, name: str) -> str:
    """Return the table of a page between the comments with its name."""
    return page.partition(f"<!-- {name} -->")[2].partition("<!-- end of")[0]


def test_the_comparison_counts_the_results_of_the_benchmark() -> None:
    rows = [*comparison(read_results(RESULTS), read_sets())]
    assert rows
    for row in rows:
        for head, value in row.cells.items():
            found = figures()[f"{row.table} / {row.name} / {head.rpartition(', ')[0] or head}"]
            assert (found["value"] or "-", found["n"]) == (str(value), row.n)


def test_rounded_quotes() -> None:
    assert is_quoted("0.05", "0.050")
    assert is_quoted("0.1", "0.092")
    assert not is_quoted("0.06", "0.051")
    assert MARKED.findall("**74**<!-- comparison / agalign, pair / accepted --> of 74") == [
        ("74", "comparison / agalign, pair / accepted")
    ]
