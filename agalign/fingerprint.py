"""What a result depends on, as a short text that changes when it does."""

import hashlib
from pathlib import Path

from agalign._version import __version__
from agalign.config import Stage
from agalign.records import Capture


def fingerprint(capture: Capture, *stages: Stage) -> str:
    """Changes when the files of a capture, what is known of their camera, these settings or the program's version do.

    What the other captures of the flight are does not count: a result stays good when the card holds more.
    """
    bands = [(b.name, b.address, b.lens, b.to_rig, b.georeference is not None, _state(b.path)) for b in capture.bands]
    return hashed(__version__, *(s.model_dump_json() for s in stages), capture.reference_index, bands)


def hashed(*facts: object) -> str:
    """Sixteen digits of the facts' texts."""
    return hashlib.sha256(" ".join(map(str, facts)).encode()).hexdigest()[:16]


def _state(path: Path) -> tuple[int, int]:
    """Size and time of change: a file that was copied from the card again is another file."""
    try:
        state = path.stat()
    except OSError:
        return 0, 0
    return state.st_size, state.st_mtime_ns
