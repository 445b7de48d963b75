"""Entry point of `agalign` and `python -m agalign`."""

import os
import sys


def main() -> None:
    """Run the command line."""
    import signal  # not a `signal.py` in the working folder, which `python -m` searches until this function runs

    _open_missing_streams()
    # While modules are imported, the system ends the process: an exception in a callback of an import lock is lost.
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        from agalign.cli.main import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)


def _open_missing_streams() -> None:
    """Open the null device for standard streams that the caller closed (`>&-`), so that no file gets their numbers."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            # `os.open` returns the lowest free descriptor, which is `number`.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, mode))


if __name__ == "__main__":
    # `python -m` searches the working folder first, and would run a `rasterio.py` that is there.
    if not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):  # noqa: PTH120
        del sys.path[0]
    main()
