"""Tables as CSV, and pydantic models as JSON that is read back."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from agalign.errors import SidecarError
from agalign.values.files import read_regular, write_text
from agalign.values.text import without_formula

Model = TypeVar("Model", bound=BaseModel)


def compact_lists(text: str) -> str:
    """Return indented JSON with each list of numbers on one line, which takes a third of the size."""
    # Numbers, null, true and false start with these characters; keys and texts start with a quote.
    text = re.sub(r"\[\n +(?=[-0-9ntf])", "[", text)
    text = re.sub(r",\n +(?=[-0-9ntf])", ", ", text)
    return re.sub(r"(?<=[0-9le])\n *\]", "]", text)


def write_model(path: Path, model: BaseModel | None) -> None:
    """Write a model atomically as indented JSON; None removes the file of an earlier run. Raises OutputError."""
    if model is None:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return
    write_text(path, compact_lists(model.model_dump_json(by_alias=True, indent=1)) + "\n")


def read_model(path: Path, model: type[Model]) -> Model | None:
    """Return the model in a file, or None if the file does not exist. Raises SidecarError for any other content."""
    try:
        return model.model_validate_json(read_regular(path))
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        reason = f" ({error.strerror})" if isinstance(error, OSError) else ""
        raise SidecarError(f"{path}: cannot be read{reason}; delete it and run again") from None


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table atomically; None becomes an empty cell, and formulas are quoted. Raises OutputError."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(map(without_formula, row) for row in rows)
    write_text(path, table.getvalue())
