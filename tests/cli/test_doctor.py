"""The report of `agalign doctor`."""

import json
import re
from importlib import metadata
from pathlib import Path

import pytest

from agalign.cli import doctor

from ..program import agalign_here


@pytest.mark.slow
def test_it_finds_versions_devices_and_the_disk(tmp_path: Path) -> None:
    done = agalign_here("doctor", tmp_path, "--json")
    facts = json.loads(done.stdout)
    assert done.returncode == (1 if facts["problems"] else 0)
    assert facts["machine"]["torch"] == metadata.version("torch")
    assert facts["machine"]["cores"] >= 1
    assert next(d for d in facts["devices"] if d["device"] == "cpu")["problem"] == ""
    assert facts["disk"]["folder"] == str(tmp_path)
    assert "device cpu" in agalign_here("doctor", tmp_path).stdout


def test_it_names_every_extra_that_a_user_may_want() -> None:
    offered = set(metadata.metadata("agalign").get_all("Provides-Extra") or [])
    assert offered - {"bench", "dev", "docs", "fuzz"} == set(doctor.EXTRAS)
    for extra in doctor.EXTRAS:
        assert doctor._requirements(extra), "what an extra needs is found in the package's own metadata"
        assert all(re.fullmatch(r"[\w.-]+", name) for name in doctor._requirements(extra))


def test_problems_of_the_machine_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = dict.fromkeys(doctor._LIBRARIES, "1")
    well = {"machine": machine, "devices": [], "disk": {"folder": "/data", "writable": True, "free_gb": 100.0}}
    assert doctor._problems(well) == []
    broken = {
        "machine": machine | {"torch": None},
        "devices": [{"device": "cuda:0", "problem": "no kernel image"}],
        "disk": {"folder": "/data", "writable": False, "free_gb": 0.2},
    }
    text = "\n".join(doctor._problems(broken))
    for word in ("torch", "--device", "-o", "0.2 GB"):
        assert word in text
