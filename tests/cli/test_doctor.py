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


def test_problems_of_the_machine_are_listed() -> None:
    disk = {"folder": "/data", "writable": True, "free_gb": 100.0}
    good = {"machine": dict.fromkeys(doctor._LIBRARIES, "1"), "devices": [], "disk": disk}
    assert doctor._problems(good) == []
    devices = [{"device": "cuda:0", "problem": "no kernel image"}]
    bad = {"machine": good["machine"] | {"torch": None}, "devices": devices}
    text = "\n".join(doctor._problems(bad | {"disk": disk | {"writable": False, "free_gb": 0.2}}))
    assert all(word in text for word in ("torch", "--device", "-o", "0.2 GB"))
