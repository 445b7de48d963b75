"""A benchmark with --figures replaces its rows in docs/figures/figures.csv, and no others."""

import ast
import re
from pathlib import Path

import pytest
from figures_csv import (
    ESTIMATOR,
    HEAD,
    ROOT,
    Provenance,
    TableRow,
    command_line,
    digest_of,
    is_current,
    read_figures,
    write_figures,
)
from remeasure import argv_of, changes

SCRIPT = str(ROOT / "benchmarks" / "accuracy.py")
OLD = """fact,value,unit,n,command,commit,digest
a / x / first,1,,2 pairs,python other.py,c0ffee,0
accuracy / row / aligned,1,,2 pairs,python benchmarks/accuracy.py DATA,c0ffee,0
"accuracy / row / median error, reference",0.5,px,2 pairs,python benchmarks/accuracy.py DATA,c0ffee,0
accuracy / gone / aligned,1,,2 pairs,python benchmarks/accuracy.py DATA,c0ffee,0
a / y / last,1,,2 pairs,python other.py,c0ffee,0
accuracy / moved / aligned,1,,2 pairs,python benchmarks/accuracy.py --short,c0ffee,0
"""


def test_rows_of_the_command_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that another command wrote. Others keep their place, and replaced ones their order."""
    path = tmp_path / "figures.csv"
    path.write_text(OLD)
    monkeypatch.setattr("sys.argv", [SCRIPT, f"{tmp_path}/", "--figures"])
    row = TableRow("accuracy", "row", "3 pairs", {"aligned": 2, "median error, reference, px": "0.25", "wrong": 0})
    moved = TableRow("accuracy", "moved", "1 pairs", {"aligned": "-"})
    write_figures([moved, row], "DATA", [tmp_path], path=path)
    now = Provenance.of("accuracy")
    command = f"python benchmarks/accuracy.py DATA,{now.commit},{now.digest}"
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
    row = TableRow("b", "z", "1 run", {"run, s": 3}, Provenance("abc", "1"))
    write_figures([row], command="python new.py", path=path)
    assert path.read_text() == OLD + "b / z / run,3,s,1 run,python new.py,abc,1\n"


def test_the_command_is_without_the_option_and_the_paths_of_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    monkeypatch.setattr("sys.argv", [SCRIPT, *map(str, folders), "two headings", "--figures", "--pairs", "2", "2"])
    command = command_line("DATA/", folders)
    assert command == 'python benchmarks/accuracy.py DATA/a DATA/b "two headings" --pairs 2 2'
    for folder in folders:
        folder.mkdir()
    script, *words = argv_of(command, tmp_path)[1:]
    assert (script, words) == ("benchmarks/accuracy.py", [*map(str, folders), "two headings", "--pairs", "2", "2"])


def test_figures_are_current_only_by_the_code_that_made_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ESTIMATOR:
        path = tmp_path / "agalign" / name
        (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
        (path if path.suffix else path / "module.py").write_text("first\n")
    monkeypatch.setattr("figures_csv.ROOT", tmp_path)
    digest_of.cache_clear()
    before = digest_of(ESTIMATOR)
    assert is_current("accuracy", before)
    (tmp_path / "agalign" / "fit" / "module.py").write_text("second\n")
    digest_of.cache_clear()
    assert not is_current("accuracy", before)
    monkeypatch.undo()
    digest_of.cache_clear()


def test_values_that_changed_appeared_or_went_are_printed() -> None:
    old, new = {"same": "1", "other": "2", "gone": "3"}, {"same": "1", "other": "4", "added": "5"}
    assert [*changes(old, new)] == [("same", "1", "1"), ("other", "2", "4"), ("gone", "3", "-"), ("added", "-", "5")]


def test_each_command_of_the_table_is_a_script_with_the_option() -> None:
    scripts = {re.split(r"\s+", row["command"])[1] for row in read_figures()}
    assert len(scripts) > 10
    for script in scripts:
        module = ast.parse((ROOT / script).read_text(encoding="utf-8"))
        (main,) = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == "main"]
        options = {one.arg: ast.unparse(one.annotation) for one in main.args.kwonlyargs if one.annotation}
        assert options.get("figures") == "FiguresOption", script
        calls = [ast.unparse(node.func) for node in ast.walk(main) if isinstance(node, ast.Call)]
        assert {"write_figures", "end_check"} & set(calls), script
