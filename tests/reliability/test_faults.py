"""Each fault of the list has the expected result, and docs/reliability.md reports it."""

from pathlib import Path

import pytest

from ..conftest import Shared
from .faults import FAULTS, FULL, IN_THE_DOCUMENT, Fault, make_model, run_fault, what_is_wrong

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


def test_the_document_has_the_exit_codes_of_the_most_common_faults() -> None:
    text = DOCUMENT.read_text()
    assert f"injects {len(FAULTS)} faults" in text
    section = text.partition("<!-- faults -->")[2].partition("<!-- end of faults -->")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    reported = [(f.name, str(f.ends.code)) for f in FAULTS if f.name in IN_THE_DOCUMENT]
    assert len(reported) == len(IN_THE_DOCUMENT)
    assert [(name.removeprefix("| "), code) for name, code, *_ in rows] == reported
