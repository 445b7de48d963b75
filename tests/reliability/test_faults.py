"""Each fault of the list has the expected result, and docs/reliability.md reports it."""

from pathlib import Path

import pytest

from ..conftest import Shared
from .faults import FAULTS, FULL, Fault, make_model, run_fault, what_is_wrong

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def model(shared: Shared) -> Path:
    (path,) = (shared("faults", make_model) / "out" / "models").iterdir()
    return path


@pytest.mark.parametrize(
    "fault", [pytest.param(f, id=f.name, marks=[pytest.mark.full] if f.name in FULL else []) for f in FAULTS]
)
def test_fault(fault: Fault, model: Path, tmp_path: Path) -> None:
    seen = run_fault(fault, tmp_path, model)
    assert not what_is_wrong(fault, seen), seen.output
    assert not list(tmp_path.rglob(".agalign-part-*"))


def test_the_document_has_a_row_for_each_fault_that_is_reported() -> None:
    text = DOCUMENT.read_text()
    section = text.partition("<!-- faults -->")[2].partition("<!-- end of faults -->")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    reported = [(f.name, str(f.ends.code)) for f in FAULTS if f.ends.code]
    assert [(name.removeprefix("| "), code) for name, code, *_ in rows] == reported
