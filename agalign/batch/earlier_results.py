"""Results of earlier runs in the output folder: whether they are of the same captures, and what has changed since."""

import stat
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import timedelta
from itertools import chain
from pathlib import Path

from agalign._version import __version__
from agalign.config import Settings
from agalign.errors import ConfigurationError, SidecarError
from agalign.flight.fingerprint import fingerprint, input_samples
from agalign.products.product import CapturePaths
from agalign.products.sidecar.file import read_result
from agalign.products.sidecar.schema import CaptureResult
from agalign.values.capture import Capture, CaptureTime

_MAX_APART = timedelta(seconds=1)
"""The bands of a capture are exposed within 0.3 s, and its time is that of the reference, which an option chooses."""


def is_same(earlier: CaptureResult, capture: Capture) -> bool | None:
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


def refuse_other_captures(captures: Sequence[Capture], out: Path) -> None:
    """Raise ConfigurationError if the place of a capture has the result of another one, or if another place has its
    result, as of a run on the folder above.
    """
    places = {CapturePaths.of(c, out).sidecar: c for c in captures}
    by_name: dict[str, list[Capture]] = {}
    for capture in captures:
        by_name.setdefault(capture.name, []).append(capture)
    elsewhere = [p for p in out.rglob("*.json") if p.stem in by_name and p not in places]
    for path, here in chain(places.items(), ((p, c) for p in elsewhere for c in by_name[p.stem])):
        with suppress(SidecarError):
            earlier = read_result(path)
            if is_same(earlier, here) is not (path not in places):
                continue
            what = f"is of another capture than {here.label} here ({_described(earlier)}; here {_described(here)})"
            if path not in places:
                what = f"is of the same capture as {here.label} here, by a run on a folder above or below the one here"
            raise ConfigurationError(f"{path}: {what}; choose another output folder with -o")


def _described(capture: Capture | CaptureResult) -> str:
    """Camera, time and id, as far as they are known."""
    camera = capture.camera
    name = " ".join(filter(None, (camera.make, camera.model, camera.serial)))
    known = filter(None, (name, capture.captured_at, capture.capture_id))
    return ", ".join(known) or "without tags"


def changes(earlier: CaptureResult, capture: Capture, settings: Settings) -> tuple[str, ...]:
    """Return what has changed since a result was written, as far as the results of this capture depend on it: options,
    version, input.
    """
    if earlier.settings == fingerprint(capture, settings):
        return ()
    before, now = earlier.options or {}, settings.model_dump(mode="json", exclude_defaults=True)
    result = [
        type(stage).flag(name)
        for key, stage in settings
        for name in type(stage).model_fields
        if before.get(key, {}).get(name) != now.get(key, {}).get(name)
    ]
    if earlier.agalign != __version__:
        result.append(f"version (agalign {earlier.agalign} before)")
    return tuple(result) or ("input files, tags or panels",)


def outputs_exist(sidecar: Path, files: Mapping[str, int]) -> bool:
    """Return True if a sidecar and every file that it lists exist, these with their sizes; checksums would take
    minutes.
    """
    try:
        states = [((sidecar.parent / name).stat(), size) for name, size in files.items()]
    except OSError:
        return False
    return sidecar.is_file() and all(stat.S_ISREG(one.st_mode) and one.st_size == size for one, size in states)
