"""The program's entry: `agalign`, and `python -m agalign`."""

import sys


def main() -> None:
    """Run the command line."""
    try:
        # What it needs takes a moment to load, in which the interrupt key may come.
        from agalign.cli.main import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
