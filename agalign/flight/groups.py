"""Which captures belong together: those of one camera and one flight, and the name of what they share."""

import re
from collections.abc import Iterable, Sequence

from agalign.values.capture import Capture

_LONGEST_STEM = 60
"""Systems bear 255 bytes in a name, of which a letter may take four."""


def camera_key(capture: Capture) -> str:
    """Captures with the same key were taken by the same camera, with the same bands and reference."""
    camera = capture.camera
    bands = ", ".join(f"{b.name} {b.width_px}x{b.height_px}" for b in (capture.reference, *capture.moving))
    return f"{camera.make} {camera.model} {camera.serial}".strip() + f" [{bands}]"


def flight_key(capture: Capture) -> tuple[str, str]:
    """(camera, flight id): captures with the same key belong to one flight."""
    return camera_key(capture), capture.flight_id


def flights_of(captures: Iterable[Capture]) -> list[list[Capture]]:
    """The captures grouped by camera and flight, in their order."""
    groups: dict[tuple[str, str], list[Capture]] = {}
    for capture in captures:
        groups.setdefault(flight_key(capture), []).append(capture)
    return list(groups.values())


def model_names(groups: Sequence[Sequence[Capture]]) -> list[str]:
    """A file name for each group's model: the camera, and a number where that name is taken."""
    names: list[str] = []
    taken: set[str] = set()
    for group in groups:
        camera = group[0].camera
        stem = re.sub(r"[^\w.+-]+", "_", f"{camera.model} {camera.serial}".strip()) or "camera"
        stem = stem.lstrip(".")[:_LONGEST_STEM] or "camera"
        given, count = stem, 1
        while given.lower() in taken:
            count += 1
            given = f"{stem}-{count}"
        taken.add(given.lower())
        names.append(f"{given}.safetensors")
    return names
