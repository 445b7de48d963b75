"""Charts of the light over a flight: the irradiance by the light sensor, and the factors by panels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agalign.products.report.rigs import FlightChart, lines_of
from agalign.products.sidecar import Sidecar


@dataclass(frozen=True)
class CaptureLight:
    """The light of a capture by band."""

    camera: str
    """With its serial number."""
    captured_at: str
    label: str
    irradiance: Mapping[str, float]
    """By the light sensor, in its unit."""
    by_panel: Mapping[str, float]
    """Radiance of a white panel at the time of the capture, as it was used; empty without a panel."""

    @property
    def order(self) -> tuple[str, str, str]:
        """Sort by camera and time."""
        return self.camera, self.captured_at, self.label


def light_of(label: str, sidecar: Sidecar) -> CaptureLight:
    """Return the light of a capture from its sidecar."""
    output = sidecar.output
    bands = [] if output is None else output.illumination
    has_panel = output is not None and output.panel_age_s is not None
    camera = f"{sidecar.camera.name} {sidecar.camera.serial}".strip() or "unknown camera"
    return CaptureLight(
        camera,
        sidecar.captured_at,
        label,
        {b.band: b.irradiance for b in bands if b.irradiance is not None},
        {b.band: 1 / b.reflectance_per_radiance for b in bands if has_panel},
    )


def light_charts(captures: Sequence[CaptureLight]) -> list[FlightChart]:
    """Return the charts of each camera with known light in at least three captures."""
    charts = []
    min_captures = 3
    for camera in sorted({c.camera for c in captures}):
        of_camera = sorted((c for c in captures if c.camera == camera), key=lambda c: c.order)
        for caption, values in (
            ("Irradiance on a horizontal plane by the light sensor", [(c, c.irradiance) for c in of_camera]),
            ("Light by panels, at the time of each capture", [(c, c.by_panel) for c in of_camera]),
        ):
            known = [(c, light) for c, light in values if light]
            if len(known) >= min_captures:
                names = list(dict.fromkeys(name for _, light in known for name in light))
                light = np.array([[light.get(name, np.nan) for _, light in known] for name in names])
                changes = light / np.nanmedian(light, axis=1, keepdims=True) - 1
                full = max(0.01, float(np.nanmax(np.abs(changes))))  # smaller changes are noise
                ends = known[0][0].label, known[-1][0].label
                charts.append(FlightChart(f"{caption}: {camera}", full, lines_of(names, changes, full), ends))
    return charts
