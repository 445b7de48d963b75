"""What a result depends on, as a short text that changes when it does."""

import hashlib
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from agalign._version import __version__
from agalign.config import Stage
from agalign.values.capture import Capture
from agalign.values.lens import Lens

Fact = str | int | float | bool | None | np.ndarray | Lens | Iterable["Fact"]


def fingerprint(capture: Capture, *stages: Stage) -> str:
    """Changes when the files of a capture, what is known of their camera, these settings or the program's version do.

    What the other captures of the flight are does not count: a result stays good when the card holds more.
    """
    bands = [
        (
            b.name, b.address, b.lens, b.to_rig, b.georeference is not None, _state(b.path),
            None if b.radiometry is None else (b.radiometry.quantity, b.radiometry.gain),
        )
        for b in capture.bands
    ]  # fmt: skip
    return hashed(__version__, *(s.model_dump_json() for s in stages), capture.reference_index, bands)


def hashed(*facts: Fact) -> str:
    """Sixteen digits of the facts, independent of numpy's print options."""
    return hashlib.sha256(b"".join(map(_canonical, facts))).hexdigest()[:16]


def _canonical(fact: Fact) -> bytes:
    """Bytes that no other fact has: a type, a length and the contents."""
    if isinstance(fact, Lens):
        return _canonical((fact.fx_px, fact.fy_px, fact.cx_px, fact.cy_px, fact.distortion))
    if isinstance(fact, np.ndarray):
        contents, kind = np.ascontiguousarray(fact, np.float64).tobytes(), b"a"
    elif isinstance(fact, float):
        contents, kind = struct.pack("<d", fact), b"f"
    elif fact is None or isinstance(fact, (str, int)):
        contents, kind = repr(fact).encode(), b"s"
    else:
        contents, kind = b"".join(map(_canonical, fact)), b"l"
    return kind + struct.pack("<Q", len(contents)) + contents


def _state(path: Path) -> tuple[int, int]:
    """Size and time of change: a file that was copied from the card again is another file."""
    try:
        state = path.stat()
    except OSError:
        return 0, 0
    return state.st_size, state.st_mtime_ns
