import errno
import os
from pathlib import Path

import pytest

from agalign.errors import ConfigurationError, OutputError
from agalign.host.output_folder import locked

from ..conftest import raising


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.EPERM, errno.EOPNOTSUPP])
@pytest.mark.parametrize("missing", ["replace", "open"])
def test_a_file_system_that_cannot_rename_or_change_files_is_named_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str, code: int
) -> None:
    fails = raising(OSError(code, os.strerror(code)))
    real = Path.open

    def opened(self: Path, mode: str = "r", *rest: object, **more: object) -> object:
        return fails() if "+" in mode else real(self, mode, *rest, **more)

    monkeypatch.setattr(Path, missing, fails if missing == "replace" else opened)
    for _ in range(2):
        message = r"its file system cannot rename files .* choose a local folder with -o"
        with pytest.raises(OutputError, match=message), locked(tmp_path / "out"):
            pass
        assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_other_errors_are_reported_where_a_file_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    monkeypatch.setattr(Path, "replace", raising(OSError(code, os.strerror(code))))
    with locked(tmp_path / "out"):
        pass
    assert not list((tmp_path / "out").iterdir())


def test_a_file_of_the_user_with_the_name_of_the_lock_is_kept(tmp_path: Path) -> None:
    lock = tmp_path / ".agalign.lock"
    lock.write_text("notes of the user")
    with pytest.raises(ConfigurationError, match="lock: was not written by agalign; choose"), locked(tmp_path):
        pass
    assert lock.read_text() == "notes of the user"
    for left in ("", "process 4194304 on some host"):  # by a killed run
        lock.write_text(left)
        with locked(tmp_path):
            assert lock.read_text().startswith(f"process {os.getpid()} on ")
        assert not lock.exists()
