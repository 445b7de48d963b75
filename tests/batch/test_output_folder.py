from pathlib import Path

import pytest

from agalign.batch import prepare_output
from agalign.errors import OutputError


def test_an_output_that_cannot_be_made_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"out: cannot be made \(.+\); choose another folder with -o$"):
        prepare_output(tmp_path / "file" / "out")
