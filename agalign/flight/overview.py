"""Overview of the captures of each camera: number, bands, ground sample distance, height, radiometry."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from agalign.pixels.radiometry import with_radiometry
from agalign.values.capture import Capture
from agalign.values.choices import RadiometryChoice


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
    """Values of `--radiometry` that the tags of all captures support; panels are not considered."""
    gsd_per_height: float | None = None
    """Ground sample distance per metre of height, from the focal length of the reference."""

    @property
    def text(self) -> str:
        """The overview in one line."""
        count = f"{self.captures} capture{'' if self.captures == 1 else 's'}"
        serial = f" ({self.serial})" if self.serial else ""
        parts = [f"{self.camera}{serial}: {count} of {len(self.bands)} bands", "{} x {} px".format(*self.size_px)]
        if self.gsd_m is not None and self.height_m is not None:
            parts.append(f"GSD {100 * self.gsd_m:.1f} cm from {self.height_m:.0f} m above the ground")
        elif self.altitude_m is not None:
            low, high = (f"{a:.0f}" for a in self.altitude_m)
            parts.append(f"altitude {low if low == high else f'{low} to {high}'} m, height above the ground unknown")
        if self.gsd_m is None and self.gsd_per_height is not None:
            parts.append(f"GSD {1e4 * self.gsd_per_height:.1f} cm at a height of 100 m")
        kinds = {"camera": "radiance by calibration", "sun": "reflectance by light sensor"}
        parts.append(f"radiometry: {', '.join(kinds[r] for r in self.radiometry) or 'none in the tags'}")
        return ", ".join(parts)


def camera_overviews(captures: Sequence[Capture]) -> list[CameraOverview]:
    """Return an overview for each camera, in the order of their first captures."""
    groups: dict[tuple[str, str], list[Capture]] = {}
    for capture in captures:
        name = f"{capture.camera.make} {capture.camera.model}".strip() or "unknown camera"
        groups.setdefault((name, capture.camera.serial), []).append(capture)
    return [_overview(name, serial, group) for (name, serial), group in groups.items()]


def _overview(name: str, serial: str, captures: Sequence[Capture]) -> CameraOverview:
    poses = [c.pose for c in captures if c.pose is not None and c.pose.height_m is not None]
    heights_m = [p.height_m for p in poses if p.height_m is not None]
    gsds_m = [p.height_m / p.focal_length_px for p in poses if p.height_m is not None and p.focal_length_px]
    altitudes_m = [a for c in captures if c.position is not None and (a := c.position.altitude_m) is not None]
    times = sorted(c.captured_at for c in captures if c.captured_at)
    choices: tuple[RadiometryChoice, ...] = ("camera", "sun")
    return CameraOverview(
        camera=name, serial=serial, captures=len(captures),
        bands=tuple(dict.fromkeys(b.name for c in captures for b in c.bands)),
        size_px=captures[0].reference.size_px, first_at=times[0] if times else "", last_at=times[-1] if times else "",
        height_m=median(heights_m) if heights_m else None,
        altitude_m=(min(altitudes_m), max(altitudes_m)) if altitudes_m else None,
        gsd_m=median(gsds_m) if gsds_m else None,
        gsd_per_height=_gsd_per_height(captures[0]),
        radiometry=tuple(choice for choice in choices if all(_supports(c, choice) for c in captures)),
    )  # fmt: skip


def _gsd_per_height(capture: Capture) -> float | None:
    lens, pose = capture.reference.lens, capture.pose
    focal_px = lens.fx_px if lens is not None else None if pose is None else pose.focal_length_px
    return 1 / focal_px if focal_px else None


def _supports(capture: Capture, choice: RadiometryChoice) -> bool:
    bands = with_radiometry(capture, choice, {}).bands
    return all(b.radiometry is not None for b in bands if not b.companion)
