"""The files that a sidecar lists: whether they are as they were written.

Size and checksum decide. Computing checksums of a flight takes minutes, so the run record has the states (checksum,
size, times) in which the last run left the files: a file in such a state is not read. A copy of the folder has other
states, and a write changes the second time on POSIX systems, also if the first is set back.
"""

import hashlib
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Self

from agalign.errors import InputError
from agalign.host.files import open_regular
from agalign.records.sidecar import FilePart, Sidecar


def file_state(status: os.stat_result, part: FilePart) -> str:
    """Return sixteen hexadecimal digits of a file's checksum by its sidecar, its size and its times."""
    facts = f"{part.sha256} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"
    return hashlib.sha256(facts.encode()).hexdigest()[:16]


def file_problem(path: Path, part: FilePart, known: Collection[str] = ()) -> str:
    """Return why a file is not as its sidecar lists it, and the remedy; empty if it is.

    The size is always compared, and the checksum unless the state of the file is among the `known` ones.
    """
    again = "run 'agalign indices' again" if part.kind == "index" else "run again"
    try:
        with open_regular(path) as file:
            status = os.fstat(file.fileno())
            is_known = file_state(status, part) in known
            if status.st_size == part.bytes and (is_known or _checksum(file) == part.sha256):
                return ""
    except OSError as error:
        return f"{path}: cannot be read ({error.strerror or error}); {again}"
    return f"{path}: is not what was written; delete it and {again}"


def _checksum(file: BufferedReader) -> str:
    return hashlib.file_digest(file, "sha256").hexdigest()


def states_of(folder: Path, parts: Iterable[FilePart]) -> Iterator[str]:
    """Yield the states of files that are as they were written, given the folder of their sidecar."""
    for part in parts:
        with suppress(OSError):  # removed meanwhile
            yield file_state((folder / part.file).stat(), part)


@dataclass(frozen=True)
class ListedFiles:
    """The files that a sidecar lists, by path. A file is compared with the sidecar before it is read."""

    parts: Mapping[Path, FilePart] = field(default_factory=dict)
    known: frozenset[str] = frozenset()
    """States of files that need no comparison of checksums."""

    @classmethod
    def of(cls, sidecar: Sidecar, folder: Path, states: str = "") -> Self:
        """Return the files of a sidecar in a folder, and their states in the run record."""
        return cls({folder / part.file: part for part in sidecar.files}, frozenset(states.split()))

    def problem(self, path: Path) -> str:
        """Return why a file is not as it was written, and the remedy; empty if it is, or if it is not listed."""
        part = self.parts.get(path)
        return "" if part is None else file_problem(path, part, self.known)

    def check(self, path: Path) -> None:
        """Raise InputError for a file that is not as it was written."""
        if problem := self.problem(path):
            raise InputError(problem)
