"""The program's entry: `agalign`, and `python -m agalign`."""

import os
import sys


def main() -> None:
    """Run the command line."""
    _open_missing_streams()
    try:
        # What it needs takes a moment to load, in which the interrupt key may come.
        from agalign.cli.main import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)


def _open_missing_streams() -> None:
    """Standard streams that the caller closed (`>&-`) lead nowhere, before an output file can take their numbers."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number is taken: those below are open.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, mode))


if __name__ == "__main__":
    main()
