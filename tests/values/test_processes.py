"""Limits of the system and of containers: cores, memory and address space."""

import math
import platform
import re
import subprocess
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest

from agalign.errors import ConfigurationError, is_out_of_memory
from agalign.values import processes
from agalign.values.processes import (
    cgroup_quota,
    check_threads,
    limit_default_threads,
    memory_limit_bytes,
    usable_cores,
)

from ..conftest import raising
from ..program import agalign_here


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
def test_quota_of_a_container(tmp_path: Path, groups: str, files: dict[str, str], expected: float | None) -> None:
    write_cgroups(tmp_path, {"self": groups, **files})
    assert cgroup_quota(tmp_path, tmp_path / "self") == expected


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/", {"memory.max": "max"}, math.inf),
        ("0::/batch/job", {"batch/job/memory.max": "max", "batch/memory.max": "2000000000"}, 2e9),
        ("4:memory:/docker/ab", {"memory/docker/ab/memory.limit_in_bytes": "1000000000"}, 1e9),
    ],
)
def test_memory_limit_of_a_container(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: str, files: dict[str, str], expected: float
) -> None:
    write_cgroups(tmp_path, {"self": groups, **files})
    monkeypatch.setattr(processes, "_address_space_bytes", lambda: math.inf)
    assert memory_limit_bytes(tmp_path, tmp_path / "self") == expected
    monkeypatch.setattr(processes, "_address_space_bytes", lambda: 5e8)
    assert memory_limit_bytes(tmp_path, tmp_path / "self") == 5e8


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


# ---- address space


resource = pytest.importorskip("resource", reason="address space is limited on POSIX only")


def test_no_threads_are_started_to_check_their_number_in_a_small_address_space(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2_000_000_000, 2_000_000_000))
    monkeypatch.setattr(threading.Thread, "start", raising(RuntimeError()))
    check_threads()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc reserves a heap for each thread")
def test_a_thread_reserves_no_heap_in_a_limited_address_space() -> None:
    program = """if True:
        import resource, threading
        from pathlib import Path
        from agalign.values.processes import check_address_space

        def reserved_mb():
            return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() / 1e6

        resource.setrlimit(resource.RLIMIT_AS, (2_000_000_000, 2_000_000_000))
        check_address_space()
        before_mb = reserved_mb()
        thread = threading.Thread(target=bytearray, args=(2000,))
        thread.start()
        thread.join()
        print(reserved_mb() - before_mb)
    """
    assert float(subprocess.check_output([sys.executable, "-c", program])) < 60


@pytest.mark.parametrize("text", ["can't start new thread", "could not create a primitive"])
def test_what_libraries_raise_when_memory_is_short(text: str) -> None:
    assert is_out_of_memory(RuntimeError(text))


def test_too_few_threads_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_process_limit", lambda: 100.0)
    check_threads()
    before, start = threading.active_count(), threading.Thread.start

    def limited(thread: threading.Thread) -> None:
        if threading.active_count() >= before + 5:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    done = agalign_here("info", "flight")
    assert done.returncode == 2
    assert re.match(r"agalign: only 5 more processes and threads .* raise the limit .*ulimit -u.*\n$", done.stderr)
    assert threading.active_count() == before


@pytest.mark.parametrize(
    ("of_user", "of_container", "is_low"),
    [(resource.RLIM_INFINITY, "max", False), (96_000, "10000", False), (100, "max", True), (96_000, "100", True)],
)
def test_threads_are_only_tried_under_a_low_limit(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, of_user: int, of_container: str, is_low: bool
) -> None:
    write_cgroups(tmp_path, {"pids.max": of_container})
    monkeypatch.setattr(processes, "_CGROUPS", tmp_path)
    limits = {resource.RLIMIT_NPROC: of_user, resource.RLIMIT_AS: resource.RLIM_INFINITY}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits[kind],) * 2)
    monkeypatch.setattr(threading.Thread, "start", raising(RuntimeError("can't start new thread")))
    with pytest.raises(ConfigurationError, match="only 0 more") if is_low else nullcontext():
        check_threads()
