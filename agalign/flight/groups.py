"""Captures of one camera and flight: grouping, the file names of their models, an overview of each camera."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median, mode
from typing import Self

from agalign.cameras.grouping import usual_bands
from agalign.host.files import file_name
from agalign.host.text import counted
from agalign.pixels.radiometry import with_radiometry
from agalign.values.capture import Band, Capture
from agalign.values.choices import RadiometryChoice


@dataclass(frozen=True)
class FlightCamera:
    """The camera of a flight, with all bands in its captures."""

    name: str
    """Make, model and serial number; empty if the tags contain none of them."""
    bands: tuple[tuple[str, int, int], ...]
    """Name, width and height in px of each band, the reference first."""

    @classmethod
    def of(cls, capture: Capture, bands: Iterable[Band]) -> Self:
        """Return the camera of a capture, with these bands."""
        camera = capture.camera
        name = f"{camera.make} {camera.model} {camera.unit}".strip()
        return cls(name, tuple((b.name, *b.size_px) for b in bands))

    @property
    def described_bands(self) -> list[str]:
        """Name and size of each band, in words."""
        return [f"{name} {width}x{height}" for name, width, height in self.bands]

    def __str__(self) -> str:
        return f"{self.name} [{', '.join(self.described_bands)}]"


def camera_key(capture: Capture) -> str:
    """Return the camera and the reference band; captures of one flight have equal keys."""
    return str(FlightCamera.of(capture, [capture.reference]))


def flight_camera(captures: Sequence[Capture]) -> FlightCamera:
    """Return the camera of a flight and all bands in its captures, the reference first."""
    bands = {captures[0].reference.name: captures[0].reference}
    for band in (b for c in _by_completeness(captures) for b in c.moving):
        bands.setdefault(band.name, band)
    return FlightCamera.of(captures[0], bands.values())


def flight_lenses(captures: Sequence[Capture]) -> tuple[str, ...]:
    """Return the names of the moving bands of a flight, one for each lens, most complete capture first."""
    return tuple(dict.fromkeys(bands[0].name for c in _by_completeness(captures) for bands in c.moving_lenses))


def is_flight_of(captures: Sequence[Capture], camera: FlightCamera | None) -> bool:
    """Return True if a model learned for `camera`, a `flight_camera`, contains all bands of a flight.

    A model that was learned for no camera in particular, None, fits every flight.
    """
    return camera is None or not difference(camera, flight_camera(captures))


def difference(learned: FlightCamera, here: FlightCamera) -> str:
    """Return in words why a model, learned for a `flight_camera`, does not contain all bands of another; empty if it
    does.
    """
    names = [camera.name or "a camera without tags" for camera in (learned, here)]
    bands, own_bands = learned.described_bands, here.described_bands
    if learned.name != here.name:
        return f"was learned for {names[0]}; the images here are of {names[1]}"
    if bands[0] != own_bands[0]:
        return f"was learned with the reference {bands[0]}; the reference here is {own_bands[0]}"
    missing = [b for b in own_bands if b not in bands]
    return f"was learned without {', '.join(missing)}" if missing else ""


def flights_of(captures: Iterable[Capture]) -> list[list[Capture]]:
    """Group captures by camera and flight, in their order.

    A capture may lack bands of its flight. Captures with bands of the same name and different sizes are assigned to
    different flights.
    """
    flights: list[list[Capture]] = []
    by_key: dict[tuple[str, str], list[tuple[dict[str, tuple[int, int]], list[Capture]]]] = {}
    for capture in captures:
        sizes = {b.name: b.size_px for b in capture.bands}
        same_key = by_key.setdefault((camera_key(capture), capture.flight_id), [])
        fitting = (f for f in same_key if all(f[0].get(name, size) == size for name, size in sizes.items()))
        flight_sizes, flight = next(fitting, ({}, []))
        if not flight:
            flights.append(flight)
            same_key.append((flight_sizes, flight))
        flight_sizes.update(sizes)
        flight.append(capture)
    return flights


def model_name(capture: Capture, number: int = 1) -> str:
    """Return the file name of a model of a capture's camera; further models of the camera have a `number` from 2 on."""
    stem = file_name(f"{capture.camera.model} {capture.camera.unit}".strip() or "camera")
    return f"{stem}.safetensors" if number == 1 else f"{stem}-{number}.safetensors"


@dataclass(frozen=True)
class CameraOverview:
    """The captures of one camera below a folder."""

    camera: str
    serial: str
    captures: int
    bands: tuple[str, ...]
    size_px: tuple[int, int]
    """(width, height) of the reference."""
    first_at: str
    last_at: str
    height_m: float | None
    """Median height above the ground; None if neither the tags nor a panel give it."""
    altitude_m: tuple[float, float] | None
    """Minimum and maximum altitude in the tags, above sea level or an ellipsoid."""
    gsd_m: float | None
    """Median ground sample distance of the reference."""
    radiometry: tuple[RadiometryChoice, ...]
    """Values of `--radiometry` that the tags of all captures support, except those of a panel; `panel` if a capture
    shows one, whose reflectance may have to be given."""
    radiometry_std_percent: tuple[float, ...] = ()
    """Expected error of the values by each of `radiometry` but the panel, percent: the largest of all bands."""
    uncorrected: tuple[str, ...] = ()
    """What the values are not corrected for, because the tags lack it."""
    missing_calibration: str = ""
    """Missing or unused tags that prevent a calibration, in words."""
    gsd_per_height: float | None = None
    """Ground sample distance per metre of height, from the focal length of the reference."""

    @property
    def text(self) -> str:
        """The overview in one line."""
        serial, captures = f" ({self.serial})" if self.serial else "", counted(self.captures, "capture")
        parts = [f"{self.camera}{serial}: {captures} of {len(self.bands)} bands", "{} x {} px".format(*self.size_px)]
        if self.gsd_m is not None and self.height_m is not None:
            parts.append(f"GSD {100 * self.gsd_m:.1f} cm from {self.height_m:.0f} m above the ground")
        elif self.altitude_m is not None:
            bounds_m = dict.fromkeys(f"{a:.0f}" for a in self.altitude_m)
            parts.append(f"altitude {' to '.join(bounds_m)} m, height above the ground unknown")
        if self.gsd_m is None and self.gsd_per_height is not None:
            parts.append(f"GSD {1e4 * self.gsd_per_height:.1f} cm at a height of 100 m")
        kinds = {
            "camera": "radiance by calibration",
            "sun": "reflectance by light sensor",
            "panel": "reflectance by calibration panel",
        }
        none = self.missing_calibration or "none in the tags"
        errors = dict(zip(self.radiometry, self.radiometry_std_percent, strict=False))
        named = [f"{kinds[r]} (± {errors[r]:.0f} %)" if errors.get(r) else kinds[r] for r in self.radiometry]
        parts.append(f"radiometry: {', '.join(named) or none}")
        parts += [f"not corrected for {' and '.join(self.uncorrected)}"] if self.uncorrected else []
        return ", ".join(parts)


def camera_overviews(captures: Sequence[Capture]) -> list[CameraOverview]:
    """Return an overview for each camera, in the order of their first captures."""
    groups: dict[tuple[str, str], list[Capture]] = {}
    for capture in captures:
        groups.setdefault((capture.camera.name or "unknown camera", capture.camera.unit), []).append(capture)
    return [_overview(name, serial, group) for (name, serial), group in groups.items()]


def _overview(name: str, serial: str, captures: Sequence[Capture]) -> CameraOverview:
    height_m, gsd_m = _median_height_and_gsd_m(captures)
    altitudes_m = [c.altitude_m for c in captures if c.altitude_m is not None]
    times = sorted({c.known_time for c in captures} - {""}) or [""]
    to_align = [c for c in captures if not c.is_of_a_panel] or captures
    choices: tuple[RadiometryChoice, ...] = ("camera", "sun")
    converted = {
        choice: [b for c in to_align for b in with_radiometry(c, choice, {}).bands if not b.is_from_photograph]
        for choice in choices
    }
    supported = [choice for choice, bands in converted.items() if all(b.radiometry is not None for b in bands)]
    of_choice = [[b.radiometry for b in converted[choice] if b.radiometry is not None] for choice in supported]
    std_percent = tuple(max((r.std_percent for r in of), default=0.0) for of in of_choice)
    uncorrected = dict.fromkeys(name for of in of_choice for r in of for name in r.uncorrected)
    if "camera" in supported and any(c.panel is not None for c in captures):
        supported.append("panel")
    reference = mode(c.reference.name for c in captures)
    typical = next(c for c in captures if c.reference.name == reference)
    return CameraOverview(
        camera=name,
        serial=serial,
        captures=len(captures),
        bands=tuple(usual_bands(captures) or (b.name for b in typical.bands)),
        size_px=typical.reference.size_px,
        first_at=times[0],
        last_at=times[-1],
        height_m=height_m,
        altitude_m=(min(altitudes_m), max(altitudes_m)) if altitudes_m else None,
        gsd_m=gsd_m,
        gsd_per_height=_gsd_per_height(typical),
        missing_calibration=next(
            (b.missing_calibration for c in captures for b in c.bands if b.missing_calibration), ""
        ),
        radiometry=tuple(supported),
        radiometry_std_percent=std_percent,
        uncorrected=tuple(uncorrected),
    )


def _median_height_and_gsd_m(captures: Sequence[Capture]) -> tuple[float | None, float | None]:
    """Return the medians of the heights and of the ground sample distances; None if all are unknown."""
    poses = [(c.pose.height_m, c.pose.focal_length_px) for c in captures if c.pose and c.pose.height_m is not None]
    heights_m = [height_m for height_m, _ in poses]
    gsds_m = [height_m / focal_px for height_m, focal_px in poses if focal_px]
    return median(heights_m) if heights_m else None, median(gsds_m) if gsds_m else None


def _gsd_per_height(capture: Capture) -> float | None:
    lens, pose = capture.reference.lens, capture.pose
    focal_px = lens.fx_px if lens is not None else None if pose is None else pose.focal_length_px
    return 1 / focal_px if focal_px else None


def _by_completeness(captures: Sequence[Capture]) -> list[Capture]:
    return sorted(captures, key=lambda c: -len(c.bands))
