"""The data of the captures in the report, in parts of bounded size: the first is in the page, the others are scripts in
OUT/report-data, which the page loads when they are needed. A page that is opened as a file may load scripts, not JSON.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agalign.host.files import check_inside, write_text
from agalign.host.text import escape_controls

DATA_FOLDER = "report-data"
_NAME = re.compile(r"[a-z]+-\d+-[0-9a-f]{16}\.js")
_IN_PAGE = re.compile(re.escape(DATA_FOLDER) + r"/[a-z]+-\d+-[0-9a-f]{16}\.js")


@dataclass
class DataParts:
    """Records of one kind, in their order, in parts of `size` records."""

    out: Path
    """Output folder of the run."""
    kind: str
    """`rows` or `details`; the function of the page with this name and `add` before it takes a part."""
    size: int
    also: Callable[[], Mapping[str, Any]] = dict
    """Returns further data of the current part, when it ends."""
    files: list[str] = field(default_factory=list)
    """Names of the scripts, relative to the output folder, of all parts but the first."""
    first: dict[str, Any] | None = None
    """The first part."""
    _records: list[dict[str, Any]] = field(default_factory=list)

    def add(self, record: dict[str, Any]) -> None:
        """Add a record, and end the part if it is full. Raises OutputError."""
        self._records.append(record)
        if len(self._records) == self.size:
            self.flush()

    def flush(self) -> None:
        """End the current part, with control characters escaped. Raises OutputError."""
        if not self._records and self.first is not None:
            return
        number = len(self.files) + (self.first is not None)  # of parts before this one, which are full
        part = {"from": number * self.size, "records": printable(self._records), **self.also()}
        self._records = []
        if self.first is None:
            self.first = part
            return
        text = json.dumps(part, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        # The name contains a checksum: the earlier page, and its data, stand until the new page replaces it.
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        file = f"{DATA_FOLDER}/{self.kind}-{number + 1}-{digest}.js"
        check_inside(self.out / DATA_FOLDER, self.out)
        write_text(self.out / file, f"add_{self.kind}({text});\n")
        self.files.append(file)

    def parts(self) -> Iterator[dict[str, Any]]:
        """Yield all parts, which are read back one by one."""
        if self.first is not None:
            yield self.first
        for file in self.files:
            text = (self.out / file).read_text("utf-8")
            yield json.loads(text[text.index("(") + 1 : text.rindex(")")])


def printable(value: Any) -> Any:
    """Return a value for the page with control characters, such as changes of text direction, escaped in all texts."""
    if isinstance(value, str):
        return escape_controls(value)
    if isinstance(value, dict):
        return {escape_controls(key): printable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        has_texts = {str, dict, list, tuple} & set(map(type, value))  # not in the long lists of numbers
        return [printable(item) for item in value] if has_texts else value
    return value


def data_files_exist(page: Path) -> bool:
    """Return True if all data files of a page exist. Raises OSError if the page cannot be read."""
    return all((page.parent / file).is_file() for file in _IN_PAGE.findall(page.read_text("utf-8")))


def remove_other_data_files(out: Path, kept: Sequence[str]) -> None:
    """Remove the data files of earlier pages, and the folder if it is then empty."""
    folder, names = out / DATA_FOLDER, {Path(file).name for file in kept}
    if folder.is_symlink() or not folder.is_dir():
        return
    with suppress(OSError):
        for path in folder.iterdir():
            if _NAME.fullmatch(path.name) and path.name not in names:
                path.unlink()
        if not names:
            folder.rmdir()
