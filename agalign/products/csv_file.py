"""Tables that a run writes as CSV."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from agalign.values.files import write_text


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table atomically; None becomes an empty cell. Raises OutputError."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, table.getvalue())
