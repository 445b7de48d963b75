"""Grouping of captures by camera and flight, and the file names of their models."""

import re
from collections.abc import Iterable, Sequence

from agalign.values.capture import Band, Capture

_MAX_STEM_CHARACTERS = 60
"""File names may have 255 bytes, and a character may take four."""


def camera_key(capture: Capture) -> str:
    """Return the camera and the reference band; captures of one flight have equal keys."""
    return _key(capture, [capture.reference])


def flight_camera(captures: Sequence[Capture]) -> str:
    """Return the camera of a flight and all bands in its captures, the reference first."""
    return _key(captures[0], _bands_of(captures))


def flight_lenses(captures: Sequence[Capture]) -> tuple[str, ...]:
    """Return the names of the moving bands of a flight, one for each lens, most complete capture first."""
    return tuple(dict.fromkeys(bands[0].name for c in _by_completeness(captures) for bands in c.moving_lenses))


def is_flight_of(captures: Sequence[Capture], camera: str) -> bool:
    """Return True if a model learned for `camera`, a `flight_camera`, contains all bands of a flight.

    An empty `camera` fits every flight.
    """
    if camera in ("", flight_camera(captures)):
        return True
    reference = camera_key(captures[0]).removesuffix("]")
    model_bands = camera.removeprefix(reference).removesuffix("]").split(", ")
    return camera.startswith(reference) and {_with_size(b) for b in _bands_of(captures)[1:]} <= set(model_bands)


def flight_key(capture: Capture) -> tuple[str, str]:
    """Return (camera, flight id); captures of one flight have equal keys."""
    return camera_key(capture), capture.flight_id


def flights_of(captures: Iterable[Capture]) -> list[list[Capture]]:
    """Group captures by camera and flight, in their order.

    A capture may lack bands of its flight. Captures with bands of the same name and different sizes are assigned to
    different flights.
    """
    flights: list[list[Capture]] = []
    by_key: dict[tuple[str, str], list[tuple[dict[str, tuple[int, int]], list[Capture]]]] = {}
    for capture in captures:
        sizes = {b.name: b.size_px for b in capture.bands}
        same_key = by_key.setdefault(flight_key(capture), [])
        for flight_sizes, flight in same_key:
            if all(flight_sizes.get(name, size) == size for name, size in sizes.items()):
                flight_sizes.update(sizes)
                flight.append(capture)
                break
        else:
            flights.append([capture])
            same_key.append((sizes, flights[-1]))
    return flights


def _key(capture: Capture, bands: Sequence[Band]) -> str:
    camera = capture.camera
    return f"{camera.make} {camera.model} {camera.serial}".strip() + f" [{', '.join(map(_with_size, bands))}]"


def _with_size(band: Band) -> str:
    return f"{band.name} {band.width_px}x{band.height_px}"


def _bands_of(captures: Sequence[Capture]) -> list[Band]:
    """Return one band of each name, the reference first."""
    result = {captures[0].reference.name: captures[0].reference}
    for capture in _by_completeness(captures):
        for band in capture.moving:
            result.setdefault(band.name, band)
    return list(result.values())


def _by_completeness(captures: Sequence[Capture]) -> list[Capture]:
    return sorted(captures, key=lambda c: -len(c.bands))


def model_names(groups: Sequence[Sequence[Capture]]) -> list[str]:
    """Return a unique file name for the model of each group: the camera, with a number if it occurs again."""
    names: list[str] = []
    used: set[str] = set()
    for group in groups:
        camera = group[0].camera
        stem = re.sub(r"[^\w.+-]+", "_", f"{camera.model} {camera.serial}".strip())
        stem = stem.lstrip(".")[:_MAX_STEM_CHARACTERS] or "camera"
        name, count = stem, 1
        while name.lower() in used:
            count += 1
            name = f"{stem}-{count}"
        used.add(name.lower())
        names.append(f"{name}.safetensors")
    return names
