"""Fingerprints: hashes of everything that a result depends on."""

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from agalign._version import __version__
from agalign.config import Settings, SettingsModel, WriteSettings
from agalign.flight.groups import flight_camera
from agalign.values.capture import Capture
from agalign.values.files import open_regular
from agalign.values.lens import Lens

HashInput = str | int | float | bool | None | np.ndarray | Lens | Sequence["HashInput"]


def estimation_fingerprint(capture: Capture, settings: Settings) -> str:
    """Return the hash of everything that the estimation of a capture depends on.

    That is not the other captures of the flight, so results remain valid when captures are added.
    """
    return _fingerprint(capture, *(stage for key, stage in settings if key != "write"))


def learning_fingerprint(captures: Sequence[Capture], settings: Settings) -> str:
    """Return the hash of everything that the model of a flight depends on.

    It contains the labels: files of two folders may have equal names, sizes and times.
    """
    stages = settings.joint, settings.seed, settings.flight
    return hashed(str(flight_camera(captures)), *((c.label, _fingerprint(c, *stages)) for c in captures))


def render_fingerprint(capture: Capture, settings: WriteSettings) -> str:
    """Return the hash of everything that the products of an estimated capture depend on, apart from the list of
    indices, which are independent of each other.
    """
    facts: list[HashInput] = []
    for b in capture.stack_bands:
        calibration = None if b.radiometry is None else (b.radiometry.quantity, b.radiometry.gain)
        georeference = None if b.georeference is None else b.georeference.transform
        facts.append((b.name, calibration, georeference))
    return hashed(__version__, settings.model_dump_json(exclude={"indices"}), repr(capture.pose), facts)


def _fingerprint(capture: Capture, *stages: SettingsModel) -> str:
    """Return the hash of the files of a capture, the tags that the estimation uses, settings and the version."""
    bands: list[HashInput] = []
    for b in capture.bands:
        # A georeference by the pose of the camera is for the output alone.
        is_georeferenced = b.georeference is not None and b.georeference.accuracy_m is None
        bands.append((b.name, b.address, b.lens, b.to_rig, is_georeferenced, _state(b.path)))
    unreadable = sorted(capture.unreadable_bands)
    return hashed(__version__, *(s.model_dump_json() for s in stages), capture.reference_index, bands, *unreadable)


def hashed(*facts: HashInput) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of the facts."""
    return hashlib.sha256(json.dumps(facts, default=_plain).encode()).hexdigest()[:16]


def input_samples(capture: Capture) -> dict[str, str]:
    """Return a hash of the size and of three parts of the file of each band: the images of two captures differ in it.

    Files that cannot be read are left out.
    """
    part_bytes = 1 << 14
    samples: dict[Path, str] = {}
    for path in {b.path for b in capture.bands}:
        with suppress(OSError), open_regular(path) as file:
            size = file.seek(0, os.SEEK_END)
            parts = [file.read(part_bytes) for k in range(3) if file.seek(k * max(0, size - part_bytes) // 2) >= 0]
            samples[path] = hashlib.sha256(b"%d " % size + b"".join(parts)).hexdigest()[:16]
    return {b.name: samples[b.path] for b in capture.bands if b.path in samples}


def _plain(fact: np.ndarray | Lens) -> object:
    """Return an array as a list and a lens as its fields, for `json.dumps`."""
    return fact.tolist() if isinstance(fact, np.ndarray) else vars(fact)


def _state(path: Path) -> tuple[int, int]:
    """Return the size and the modification time of a file, zeros if it cannot be read."""
    with suppress(OSError):
        status = path.stat()
        return status.st_size, status.st_mtime_ns
    return 0, 0
