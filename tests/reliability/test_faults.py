"""Each fault of the list has the expected result."""

from pathlib import Path

import pytest

from ..conftest import Shared
from .faults import FAULTS, LONG, Fault, make_model, run_fault, what_is_wrong

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def model(shared: Shared) -> Path:
    (path,) = (shared("faults", make_model) / "out" / "models").iterdir()
    return path


@pytest.mark.parametrize(
    "fault", [pytest.param(f, id=f.name, marks=[pytest.mark.full] if f in LONG else []) for f in FAULTS]
)
def test_fault(fault: Fault, model: Path, tmp_path: Path) -> None:
    seen = run_fault(fault, tmp_path, model)
    assert not what_is_wrong(fault, seen), seen.output
    assert not list(tmp_path.rglob(".agalign-part-*"))
