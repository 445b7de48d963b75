"""What other systems do otherwise, as far as it can be seen on this one."""

import subprocess
import sys
from pathlib import Path

import pytest

from agalign.batch.capture import Task, start_worker
from agalign.batch.run import Listener, capture_reports
from agalign.batch.workers import own_processes
from agalign.cameras.discover import discover
from agalign.config import SeedSettings, Settings
from agalign.values import processes

ENCODINGS_SAID = """
import sys, warnings
warnings.filterwarnings("ignore", category=EncodingWarning)  # of libraries
warnings.filterwarnings("error", category=EncodingWarning, module="agalign")
from agalign.__main__ import main
sys.argv[0] = "agalign"
main()
"""


@pytest.mark.slow
def test_every_text_is_read_and_written_in_an_encoding_that_is_said(flight: Path, tmp_path: Path) -> None:
    """Where none is said it is the system's, which on Windows is not UTF-8."""
    options = ["--only-seed", "--layout", "both", "--error-map", "--stac"]
    for arguments in (["align", str(flight), "-o", str(tmp_path), *options], ["report", str(tmp_path)]):
        command = [sys.executable, "-X", "warn_default_encoding", "-c", ENCODINGS_SAID, *arguments]
        done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
        assert "EncodingWarning" not in done.stderr
        assert done.returncode in (0, 3), done.stderr


@pytest.mark.slow
def test_processes_that_start_from_nothing(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they do on Windows and macOS: nothing of this process is there in them."""
    monkeypatch.setattr(processes, "get_all_start_methods", lambda: ["spawn"])
    tasks = [Task(c, tmp_path, Settings(seed=SeedSettings(only=True)), None) for c in discover(flight).captures]
    with own_processes(2, start_worker) as run:
        assert [r.state for r in capture_reports(run, tasks, Listener(), None)] == ["done"] * len(tasks)
