"""Results of earlier runs in the output folder: whether they are of the same captures, and what has changed since."""

import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from itertools import chain
from pathlib import Path
from typing import Literal

from agalign._version import __version__
from agalign.batch.render import with_earlier_products
from agalign.config import RunOptions, Settings, SettingsModel
from agalign.errors import ConfigurationError, SidecarError
from agalign.flight.fingerprint import estimation_fingerprint, input_samples, render_fingerprint
from agalign.products.product import CapturePaths
from agalign.products.sidecar.file import read_without_tables
from agalign.products.sidecar.schema import FilePart, Sidecar
from agalign.values.capture import Capture, CaptureTime

_MAX_APART = timedelta(seconds=1)
"""The bands of a capture are exposed within 0.3 s, and its time is that of the reference, which an option chooses."""


def is_same(earlier: Sidecar, capture: Capture) -> bool | None:
    """Return whether a result is of this capture; None if neither tags nor contents decide.

    Tags that both have are compared: make, model, serial numbers, capture id, time. If there is no id and no time, the
    contents of a file must be equal; others may have been repaired.
    """
    one, other = earlier.camera, capture.camera
    serials = [set(camera.serial.split("+")) - {""} for camera in (one, other)]
    pairs = (one.make, other.make), (one.model, other.model), (earlier.capture_id, capture.capture_id)
    if any(a and b and a != b for a, b in pairs) or (all(serials) and not serials[0] & serials[1]):
        return False
    if earlier.captured_at and capture.captured_at and earlier.captured_at != capture.captured_at:
        before, now = CaptureTime.of(earlier.captured_at), CaptureTime.of(capture.captured_at)
        return before is not None and now is not None and abs(before.utc - now.utc) <= _MAX_APART
    if (earlier.capture_id and capture.capture_id) or (earlier.captured_at and capture.captured_at):
        return True
    if not earlier.input_samples:
        return None
    return bool(earlier.input_samples.items() & input_samples(capture).items())


def refuse_other_captures(captures: Sequence[Capture], out: Path, *, is_same_input: bool = False) -> None:
    """Raise ConfigurationError if the place of a capture has the result of another one, or if another place has its
    result, as of a run on the folder above. With the input folder of the last run, the images were moved in it instead.
    """
    places = {CapturePaths.of(c, out).sidecar: c for c in captures}
    by_name: dict[str, list[Capture]] = {}
    for capture in captures:
        by_name.setdefault(capture.name, []).append(capture)
    elsewhere = [] if is_same_input else [p for p in out.rglob("*.json") if p.stem in by_name and p not in places]
    for path, here in chain(places.items(), ((p, c) for p in elsewhere for c in by_name[p.stem])):
        with suppress(SidecarError):
            earlier = read_without_tables(path)
            if is_same(earlier, here) is not (path not in places):
                continue
            facts = f"({_described(earlier)}; here {_described(here)})"
            what = f"belongs to a different capture from {here.label} here {facts}"
            if path not in places:
                what = f"is of the same capture as {here.label} here, by a run on a folder above or below the one here"
            raise ConfigurationError(f"{path}: {what}; choose another output folder with -o")


def _described(capture: Capture | Sidecar) -> str:
    """Camera, time and id, as far as they are known."""
    camera = capture.camera
    name = " ".join(filter(None, (camera.make, camera.model, camera.serial)))
    time = capture.captured_at if isinstance(capture, Sidecar) else capture.known_time
    known = filter(None, (name, time, capture.capture_id))
    return ", ".join(known) or "without tags"


@dataclass(frozen=True)
class Remaining:
    """What remains to be done for a capture."""

    step: Literal["nothing", "render", "estimate"]
    """The first step; rendering follows the estimation."""
    changed: tuple[str, ...] = ()
    """What has changed since an earlier command has done it; empty if none has."""
    earlier: Sidecar | None = None
    """The result of the earlier command, without its tables, if the estimation is kept."""


def remaining(capture: Capture, out: Path, settings: Settings, options: RunOptions) -> Remaining:
    """Return what remains to be done for a capture, given what the output folder has of it.

    The estimation is kept if all that it depends on is unchanged: options, version, input. So are products, if their
    files exist too, and there are all those that the settings ask for.
    """
    path = CapturePaths.of(capture, out).sidecar
    try:
        earlier = read_without_tables(path)
    except SidecarError:
        return Remaining("estimate")
    if earlier.estimated_with != estimation_fingerprint(capture, settings):
        stages = [(key, stage) for key, stage in settings if key != "write"]
        changed = _changed_options(earlier, settings, stages) + _changed_version(earlier)
        other = "input files or tags" if earlier.estimated_with else "format of the sidecar"
        return Remaining("estimate", changed or (other,))
    parallax = [] if earlier.parallax is None else [earlier.parallax]
    if options.overwrite or (options.retry_failed and earlier.status != "ok"):
        return Remaining("estimate")
    if not outputs_exist(path, parallax):
        return Remaining("estimate", ("the parallax file",))
    write = with_earlier_products(settings.write, earlier, path.parent)
    all_settings = settings.model_copy(update={"write": write})
    changed = _changed_options(earlier, all_settings, [("write", write)])
    if earlier.rendered_with and earlier.rendered_with != render_fingerprint(capture, write):
        changed = changed or ("tags, panels or bands of the camera",)
    if not outputs_exist(path, earlier.products):
        changed = (*changed, "files that are missing")
    if changed or earlier.not_written or not earlier.rendered_with:
        return Remaining("render", changed, earlier)
    return Remaining("nothing", (), earlier)


def _changed_options(
    earlier: Sidecar, settings: Settings, stages: Sequence[tuple[str, SettingsModel]]
) -> tuple[str, ...]:
    """Return the flags of the options of some stages that have changed; indices are changed if some are missing."""
    before, now = earlier.options or {}, settings.model_dump(mode="json", exclude_defaults=True)
    return tuple(
        type(stage).flag(name)
        for key, stage in stages
        for name in type(stage).model_fields
        if before.get(key, {}).get(name) != now.get(key, {}).get(name)
        and not (name == "indices" and _has_indices(earlier, settings.write.indices))
    )


def _has_indices(earlier: Sidecar, names: Sequence[str]) -> bool:
    """Return True if all indices were requested before, or exist."""
    files = {part.file for part in earlier.products if part.kind == "index"}
    requested = (earlier.options or {}).get("write", {}).get("indices", [])
    return all(name in requested or f"{earlier.capture}_{name}.tif" in files for name in names)


def _changed_version(earlier: Sidecar) -> tuple[str, ...]:
    return () if earlier.agalign == __version__ else (f"version (agalign {earlier.agalign} before)",)


def outputs_exist(sidecar: Path, files: Sequence[FilePart]) -> bool:
    """Return True if a sidecar and files that it lists exist, these with their sizes; checksums would take minutes."""
    try:
        states = [((sidecar.parent / part.file).stat(), part.bytes) for part in files]
    except OSError:
        return False
    return sidecar.is_file() and all(stat.S_ISREG(one.st_mode) and one.st_size == size for one, size in states)
