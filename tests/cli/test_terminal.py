"""What the program says when it ends, and with which code."""

import pytest
import typer

from agalign.cli.terminal import Terminal, exits, shown
from agalign.errors import ConfigurationError, InputError


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("x: is empty"), 1, "x: is empty"), (ConfigurationError("--x: no"), 2, "--x: no"),
        (MemoryError(), 1, "out of memory"), (RuntimeError("std::bad_alloc"), 1, "out of memory"),
        (ImportError("libx.so"), 1, "a library cannot be loaded (libx.so)"),
        (OSError(28, "No space left on device"), 1, "output: No space left on device"),
        (KeyboardInterrupt(), 130, "interrupted"), (ZeroDivisionError("of 1"), 1, "please report this"),
    ],
)  # fmt: skip
def test_every_end_is_a_line_and_a_code(
    error: BaseException, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended, exits(Terminal(quiet=False, verbose=False, log_json=False)):
        raise error
    assert ended.value.exit_code == code
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_what_is_shown_does_nothing() -> None:
    assert shown("\x1b[31mred\a\n[b]") == "\\x1b[31mred\\x07\\n\\[b]"
    assert shown("Köln, 雨 [1]") == "Köln, 雨 [1]"
