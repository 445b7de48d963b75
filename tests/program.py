"""The command line as the tests run it."""

import contextlib
import io
import subprocess
import sys
from typing import Any

from agalign.cli import main as cli


def agalign_here(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line in this process, which has loaded everything: seconds faster than in a new one."""
    command = ["agalign", *map(str, arguments)]
    out, errors, before = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = command
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(out):
            cli.main()
        code = 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        sys.argv = before
    return subprocess.CompletedProcess(command, code, out.getvalue(), errors.getvalue())


def agalign(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, with `options` of `subprocess.run`."""
    command = [sys.executable, "-m", "agalign", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert "Traceback" not in done.stderr, done.stderr
    return done
