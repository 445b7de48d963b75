"""A benchmark with --figures replaces its rows in docs/figures/figures.csv, and no others."""

import ast
import csv
import re
from pathlib import Path

import pytest
from figures_csv import FIGURES, HEAD, ROOT, TableRow, command_line, write_figures

SCRIPT = str(ROOT / "benchmarks" / "accuracy.py")
OLD = """fact,value,unit,n,command
a / x / first,1,,2 pairs,python other.py
accuracy / row / aligned,1,,2 pairs,python benchmarks/accuracy.py DATA
"accuracy / row / median error, reference",0.5,px,2 pairs,python benchmarks/accuracy.py DATA
accuracy / gone / aligned,1,,2 pairs,python benchmarks/accuracy.py DATA
a / y / last,1,,2 pairs,python other.py
accuracy / moved / aligned,1,,2 pairs,python benchmarks/accuracy.py --short
"""


def test_rows_of_the_command_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that another command wrote. Others keep their place, and replaced ones their order."""
    path = tmp_path / "figures.csv"
    path.write_text(OLD)
    monkeypatch.setattr("sys.argv", [SCRIPT, f"{tmp_path}/", "--figures"])
    row = TableRow("accuracy", "row", "3 pairs", {"aligned": 2, "median error, reference, px": "0.25", "wrong": 0})
    moved = TableRow("accuracy", "moved", "1 pairs", {"aligned": "-"})
    write_figures([moved, row], "DATA", [tmp_path], path=path)
    command = "python benchmarks/accuracy.py DATA"
    first, *_, last, _ = OLD.splitlines(keepends=True)[1:]
    assert path.read_text() == (
        f"{','.join(HEAD)}\n"
        f"{first}"
        f"accuracy / row / aligned,2,,3 pairs,{command}\n"
        f'"accuracy / row / median error, reference",0.25,px,3 pairs,{command}\n'
        f"accuracy / moved / aligned,,,1 pairs,{command}\n"
        f"accuracy / row / wrong,0,,3 pairs,{command}\n"
        f"{last}"
    )


def test_rows_of_a_new_command_are_added(tmp_path: Path) -> None:
    path = tmp_path / "figures.csv"
    path.write_text(OLD)
    write_figures([TableRow("b", "z", "1 run", {"run, s": 3})], command="python new.py", path=path)
    assert path.read_text() == OLD + "b / z / run,3,s,1 run,python new.py\n"


def test_the_command_is_without_the_option_and_the_paths_of_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    monkeypatch.setattr("sys.argv", [SCRIPT, *map(str, folders), "two headings", "--figures", "--pairs", "2", "2"])
    expected = 'python benchmarks/accuracy.py FLIGHT... "two headings" --pairs 2 2'
    assert command_line("FLIGHT...", folders) == expected


def test_each_command_of_the_table_is_a_script_with_the_option() -> None:
    with FIGURES.open(encoding="utf-8", newline="") as file:
        scripts = {re.split(r"\s+", row["command"])[1] for row in csv.DictReader(file)}
    assert len(scripts) > 10
    for script in scripts:
        module = ast.parse((ROOT / script).read_text(encoding="utf-8"))
        (main,) = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == "main"]
        options = {one.arg: ast.unparse(one.annotation) for one in main.args.kwonlyargs if one.annotation}
        assert options.get("figures") == "FiguresOption", script
        calls = [ast.unparse(node.func) for node in ast.walk(main) if isinstance(node, ast.Call)]
        assert "write_figures" in calls, script
