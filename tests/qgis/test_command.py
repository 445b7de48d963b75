"""The part of the QGIS plugin that runs the command line, without QGIS; and all of it where there is one."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from agalign._version import __version__
from agalign.host.processes import is_running

ROOT = Path(__file__).resolve().parents[2]
PLUGIN = ROOT / "qgis" / "agalign_provider"
HAS_QGIS = shutil.which("qgis_process.bin") or shutil.which("qgis_process")


spec = importlib.util.spec_from_file_location("agalign_provider_command", PLUGIN / "command.py")
command = importlib.util.module_from_spec(spec)
spec.loader.exec_module(command)


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return path


def test_only_readable_sidecars_are_listed(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"schema": "agalign/1", "status": "ok"}')
    (tmp_path / "b.json").write_text("[" * 100_000)
    os.mkfifo(tmp_path / "c.json")
    assert [path.name for path, _ in command.sidecars_below(tmp_path)] == ["a.json"]


def test_events_that_the_plugin_shows_are_those_of_the_program() -> None:
    listener = (PLUGIN / "algorithms.py").read_text(encoding="utf-8").partition("def on_event")[2].partition("def ")[0]
    shown = set(re.findall(r'kind == "(\w+)"', listener))
    program = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "agalign" / "cli").glob("*.py"))
    assert "found" in shown
    assert shown - {"text"} <= set(re.findall(r'event\(\s*"(\w+)"', program))  # `text`: lines that are not events


def test_executable_of_the_setting_or_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = script(tmp_path / "venv" / "bin" / "agalign", "")
    assert command.find_executable(str(there)) == str(there)
    assert command.find_executable(str(tmp_path / "venv")) == str(there)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("VIRTUAL_ENV", str(tmp_path / "venv"))
    assert command.find_executable() == str(there)
    monkeypatch.delenv("VIRTUAL_ENV")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python3"))
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(command.CommandError, match="pipx install PATH, with the path of a checkout"):
        command.find_executable()
    with pytest.raises(command.CommandError, match="no executable"):
        command.find_executable(str(tmp_path / "nowhere"))


def test_events_arrive_and_variables_of_qgis_do_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/qgis/python")
    monkeypatch.setenv("PROJ_LIB", "/qgis/proj")
    text = """
import json, os, sys
print(json.dumps({"event": "found", "captures": 2}), file=sys.stderr)
print("not JSON", file=sys.stderr)
print(json.dumps([os.environ.get("PYTHONPATH"), os.environ.get("PROJ_LIB"), sys.argv[1]]))
raise SystemExit(3)
"""
    events: list[dict[str, object]] = []
    run = command.Command([script(tmp_path / "a", text), "one two"], lambda: False, events.append)
    assert run.run() == 3
    assert events == [{"event": "found", "captures": 2}, {"event": "text", "message": "not JSON"}]
    assert run.output.strip() == '[null, null, "one two"]'


def test_a_failure_is_the_last_problem_in_words(tmp_path: Path) -> None:
    text = 'import sys; print(\'{"event": "problem", "message": "flight: no image"}\', file=sys.stderr); sys.exit(1)'
    with pytest.raises(command.CommandError, match="agalign: flight: no image"):
        command.Command([script(tmp_path / "a", text)], lambda: False, lambda _: None).run()
    with pytest.raises(command.CommandError, match="cannot be started"):
        command.Command([tmp_path / "nothing"], lambda: False, lambda _: None).run()


@pytest.mark.skipif(os.name == "nt", reason="process groups of POSIX")
def test_cancelling_ends_the_process_and_its_workers(tmp_path: Path) -> None:
    text = f"""
import subprocess, sys, time
worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
open({str(tmp_path / "pid")!r}, "w").write(str(worker.pid))
time.sleep(3600)
"""
    pid = tmp_path / "pid"
    run = command.Command(
        [script(tmp_path / "a", text)], lambda: pid.is_file() and bool(pid.read_text()), lambda _: None
    )
    assert run.run() is None
    while is_running(int(pid.read_text())):
        time.sleep(0.1)


def test_the_zip_holds_the_plugin_of_this_version(tmp_path: Path) -> None:
    archive = tmp_path / "plugin.zip"
    subprocess.run([ROOT / "tools" / "qgis_plugin.sh", archive], check=True, capture_output=True)
    shutil.unpack_archive(archive, tmp_path / "out")
    names = {p.name for p in (tmp_path / "out" / "agalign_provider").iterdir()}
    assert names == {p.name for p in PLUGIN.iterdir() if p.is_file()} | {"LICENSE"}
    assert f"version={__version__}\n" in (tmp_path / "out" / "agalign_provider" / "metadata.txt").read_text()


@pytest.mark.slow
@pytest.mark.skipif(not HAS_QGIS or not os.environ.get("AGALIGN_QGIS"), reason="set AGALIGN_QGIS=1 where QGIS is there")
def test_every_algorithm_runs_in_qgis(tmp_path: Path) -> None:
    agalign = script(
        tmp_path / "agalign",
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); from agalign.__main__ import main; sys.exit(main())",
    )
    done = subprocess.run(
        [ROOT / "tests" / "qgis" / "run_algorithms.sh", agalign, tmp_path / "run"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
