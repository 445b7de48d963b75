"""Limits of the system and of containers: cores and memory."""

import math
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from agalign.errors import is_out_of_memory
from agalign.host import processes
from agalign.host.processes import cgroup_quota, limit_default_threads, memory_limit_bytes, usable_cores


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the control groups."""
    monkeypatch.setattr(processes, "_CGROUPS", tmp_path)
    monkeypatch.setattr(processes, "_OWN_CGROUP", tmp_path / "self")
    return tmp_path


def write_cgroups(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")


V1 = {"cpu/docker/ab/cpu.cfs_period_us": "100000"}


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/", {}, None),
        ("0::/", {"cpu.max": "max 100000"}, None),
        ("0::/", {"cpu.max": "150000 100000"}, 1.5),
        # The smallest quota on the way to the root counts.
        ("0::/batch/job", {"batch/job/cpu.max": "400000 100000", "batch/cpu.max": "300000 100000"}, 3.0),
        ("4:memory:/docker/other\n3:cpu,cpuacct:/docker/ab", V1 | {"cpu/docker/ab/cpu.cfs_quota_us": "-1"}, None),
        ("4:memory:/docker/other\n3:cpu,cpuacct:/docker/ab", V1 | {"cpu/docker/ab/cpu.cfs_quota_us": "50000"}, 0.5),
    ],
)
def test_quota_of_a_container(root: Path, groups: str, files: dict[str, str], expected: float | None) -> None:
    write_cgroups(root, {"self": groups, **files})
    assert cgroup_quota() == expected


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/", {"memory.max": "max"}, math.inf),
        ("0::/batch/job", {"batch/job/memory.max": "max", "batch/memory.max": "2000000000"}, 2e9),
        ("4:memory:/docker/ab", {"memory/docker/ab/memory.limit_in_bytes": "1000000000"}, 1e9),
    ],
)
def test_memory_limit_of_a_container(root: Path, groups: str, files: dict[str, str], expected: float) -> None:
    write_cgroups(root, {"self": groups, **files})
    assert memory_limit_bytes() == expected


@pytest.mark.parametrize(("quota", "expected"), [(None, 8), (2.5, 3), (0.2, 1), (64.0, 8)])
def test_a_part_of_a_core_counts_as_one(monkeypatch: pytest.MonkeyPatch, quota: float | None, expected: int) -> None:
    """It is also the number of threads of libraries where there is a quota; what the user has set stays."""
    monkeypatch.setattr(processes.sys, "platform", "linux")
    monkeypatch.setattr(processes.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(processes, "cgroup_quota", lambda: quota)
    assert usable_cores() == expected
    variables = {"OMP_NUM_THREADS": "7"}
    monkeypatch.setattr(processes.os, "environ", variables)
    limit_default_threads()
    others = {} if quota is None else dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(expected))
    assert variables == {"OMP_NUM_THREADS": "7", **others}


@pytest.mark.parametrize("text", ["can't start new thread", "could not create a primitive"])
def test_what_libraries_raise_when_memory_is_short(text: str) -> None:
    assert is_out_of_memory(RuntimeError(text))


@pytest.mark.skipif(find_spec("boto3") is None, reason="boto3 is not installed")
@pytest.mark.parametrize("module", ["agalign.batch.fork_server", "agalign.cli.main"])
def test_no_command_opens_a_socket(module: str) -> None:
    code = (
        "import importlib, os, socket, sys\n"
        "socket.socket.__init__ = lambda *_, **__: os._exit(9)\n"
        "sys.argv = ['agalign', 'report', 'nowhere']\n"
        f"module = importlib.import_module('{module}')\n"
        "if hasattr(module, 'main'): module.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == ("main" in module), done.stderr


@pytest.mark.slow
def test_only_the_fork_server_has_everything_after_an_import() -> None:
    """Workers do not copy the memory pages of what it has imported."""
    code = (
        "import gc, sys, agalign.batch.preload\n"
        "assert gc.get_freeze_count() == 0 and 'agalign.batch.run' not in sys.modules\n"
        "import agalign.batch.fork_server\n"
        "assert gc.get_freeze_count() > 100_000 and 'agalign.batch.run' in sys.modules and gc.isenabled()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
