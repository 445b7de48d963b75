"""Output of the reliability scripts: standard output, and a marked section of docs/reliability.md."""

import re
from collections.abc import Sequence
from pathlib import Path


class Section:
    """Printed as it comes; with a document, what stood between its marks is replaced."""

    def __init__(self, name: str, document: Path | None) -> None:
        self._name, self._document = name, document
        self._parts: list[str] = []

    def say(self, text: str) -> None:
        """A paragraph."""
        self._add(text)

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """Rows of text, the first of them the heads."""
        head, *body = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
        lines = [head, ["---"] * len(head), *body]
        self._add("\n".join("| " + " | ".join(line) + " |" for line in lines))

    def _add(self, text: str) -> None:
        print(text, end="\n\n", flush=True)
        self._parts.append(text)
        if self._document is None:
            return
        begin, end = f"<!-- {self._name} -->", f"<!-- end of {self._name} -->"
        new = "\n\n".join([begin, *self._parts, end])
        pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
        old = self._document.read_text(encoding="utf-8")
        if not pattern.search(old):
            raise SystemExit(f"{self._document} has no section {begin}")
        self._document.write_text(pattern.sub(lambda _: new, old), encoding="utf-8")
