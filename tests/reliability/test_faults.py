"""Every fault of the list comes to what it must come to, and docs/reliability.md says what is seen."""

from pathlib import Path

import pytest

from .faults import FAULTS, Fault, run_fault, what_is_wrong

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]


@pytest.mark.parametrize("fault", FAULTS, ids=[f.name for f in FAULTS])
def test_fault(fault: Fault, tmp_path: Path) -> None:
    seen = run_fault(fault, tmp_path)
    assert not what_is_wrong(fault, seen), seen.output
    assert not list(tmp_path.rglob(".agalign-part-*"))


def test_the_document_has_a_row_for_each_fault_that_is_reported() -> None:
    text = DOCUMENT.read_text()
    section = text.partition("<!-- faults -->")[2].partition("<!-- end of faults -->")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    reported = [(f.name, str(f.code)) for f in FAULTS if f.code]
    assert [(name.removeprefix("| "), code) for name, code, *_ in rows] == reported
