"""OUT/flight.geojson: where the captures of a run are on the ground, with what became of them."""

import json
from pathlib import Path
from typing import Any

from agalign.products.footprint import accuracy_of_footprint_m, footprint, with_assumed_height
from agalign.products.product import CapturePaths
from agalign.products.sidecar import BandResult, CaptureResult
from agalign.values.capture import Capture
from agalign.values.files import write_text
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import PixelScale

FLIGHT_MAP_FILE = "flight.geojson"
_WITHOUT_FOOTPRINT = ("panel", "sky")
_DECIMALS = 7
"""Of degrees: a centimetre."""


class FlightMap:
    """The features of a run's captures, collected one by one."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._features: dict[str, dict[str, Any]] = {}

    def add(self, capture: Capture, status: str, result: CaptureResult | None = None) -> None:
        """Add a capture, with what its sidecar contains where it has one.

        Its geometry is the footprint of its aligned rasters, or of the reference where there are none; the position of
        the camera where the footprint is unknown; nothing where that is unknown too.
        """
        # Panels are photographed from a metre, and the sky has no footprint.
        shown = capture if status in _WITHOUT_FOOTPRINT else with_assumed_height(capture)
        ring = footprint(shown, _grid(capture, result))
        position, pose = shown.position, shown.pose
        place: dict[str, Any] | None = None
        if ring is not None:
            # GeoJSON wants outer rings counter-clockwise.
            place = {"type": "Polygon", "coordinates": [ring[::-1].round(_DECIMALS).tolist()]}
        elif position is not None:
            place = {"type": "Point", "coordinates": [position.longitude, position.latitude]}
        known = ring is not None and capture.reference.georeference is None and pose is not None
        properties = {
            "capture": capture.label, "status": status,
            "camera": f"{capture.camera.make} {capture.camera.model}".strip(), "captured_at": capture.captured_at,
            "longitude": None if position is None else position.longitude,
            "latitude": None if position is None else position.latitude,
            "altitude_m": None if position is None else position.altitude_m,
            "height_m": None if pose is None or pose.height_m is None else round(pose.height_m, 1),
            "height_from": None if pose is None or pose.height_m is None else pose.height_from,
            "heading_deg": None if pose is None else round(pose.heading_deg, 1),
            "accuracy_m": accuracy_of_footprint_m(shown) if known else _given_accuracy_m(capture),
        }  # fmt: skip
        properties |= _of_result(result) | self._links(capture, result)
        self._features[capture.label] = {"type": "Feature", "id": capture.label, "geometry": place} | {
            "properties": properties
        }

    def write(self) -> Path | None:
        """Write the map atomically; None where no capture has a place. Raises OutputError."""
        features = [self._features[label] for label in sorted(self._features)]
        if not any(f["geometry"] for f in features):
            return None
        path = self._out / FLIGHT_MAP_FILE
        lines = ",\n".join(json.dumps(f, ensure_ascii=False) for f in features)
        write_text(path, f'{{"type": "FeatureCollection", "name": "flight", "features": [\n{lines}\n]}}\n')
        return path

    def _links(self, capture: Capture, result: CaptureResult | None) -> dict[str, Any]:
        """Files relative to the output folder."""
        links: dict[str, Any] = {"sidecar": None, "stack": None, "picture": None, "indices": []}
        if result is None:
            return links
        folder = capture.folder.as_posix()
        prefix = "" if folder == "." else f"{folder}/"
        files = {part.kind: f"{prefix}{part.file}" for part in result.products}
        sidecar = CapturePaths.of(capture, self._out).sidecar
        links |= {"sidecar": f"{prefix}{sidecar.name}", "stack": files.get("stack"), "picture": files.get("picture")}
        indices = [f"{prefix}{p.file}" for p in result.products if p.kind == "index" and p.file.endswith(".tif")]
        return links | {"indices": indices}


def _grid(capture: Capture, result: CaptureResult | None) -> OutputGrid:
    if result is None or result.output is None:
        return OutputGrid(0, 0, *capture.reference.size_px)
    return OutputGrid(*result.output.crop, PixelScale(*result.output.scale))


def _given_accuracy_m(capture: Capture) -> float | None:
    georeference = capture.reference.georeference
    return None if georeference is None else georeference.accuracy_m


def _of_result(result: CaptureResult | None) -> dict[str, Any]:
    """The number of bands and the residuals of the band with the largest ones, px of the reference."""
    bands: list[BandResult] = [] if result is None else [b for b in result.bands if b.status != "reference"]
    after = [b.metrics.after for b in bands if b.metrics is not None]
    return {
        "bands": len(bands),
        "bands_aligned": sum(b.status == "aligned" for b in bands),
        "bands_predicted": sum(b.status == "predicted" for b in bands),
        "residual_px": max((a.residual_px for a in after if a.residual_px is not None), default=None),
        "residual_p95_px": max((a.residual_p95_px for a in after if a.residual_p95_px is not None), default=None),
    }
