"""Each fault of the list has the expected result, and docs/explanation/verification.md reports it."""

from pathlib import Path

import pytest

from ..conftest import Shared
from .faults import DOCUMENT, FAULTS, LONG, Fault, documented, make_model, run_fault, what_is_wrong

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


def test_the_document_has_the_exit_codes_of_the_most_common_faults() -> None:
    assert f"injects {len(FAULTS)} faults" in DOCUMENT.read_text()
    assert documented()
    assert documented().items() <= {(f.name, str(f.code)) for f in FAULTS}
