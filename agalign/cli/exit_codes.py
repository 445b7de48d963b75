"""Exit codes of the commands."""

from enum import IntEnum


class ExitCode(IntEnum):
    """What a command returns to the shell."""

    OK = 0
    NOTHING = 1
    USAGE = 2
    PARTIAL = 3
    SIGNAL = 128
    """Added to the number of the signal that ended the program, as shells do: 130 for SIGINT, 143 for SIGTERM."""
