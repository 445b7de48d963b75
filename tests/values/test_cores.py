"""Cores: the limits of containers count."""

from pathlib import Path

import pytest

from agalign.values import cores
from agalign.values.cores import cgroup_quota, limit_default_threads, usable_cores


def test_the_quota_of_a_container_is_that_of_its_own_control_group(tmp_path: Path) -> None:
    own = tmp_path / "self"
    own.write_text("0::/\n")
    assert cgroup_quota(tmp_path, own) is None
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert cgroup_quota(tmp_path, own) is None
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    assert cgroup_quota(tmp_path, own) == 1.5


def test_the_smallest_quota_on_the_way_to_the_root_counts(tmp_path: Path) -> None:
    own, slice_ = tmp_path / "self", tmp_path / "batch" / "job"
    own.write_text("0::/batch/job\n")
    slice_.mkdir(parents=True)
    (slice_ / "cpu.max").write_text("400000 100000\n")
    (slice_.parent / "cpu.max").write_text("300000 100000\n")
    assert cgroup_quota(tmp_path, own) == 3.0


def test_control_groups_of_version_1(tmp_path: Path) -> None:
    own, folder = tmp_path / "self", tmp_path / "cpu" / "docker" / "ab"
    own.write_text("4:memory:/docker/other\n3:cpu,cpuacct:/docker/ab\n")
    folder.mkdir(parents=True)
    (folder / "cpu.cfs_period_us").write_text("100000\n")
    (folder / "cpu.cfs_quota_us").write_text("-1\n")
    assert cgroup_quota(tmp_path, own) is None
    (folder / "cpu.cfs_quota_us").write_text("50000\n")
    assert cgroup_quota(tmp_path, own) == 0.5


@pytest.mark.parametrize(("quota", "expected"), [(None, 8), (2.5, 3), (0.2, 1), (64.0, 8)])
def test_a_part_of_a_core_counts_as_one_and_a_quota_adds_none(
    monkeypatch: pytest.MonkeyPatch, quota: float | None, expected: int
) -> None:
    monkeypatch.setattr(cores.sys, "platform", "linux")
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(cores, "cgroup_quota", lambda: quota)
    assert usable_cores() == expected


def test_threads_follow_a_quota_and_what_the_user_has_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores.sys, "platform", "linux")
    monkeypatch.setattr(cores, "cgroup_quota", lambda: 1.0)
    variables = {"OMP_NUM_THREADS": "7"}
    monkeypatch.setattr(cores.os, "environ", variables)
    limit_default_threads()
    assert variables == {"OMP_NUM_THREADS": "7", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
