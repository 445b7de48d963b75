"""Measured figures that pages quote are those of docs/figures/figures.csv, and these are those of the benchmarks.

Tables between comments are generated from that file (`tools/pages.py`). Elsewhere a figure may be followed by a comment
with its fact: `0.050<!-- accuracy / RedEdge-M, row crop / median error --> px`. Tables of the README that have the rows
and columns of a table of figures.csv are compared without comments.
"""

import csv
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from .blocks import ROOT, each_page

MARKED = re.compile(r"([\d.,]*\d)\**<!-- ([^/>]+ / [^>]+) -->")


@cache
def figures() -> dict[str, dict[str, str]]:
    """{fact: row} of the table of all figures."""
    with (ROOT / "docs" / "figures" / "figures.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [*rows[0]] == ["fact", "value", "unit", "n", "command"]
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


@pytest.mark.parametrize(
    ("table", "unpublished"), [("comparison", ""), ("comparison on published sets", "rededge_altitudes")]
)
def test_the_comparison_counts_the_results_of_the_benchmark(table: str, unpublished: str) -> None:
    totals = {name: Counter[str]() for name in ("pairs", "claimed", "wrong_claims", "good")}
    with (ROOT / "benchmarks" / "bands" / "results.csv").open(encoding="utf-8", newline="") as file:
        for row in (row for row in csv.DictReader(file) if row["set"] != unpublished):
            good = round(float(row["under_half_px"] or 0) * int(row["pairs"]))
            for name, count in totals.items():
                count[row["method"]] += good if name == "good" else int(row[name])
    columns = {"claimed": "accepted", "wrong_claims": "wrong by more than 1 px", "good": "accepted within 0.5 px"}
    methods = {fact.split(" / ")[1] for fact in figures() if fact.startswith(f"{table} / ")}
    assert len(methods) > 3
    for method in methods:
        for name, column in columns.items():
            row = figures()[f"{table} / {method} / {column}"]
            assert (row["value"], row["n"]) == (str(totals[name][method]), f"{totals['pairs'][method]} pairs")


def test_rounded_quotes() -> None:
    assert is_quoted("0.05", "0.050")
    assert is_quoted("0.1", "0.092")
    assert not is_quoted("0.06", "0.051")
    assert MARKED.findall("**220**<!-- comparison / agalign, pair / accepted --> of 275") == [
        ("220", "comparison / agalign, pair / accepted")
    ]
