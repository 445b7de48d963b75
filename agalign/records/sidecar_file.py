"""Writing, reading and finding sidecars, and comparing the files of a run with their checksums."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from agalign.errors import InputError, Reason, SidecarError
from agalign.host.files import RUN_FILE, file_checksum, folders_of_run, indented, open_regular, read_regular, write_text
from agalign.host.text import shortened
from agalign.records.listed_files import ListedFiles, file_problem
from agalign.records.sidecar import SCHEMA, FilePart, Sidecar

_MAX_BYTES = 1 << 26
"""Limit of a file that is read: ten times the sidecar of many bands."""
_START_BYTES = 200
"""A sidecar has its schema in the first bytes."""
_MAX_QUOTED = 60
"""Characters of a wrong value that a message quotes."""


def write_sidecar(path: Path, sidecar: Sidecar) -> Sidecar:
    """Write a sidecar atomically, and return it as a reader of the file has it: with its decimals and its checksum.

    Raises OutputError, and SidecarError for values that no sidecar can have.
    """
    checksum = content_checksum(sidecar.model_dump_json(by_alias=True))
    text = sidecar.model_copy(update={"checksum": checksum}).model_dump_json(by_alias=True)
    in_file = _parsed(path, text.encode())
    write_text(path, indented(text))
    return in_file


def file_part(kind: str, path: Path, folder: Path, sha256: str = "") -> FilePart:
    """Return the entry of a file below the folder of its sidecar, whose checksum may be known. Raises OutputError."""
    file = path.relative_to(folder).as_posix()
    return FilePart(kind=kind, file=file, bytes=path.stat().st_size, sha256=sha256 or file_checksum(path))


def add_products(path: Path, kind: str, files: Sequence[Path]) -> None:
    """List files that a later command has written in the sidecar at `path`.

    Raises SidecarError, also for a sidecar that `read_checked` refuses, and OutputError.
    """
    if not files:
        return
    sidecar, added = read_checked(path), [file_part(kind, file, path.parent) for file in files]
    others = [part for part in sidecar.products if part.file not in {part.file for part in added}]
    write_sidecar(path, sidecar.model_copy(update={"products": [*others, *added]}))


def content_checksum(text: str | bytes) -> str:
    """Return the SHA-256 of a sidecar's JSON in canonical form: sorted keys, no spaces, without `checksum`, and without
    every `seconds`, which differs from run to run.
    """
    content = json.loads(text, object_hook=_without_seconds)
    content.pop("checksum", None)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


class OtherSchemaError(SidecarError):
    """A sidecar is that of a version of agalign with another schema."""


def _without_seconds(part: dict[str, Any]) -> dict[str, Any]:
    part.pop("seconds", None)
    return part


def read_sidecar(path: Path) -> Sidecar:
    """Return a sidecar. Raises SidecarError with file and field if it is missing, malformed or of another schema."""
    return _parsed(path, _contents(path))


def read_checked(path: Path) -> Sidecar:
    """Return a sidecar as `read_sidecar` does. Raises SidecarError also if it is not as a command wrote it."""
    sidecar, change = read_with_change(path)
    if change:
        raise SidecarError(f"{path}: {change}")
    return sidecar


def read_with_change(path: Path) -> tuple[Sidecar, Reason | None]:
    """Return a sidecar, and why it is not as a command wrote it at this place; None if it is.

    Raises SidecarError like `read_sidecar`.
    """
    text = _contents(path)
    sidecar = _parsed(path, text)
    if place := place_problem(path, sidecar):
        return sidecar, place
    if sidecar.checksum is None:
        return sidecar, Reason("has no checksum, so that changes cannot be found", "run again")
    if sidecar.checksum != content_checksum(text):
        return sidecar, Reason("was changed after it was written", "run again")
    return sidecar, None


def place_problem(path: Path, sidecar: Sidecar) -> Reason | None:
    """Return that the sidecar at a path is that of another capture; None if it is not."""
    if sidecar.capture == path.stem:
        return None
    return Reason(f"belongs to {shortened(sidecar.capture)}", "delete it and run again")


def _contents(path: Path) -> bytes:
    try:
        return read_regular(path, _MAX_BYTES)
    except FileNotFoundError:
        raise SidecarError(f"{path}: does not exist; give the sidecar of a capture") from None
    except OSError as error:
        raise SidecarError(f"{path}: cannot be read ({error.strerror or error}); delete it and run again") from None


def _parsed(path: Path, text: bytes) -> Sidecar:
    try:
        return Sidecar.model_validate_json(text)
    except ValidationError as error:
        known = {e["loc"] for e in error.errors(include_url=False)}
        kind = OtherSchemaError if ("schema",) in known else SidecarError
        raise kind(f"{path}: {_problem(error, text)}") from None


def check_products(paths: Iterable[Path]) -> None:
    """Raise InputError for a file that a sidecar beside it lists, and that is not as it was written."""
    for path in paths:
        for sidecar in (p for p in path.parent.glob("*.json") if path.name.startswith(p.stem) and is_sidecar(p)):
            with suppress(SidecarError):  # that of another version, for example
                ListedFiles.of(read_checked(sidecar), path.parent).check(path)


def find_sidecars(folder: Path) -> list[Path]:
    """Return the sidecars below an output folder, sorted; unreadable files are included; other JSON files, hidden ones,
    such as partial files of another command, and those of other runs in it are not.
    """
    files = (Path(parent, name) for parent, _, names in folders_of_run(folder) for name in names)
    named = (path for path in sorted(files) if path.suffix == ".json" and not path.name.startswith("."))
    return [path for path in named if is_sidecar(path)]


def is_sidecar(path: Path) -> bool:
    """Return True for a file that starts like a sidecar, and for one that cannot be read."""
    try:
        with open_regular(path) as file:
            return b'"agalign/' in file.read(_START_BYTES)
    except OSError:
        return True


def label_of(sidecar: Path, out: Path) -> str:
    """Return the label of the capture with this sidecar below the output folder of a run."""
    return sidecar.relative_to(out).with_suffix("").as_posix()


def run_sidecars(out: Path) -> list[Path]:
    """Return the sidecars below the output folder of a run. Raises InputError if there are none, or if the folder
    contains the output folders of runs or is inside of one, and is none itself.
    """
    if not (out / RUN_FILE).is_file():
        # The lock, the tables and the report of a run are for all folders in it.
        if whole := next((parent for parent in out.resolve().parents if (parent / RUN_FILE).is_file()), None):
            raise InputError(f"{out}: is a part of the run in {whole}; give that folder")
        if inner := next(out.rglob(RUN_FILE), None):
            raise InputError(
                f"{out}: contains runs, such as {inner.parent}, and is none itself; give the folder of one"
            )
    sidecars = find_sidecars(out) if out.is_dir() else []
    if not sidecars and (out / RUN_FILE).is_file():
        raise InputError(f"{out}: the run there has no results: it was stopped, or all captures failed; run it again")
    if not sidecars:
        what = "no sidecars there" if out.is_dir() else "is not a folder" if out.exists() else "does not exist"
        raise InputError(f"{out}: {what}; give the output folder of a run")
    return sidecars


def _problem(error: ValidationError, text: bytes) -> str:
    """The first problem of a sidecar with this text, and the remedy; a wrong schema version before anything else."""
    problems = {".".join(map(str, e["loc"])): e for e in error.errors(include_url=False)}
    (field, first), *_ = problems.items()
    if first["type"] == "json_invalid":
        return f"not valid JSON ({shortened(first['msg'])}); delete it and run again"
    if not field:
        return f"not a sidecar of schema {SCHEMA!r}; delete it and run again"
    if "schema" in problems:
        schema = problems["schema"]
        value = repr(None if schema["type"] == "missing" else schema["input"])
        known = f"schema is {shortened(value, _MAX_QUOTED)}{_maker(text)}, not {SCHEMA!r}"
        return f"{known}; run again into a new folder"
    return f"{shortened(field)}: {shortened(first['msg'].removeprefix('Value error, '))}; run again with --overwrite"


def _maker(text: bytes) -> str:
    """The version of agalign that wrote a sidecar of another schema, in words; empty if the sidecar has none."""
    with suppress(ValueError, RecursionError):
        if isinstance(facts := json.loads(text), dict) and isinstance(version := facts.get("agalign"), str):
            return f" of agalign {shortened(version, _MAX_QUOTED)}"
    return ""


def verify_outputs(out: Path, sidecars: Iterable[Path] | None = None) -> Iterator[tuple[Path, list[str]]]:
    """Yield (sidecar, problems of the sidecar and the files that it lists) for these captures, by default all below
    `out`.

    Raises InputError if there is no sidecar.
    """
    for path in run_sidecars(out) if sidecars is None else sidecars:
        try:
            yield path, list(_problems_of_outputs(path))
        except SidecarError as error:
            yield path, [str(error)]


def _problems_of_outputs(path: Path) -> Iterator[str]:
    sidecar, change = read_with_change(path)
    if change:
        yield f"{path}: {change}"
    if sidecar.output is None and sidecar.status != "failed":
        yield f"{path}: its rasters were not written; run again"
    for kind in sidecar.not_written:
        yield f"{path}: its {kind} could not be written; run again"
    for part in sidecar.files:
        if problem := file_problem(path.parent / part.file, part):
            yield problem
