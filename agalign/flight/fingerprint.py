"""Fingerprints: hashes of everything that a result depends on."""

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from agalign._version import __version__
from agalign.config import Settings, SettingsModel
from agalign.values.capture import Capture
from agalign.values.files import open_regular
from agalign.values.lens import Lens

Fact = str | int | float | bool | None | np.ndarray | Lens | Sequence["Fact"]


def fingerprint(capture: Capture, *stages: SettingsModel) -> str:
    """Return the hash of the files of a capture, the metadata of its bands, settings and the version of agalign.

    It does not depend on the other captures of the flight, so results remain valid when captures are added.
    """
    bands: list[Fact] = []
    for b in capture.bands:
        calibration = None if b.radiometry is None else (b.radiometry.quantity, b.radiometry.gain)
        bands.append((b.name, b.address, b.lens, b.to_rig, b.georeference is not None, _state(b.path), calibration))
    return hashed(__version__, *(s.model_dump_json() for s in stages), capture.reference_index, bands)


def refinement_key(capture: Capture, settings: Settings) -> str:
    """Return the hash of everything that the refined mappings of a capture depend on, apart from the network.

    It contains the label: files of two folders may have equal names, sizes and times.
    """
    return hashed(capture.label, fingerprint(capture, settings.joint, settings.seed, settings.flight))


def hashed(*facts: Fact) -> str:
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
