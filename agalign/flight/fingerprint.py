"""Fingerprints: hashes of everything that a result depends on."""

import hashlib
import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from agalign._version import __version__
from agalign.config import CheckSettings, Settings, SettingsModel, WriteSettings
from agalign.flight.groups import flight_camera
from agalign.host.files import open_regular
from agalign.values.capture import Capture
from agalign.values.lens import Lens
from agalign.values.radiometric_errors import BRIGHT

HashInput = str | int | float | bool | None | np.ndarray | Lens | Sequence["HashInput"]


RENDER_STAGES = "write", "check"
"""Stages of the settings that change no mapping: a result with other ones is rendered again."""


def joined_options(estimated: Mapping[str, Any] | None, rendered: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the options of an estimation, and of a rendering of its result, by stage."""
    options = {key: stage for key, stage in (estimated or {}).items() if key not in RENDER_STAGES}
    return options | {key: stage for key, stage in (rendered or {}).items() if key in RENDER_STAGES}


def estimation_fingerprint(capture: Capture, settings: Settings) -> str:
    """Return the hash of what the estimation of a capture depends on, apart from the contents of its files: settings,
    version, choice of bands, and the tags that are used.

    That is not the other captures of the flight, so results remain valid when captures are added.
    """
    return _fingerprint(capture, *(stage for key, stage in settings if key not in RENDER_STAGES))


def learning_fingerprint(captures: Sequence[Capture], settings: Settings, read: Collection[str]) -> str:
    """Return the hash of everything that the model of a flight depends on: tags of all captures, and the files of those
    with the labels `read`, which learning may read.
    """
    stages = settings.joint, settings.seed, settings.flight
    facts = [(c.label, _fingerprint(c, *stages)) for c in captures]
    files = [(c.label, sorted(input_digests(c).items())) for c in captures if c.label in read]
    return hashed(str(flight_camera(captures)), *facts, *files)


def render_fingerprint(capture: Capture, write: WriteSettings, check: CheckSettings) -> str:
    """Return the hash of everything that the products of an estimated capture depend on, apart from the list of
    indices, which are independent of each other.
    """
    facts: list[HashInput] = []
    for b in capture.stack_bands:
        calibration: HashInput = None
        if b.radiometry is not None:
            # That of the pixels is not known before they are read, and they are compared by themselves.
            errors = [(e.name, e.std_percent, e.state) for e in b.radiometry.errors if e.name != BRIGHT]
            calibration = b.radiometry.quantity, b.radiometry.gain, errors, b.implausible
        georeference = None if b.georeference is None else b.georeference.transform
        facts.append((b.name, calibration, georeference))
    options = write.model_dump_json(exclude={"indices"}), check.model_dump_json()
    return hashed(__version__, *options, repr(capture.pose), repr(capture.camera), facts)


def _fingerprint(capture: Capture, *stages: SettingsModel) -> str:
    """Return the hash of the bands of a capture, the tags that the estimation uses, settings and the version."""
    bands: list[HashInput] = []
    for b in capture.bands:
        # A georeference by the pose of the camera is for the output alone.
        is_georeferenced = b.georeference is not None and b.georeference.accuracy_m is None
        bands.append((b.name, b.address, b.lens, b.to_rig, is_georeferenced))
    unreadable = sorted(capture.unreadable_bands)
    return hashed(__version__, *(s.model_dump_json() for s in stages), capture.reference_index, bands, *unreadable)


def hashed(*facts: HashInput) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of the facts."""
    return hashlib.sha256(json.dumps(facts, default=_plain).encode()).hexdigest()[:16]


def input_samples(capture: Capture) -> dict[str, str]:
    """Return a hash of the size and of three parts of the file of each band: the images of two captures differ in it.

    Files that cannot be read are left out.
    """
    return _of_files(capture, _samples)


def input_digests(capture: Capture) -> dict[str, str]:
    """Return the SHA-256 of the file of each band. Files that cannot be read are left out."""
    return _of_files(capture, lambda file: hashlib.file_digest(file, "sha256").hexdigest())


def input_states(capture: Capture) -> dict[str, str]:
    """Return the size of the file of each band, and the times of its last modification and change, ns.

    Any write changes the second time on POSIX systems, also if the first is set back. Files that cannot be read are
    left out.
    """
    return _of_files(capture, _state)


def _of_files(capture: Capture, function: Callable[[BufferedReader], str]) -> dict[str, str]:
    """Return the result of a function of an open file for each band."""
    facts: dict[Path, str] = {}
    for path in {b.path for b in capture.bands}:
        with suppress(OSError), open_regular(path) as file:
            facts[path] = function(file)
    return {b.name: facts[b.path] for b in capture.bands if b.path in facts}


def _samples(file: BufferedReader) -> str:
    part_bytes, size = 1 << 14, file.seek(0, os.SEEK_END)
    parts = [file.read(part_bytes) for k in range(3) if file.seek(k * max(0, size - part_bytes) // 2) >= 0]
    return hashlib.sha256(b"%d " % size + b"".join(parts)).hexdigest()[:16]


def _state(file: BufferedReader) -> str:
    status = os.fstat(file.fileno())
    return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"


def _plain(fact: np.ndarray | Lens) -> object:
    """Return an array as a list and a lens as its fields, for `json.dumps`."""
    return fact.tolist() if isinstance(fact, np.ndarray) else vars(fact)
