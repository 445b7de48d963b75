"""Groups of captures that one camera took in one flight, and the file names of their models."""

import re
from collections.abc import Iterable, Sequence

from agalign.values.capture import Band, Capture

_LONGEST_STEM = 60
"""File names may have 255 bytes, and a letter may take four."""


def camera_key(capture: Capture) -> str:
    """The camera and the reference band: captures with different keys are never of one flight."""
    return _key(capture, [capture.reference])


def flight_camera(captures: Sequence[Capture]) -> str:
    """The camera of a flight with all bands that some of its captures have, the reference first."""
    return _key(captures[0], _bands_of(captures))


def flight_lenses(captures: Sequence[Capture]) -> tuple[str, ...]:
    """Names of the moving bands of a flight, one for each lens, in the order of its most complete capture."""
    return tuple(dict.fromkeys(bands[0].name for c in _by_completeness(captures) for bands in c.moving_lenses))


def is_flight_of(captures: Sequence[Capture], camera: str) -> bool:
    """True where a model of this `flight_camera` fits a flight: all of its bands are among the model's."""
    if camera in ("", flight_camera(captures)):
        return True
    reference = camera_key(captures[0]).removesuffix("]")
    known = camera.removeprefix(reference).removesuffix("]").split(", ")
    return camera.startswith(reference) and {_with_size(b) for b in _bands_of(captures)[1:]} <= set(known)


def flight_key(capture: Capture) -> tuple[str, str]:
    """(camera, flight id): captures with different keys are never of one flight."""
    return camera_key(capture), capture.flight_id


def flights_of(captures: Iterable[Capture]) -> list[list[Capture]]:
    """The captures grouped by camera and flight, in their order.

    A capture that lacks a band belongs to the flight of the captures that have it. Bands of one name and different
    sizes are of different flights.
    """
    flights: list[list[Capture]] = []
    of_camera: dict[tuple[str, str], list[tuple[dict[str, tuple[int, int]], list[Capture]]]] = {}
    for capture in captures:
        sizes = {b.name: b.size_px for b in capture.bands}
        same_camera = of_camera.setdefault(flight_key(capture), [])
        for known, flight in same_camera:
            if all(known.get(name, size) == size for name, size in sizes.items()):
                known.update(sizes)
                flight.append(capture)
                break
        else:
            flights.append([capture])
            same_camera.append((sizes, flights[-1]))
    return flights


def _key(capture: Capture, bands: Sequence[Band]) -> str:
    camera = capture.camera
    listed = ", ".join(map(_with_size, bands))
    return f"{camera.make} {camera.model} {camera.serial}".strip() + f" [{listed}]"


def _with_size(band: Band) -> str:
    return f"{band.name} {band.width_px}x{band.height_px}"


def _bands_of(captures: Sequence[Capture]) -> list[Band]:
    """One band of each name, the reference first."""
    result = {captures[0].reference.name: captures[0].reference}
    for capture in _by_completeness(captures):
        for band in capture.moving:
            result.setdefault(band.name, band)
    return list(result.values())


def _by_completeness(captures: Sequence[Capture]) -> list[Capture]:
    return sorted(captures, key=lambda c: -len(c.bands))


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
