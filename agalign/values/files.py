"""Files that are complete or not there."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from agalign.errors import OutputError


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A path to write to beside `path`, which takes that name where the block ends well and goes where it does not.

    It has the same suffix, by which some libraries choose a format, and a name that no other process or thread takes;
    as a hidden file it is no image to be aligned. The folder is made. Raises OutputError for an OSError.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}-{threading.get_native_id()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all. Raises OutputError."""
    with complete_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
