"""What a run does with the path of an output: write, remove, keep or refuse it, by what is there.

`State` is the table. It is asked before a run, before each capture, which a worker may process much later, and after a
capture was rendered or skipped. A run touches no other files of captures. The lock (`host/output_folder.py`) and the
rasters of an index (`spectral_indices/rasters.py`), which may be in another folder, are checked where they are written;
all by the mark of `host/own_files.py`.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import timedelta
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Literal

from agalign.batch.products import PRODUCTS
from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, OutputError, Reason, SidecarError
from agalign.flight.fingerprint import input_samples
from agalign.host.files import RUN_FILE, check_inside, max_name_bytes, remove_companions
from agalign.host.own_files import foreign, is_own_file, is_taken, refuse_foreign, refuse_foreign_pages
from agalign.rasters.aligned_files import band_file_names, is_aligned_raster
from agalign.rasters.parallax_file import PARALLAX_SUFFIX
from agalign.rasters.product import CapturePaths
from agalign.records.panels_and_sky import PANEL_AND_SKY_FILES
from agalign.records.run_record import RUN_START, file_states
from agalign.records.sidecar import FilePart, Sidecar
from agalign.records.sidecar_file import OtherSchemaError, is_sidecar, read_with_change
from agalign.spectral_indices.rasters import IndexRasters, index_rasters
from agalign.values.capture import Capture, CaptureTime, source_file

_Action = Literal["write", "remove", "keep", "refuse"]


class State(Enum):
    """What is at the path of an output; what a run does that writes the output, and one that does not, because of other
    options or because it does not align the capture. A written file replaces the one there.
    """

    NO_FILE = "no file, or a link to none", "write", "keep"
    SIDECAR = "sidecar of the capture, also edited or unreadable", "write", "remove"
    AS_LISTED = "in a sidecar that was not edited, with this size", "write", "remove"
    WITH_MARK = "file with the mark of the program, or empty", "write", "remove"
    CHANGED = "listed with another size, without mark; other JSON where a sidecar was", "write", "keep"
    OF_USER = "any other file, pipe or device, and a link to a folder", "refuse", "keep"
    INDEX = "index in the sidecar, where another output would be", "refuse", "remove"
    OTHER_RESULT = "sidecar of another capture, or of a version with another schema", "refuse", "refuse"
    IMAGE = "image of the input", "refuse", "refuse"
    TAKEN = "output of another capture of the run, with a name that differs at most in case", "refuse", "refuse"
    TOO_LONG = "name that the file system does not take", "refuse", "refuse"

    def __init__(self, _what: str, written: _Action, not_written: _Action) -> None:
        self.written, self.not_written = written, not_written


ReadSidecar = Callable[[Path], tuple[Sidecar, Reason | None]]
"""As `read_with_change`."""
_Found = tuple[State, str]
"""State of a path, and the message if it is refused."""
_TEXT_STARTS = tuple(start for product in PRODUCTS for start in product.text_starts)
_MAX_APART = timedelta(seconds=1)
"""The bands of a capture are exposed within 0.3 s, and its time is that of the reference, which an option chooses."""


# ---- before a run, and before each capture


def refuse_to_overwrite(
    captures: Sequence[Capture], out: Path, settings: WriteSettings, read: ReadSidecar = read_with_change
) -> None:
    """Raise ConfigurationError for the first path of an output that the table refuses, and OutputError for a link that
    leads out of the output folder.
    """
    names = _Names(captures, out)
    for capture in captures:
        sidecar, once = CapturePaths.of(capture, out).sidecar, cache(read)
        earlier, _ = earlier_result(sidecar, once)
        parts = [] if earlier is None else earlier.files
        listed = _sizes(parts, sidecar.parent)
        indices = _sizes((part for part in parts if part.kind == IndexRasters.kind), sidecar.parent)
        for path, is_written, kind in _outputs(capture, out, settings):
            found = names.found(path, capture) or (
                _sidecar(path, capture, out, once) if path == sidecar else _file(path, listed)
            )
            if path in indices and kind != IndexRasters.kind and found[0] is not State.NO_FILE:
                message = f"{path}: is an index, which another output of this name would replace"
                found = State.INDEX, f"{message}; delete it, or choose another output folder with -o"
            state, message = found
            if (state.written if is_written else state.not_written) == "refuse":
                raise ConfigurationError(message)


def _outputs(capture: Capture, out: Path, settings: WriteSettings) -> Iterator[tuple[Path, bool, str]]:
    """Yield the path of every output of a capture, whether a run with these settings writes it, and its kind."""
    paths = CapturePaths.of(capture, out)
    yield from ((paths.sidecar, True, ""), (paths.file(PARALLAX_SUFFIX), True, ""))
    for product in PRODUCTS:
        is_written = product.is_enabled(settings)
        yield from ((path, is_written, product.kind) for path in product.paths(capture, paths, settings))


class _Names:
    """The names of the outputs of a run: whether they can be written, without a look at the files there."""

    def __init__(self, captures: Iterable[Capture], out: Path) -> None:
        self._out, self._max_bytes = out, max_name_bytes(out)
        images = {band.path for capture in captures for band in capture.bands}
        folders = {folder: folder.resolve() for folder in {path.parent for path in images}}
        self._images = {q for p in images for q in (p.resolve(), folders[p.parent] / p.name)}
        """With links and what they lead to."""
        self._resolved: dict[Path, Path] = {}
        """Folders, each of which is resolved once."""
        self._written: dict[str, Capture] = {}

    def found(self, path: Path, capture: Capture) -> _Found | None:
        """Return a state that refuses the name of an output; None if it can be written. Raises OutputError."""
        if (name_bytes := len(os.fsencode(path.name))) > self._max_bytes:
            what = f"{path.name} would have {name_bytes} bytes, and file systems take {self._max_bytes}"
            return State.TOO_LONG, f"{capture.reference.path}: the name of its output {what}; rename its files"
        if path.parent not in self._resolved:
            self._resolved[path.parent] = check_inside(path.parent, self._out).resolve()
        if self._resolved[path.parent] / path.name in self._images:
            return State.IMAGE, f"{path}: is an image to be aligned; choose another output folder"
        other = self._written.setdefault(str(path).lower(), capture)
        if other is not capture:
            message = f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
            return State.TAKEN, message
        return None


def _file(path: Path, listed: Mapping[Path, int]) -> _Found:
    """Return the state of the file of a product, given the sizes of the listed files."""
    if not is_taken(path):
        return State.NO_FILE, ""
    if path.is_file() and path.stat().st_size == listed.get(path):
        return State.AS_LISTED, ""
    if is_own(path):
        return State.WITH_MARK, ""
    return (State.CHANGED, "") if path in listed else (State.OF_USER, foreign(path))


def _sidecar(path: Path, capture: Capture, out: Path, read: ReadSidecar) -> _Found:
    """Return the state of the path of the sidecar of a capture."""
    if not is_taken(path):
        return State.NO_FILE, ""
    if not path.is_file():
        return State.OF_USER, foreign(path)
    try:
        earlier, _ = read(path)
    except OtherSchemaError as error:
        return State.OTHER_RESULT, str(error)
    except SidecarError:
        if is_sidecar(path):
            return State.SIDECAR, ""
        if is_own(path):
            return State.WITH_MARK, ""
        return (State.CHANGED, "") if capture.label in file_states(out) else (State.OF_USER, foreign(path))
    if is_same(earlier, capture) is not False:
        return State.SIDECAR, ""
    what = f"belongs to a different capture from {capture.label} here {_described(earlier, capture)}"
    return State.OTHER_RESULT, f"{path}: {what}; choose another output folder with -o"


def is_own(path: Path) -> bool:
    """Return True for a file with the mark of the program, or the start of one of its texts, and for an empty file."""
    return is_own_file(path, _TEXT_STARTS)


def earlier_result(path: Path, read: ReadSidecar = read_with_change) -> tuple[Sidecar | None, bool]:
    """Return the sidecar of an earlier run, None if it cannot be read, and whether it is as it was written.

    An edited one may list any file. It is returned with the products that have the mark of the program: the next
    sidecar confirms no others.
    """
    with suppress(SidecarError):
        sidecar, change = read(path)
        if not change:
            return sidecar, True
        own = [part for part in sidecar.products if is_own(path.parent / part.file)]
        return sidecar.model_copy(update={"products": own, "parallax": None}), False
    return None, False


def _sizes(parts: Iterable[FilePart], folder: Path) -> dict[Path, int]:
    return {folder / part.file: part.bytes for part in parts}


def refuse_results_elsewhere(captures: Sequence[Capture], out: Path, read: ReadSidecar = read_with_change) -> None:
    """Raise ConfigurationError if another place of the output folder has the result of a capture, as of a run on the
    folder above, or one of the same name by a version with another schema.
    """
    places, by_name = {CapturePaths.of(c, out).sidecar for c in captures}, dict[str, list[Capture]]()
    for capture in captures:
        by_name.setdefault(capture.name, []).append(capture)
    for path in (p for p in out.rglob("*.json") if p.stem in by_name and p not in places):
        try:
            earlier, _ = read(path)
        except OtherSchemaError as error:
            raise ConfigurationError(str(error)) from None
        except SidecarError:
            continue
        if here := next((c for c in by_name[path.stem] if is_same(earlier, c)), None):
            what = f"is of the same capture as {here.label} here, by a run on a folder above or below the one here"
            raise ConfigurationError(f"{path}: {what}; choose another output folder with -o")


def refuse_foreign_run_files(out: Path) -> None:
    """Raise ConfigurationError for a file that no run wrote with the name of a page, of the run record, or of the file
    of panels or sky.
    """
    for name, start in {RUN_FILE: RUN_START, **PANEL_AND_SKY_FILES}.items():
        refuse_foreign(out / name, (start,))
    refuse_foreign_pages(out)


# ---- whether a result is of the same capture


def is_same(earlier: Sidecar, capture: Capture) -> bool | None:
    """Return whether a result is of this capture; None if neither tags nor contents decide.

    The comparison uses the tags that both have: make, model, serial numbers, capture id and time. Without id and time,
    the contents of one file must be equal; the other files may have been repaired. Mosaics may share the
    reference: another file must be equal or at the same place.
    """
    one, other = earlier.camera, capture.camera
    pairs = (one.make, other.make), (one.model, other.model), (earlier.capture_id, capture.capture_id)
    if any(a and b and a != b for a, b in pairs) or (one.serials and other.serials and not one.serials & other.serials):
        return False
    if earlier.captured_at and capture.captured_at and earlier.captured_at != capture.captured_at:
        before, now = CaptureTime.of(earlier.captured_at), CaptureTime.of(capture.captured_at)
        return before is not None and now is not None and abs(before.utc - now.utc) <= _MAX_APART
    if (earlier.capture_id and capture.capture_id) or (earlier.captured_at and capture.captured_at):
        return True
    if not earlier.own_samples:
        return None
    if not earlier.own_samples.isdisjoint(input_samples(capture).values()):
        return True
    # A mosaic that was made again has other contents.
    files = {source_file(capture, band) for band in capture.moving}
    return earlier.reference.georeferenced and any(band.file in files for band in earlier.bands)


def _described(earlier: Sidecar, capture: Capture) -> str:
    """Return camera, time and id of a result and of a capture, as far as they are known."""
    texts = []
    for one, time in ((earlier, earlier.captured_at), (capture, capture.known_time)):
        name = " ".join(filter(None, (one.camera.make, one.camera.model, one.camera.serial)))
        texts.append(", ".join(filter(None, (name, time, one.capture_id))) or "without tags")
    return f"({texts[0]}; here {texts[1]})"


# ---- after a capture was rendered or skipped


def outdated_files(
    capture: Capture, out: Path, settings: WriteSettings, listed: Sequence[FilePart]
) -> Mapping[Path, str]:
    """Return the files of an earlier command for a capture, which are removed unless they are written again, and why.

    Otherwise a sidecar could describe rasters of another run, and bands on an old grid could remain among new ones.
    `listed` has the products in the sidecar, which anyone may have written: a file is returned if it has the name of an
    output of this capture, and the table removes it. The reason is empty for files that users do not miss.
    """
    sizes, names = _sizes(listed, CapturePaths.of(capture, out).folder), _Names([capture], out)
    found = _outdated(capture, out, settings, sizes)
    return {path: reason for path, reason in found if names.found(path, capture) is None and is_removed(path, sizes)}


def is_removed(path: Path, listed: Mapping[Path, int]) -> bool:
    """Return True for a product that the table removes if it is not written, given the sizes of the listed files."""
    return _file(path, listed)[0].not_written == "remove"


def _outdated(
    capture: Capture, out: Path, settings: WriteSettings, listed: Mapping[Path, int]
) -> Iterator[tuple[Path, str]]:
    """Yield files with the names of outputs of a capture, given the sizes of listed files by path."""
    paths = CapturePaths.of(capture, out)
    with suppress(OutputError):
        check_inside(paths.folder, out)
        for product in PRODUCTS:
            is_unwanted = product.option is None and not product.is_enabled(settings)
            reason = f"--layout {settings.layout}" if is_unwanted else f"{product.kind} is not written again"
            yield from ((path, reason) for path in product.paths(capture, paths, settings))
        # Also of a band that this run leaves out; a file with a sidecar is the stack of another capture.
        pattern = re.compile(rf"{re.escape(capture.name)}(\d|[._].+)\.tiff?", re.IGNORECASE)
        own = [p for p in listed if p.parent == paths.folder and pattern.fullmatch(p.name)]
        own = [p for p in own if not p.with_suffix(".json").exists()]
        own += [paths.folder / name for name in band_file_names(capture).values()]
        yield from ((p, f"--layout {settings.layout}") for p in own if p in listed and is_aligned_raster(p))
        for raster in index_rasters(paths.file("")):
            yield raster.path, "its bands are not aligned"
            yield raster.path.with_suffix(".png"), ""


def remove_files(files: Iterable[Path], out: Path) -> None:
    """Remove files below an output folder, if they can be."""
    for path in files:
        with suppress(OSError, OutputError):
            check_inside(path.parent, out)  # a link may have taken the place of the folder meanwhile
            path.unlink(missing_ok=True)
            remove_companions(path)


def remove_outputs(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Remove and return the outputs of an earlier run for a capture that this one does not align."""
    paths = CapturePaths.of(capture, out)
    earlier, _ = earlier_result(paths.sidecar)
    removed = [*outdated_files(capture, out, settings, [] if earlier is None else earlier.products)]
    if _sidecar(paths.sidecar, capture, out, read_with_change)[0].not_written == "remove":
        removed.append(paths.sidecar)
    if is_removed(parallax := paths.file(PARALLAX_SUFFIX), {}):
        removed.append(parallax)
    remove_files(removed, out)
    return [path for path in removed if not path.exists()]
