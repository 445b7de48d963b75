"""OUT/flight.geojson: the footprints of the captures of a run, with their results and links to their files.

It is a view of the sidecars, and of the captures of panels and of the sky that are not aligned.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.host.files import FLIGHT_MAP_FILE, write_text
from agalign.records.panels_and_sky import PanelOrSkyPart
from agalign.records.sidecar import Sidecar
from agalign.report.summary_csv import rounded
from agalign.values.capture import Position


class FlightMap:
    """The GeoJSON features of the captures of a folder, added one by one."""

    def __init__(self) -> None:
        self._features: dict[str, dict[str, Any]] = {}

    def add(self, label: str, sidecar: Sidecar, indices: Sequence[str] = (), **values: float | None) -> None:
        """Add a capture, given its label and the rasters of its indices, relative to the output folder, and further
        values.

        The geometry is the footprint of the aligned rasters, or of the reference if there are none. Without a footprint
        it is the position of the camera, and null if that is unknown.
        """
        files = {part.kind: (Path(label).parent / part.file).as_posix() for part in sidecar.products}
        self._features[label] = _feature(
            label,
            sidecar,
            {
                "status": sidecar.status,
                **_place(sidecar),
                "accuracy_m": sidecar.footprint_accuracy_m,
                "bands": len(sidecar.moving),
                "bands_aligned": sum(b.status == "aligned" for b in sidecar.bands),
                "bands_predicted": sum(b.status == "predicted" for b in sidecar.bands),
                # Of the worst aligned band, px of the reference.
                "residual_px": rounded(sidecar.largest_residual("residual_px")),
                "residual_p95_px": rounded(sidecar.largest_residual("residual_p95_px")),
                **values,
                # Files are relative to the output folder.
                "sidecar": f"{label}.json",
                "stack": files.get("stack"),
                "picture": files.get("picture"),
                "indices": indices,
            },
        )

    def add_excluded(self, part: PanelOrSkyPart) -> None:
        """Add a capture that is not aligned, as it shows a panel or the sky."""
        facts = _place(part) | {"status": part.kind, "accuracy_m": part.footprint_accuracy_m, "indices": []}
        self._features[part.label] = _feature(part.label, part, facts)

    def write(self, out: Path) -> None:
        """Write the file atomically; remove that of an earlier run if no capture has a position. Raises OutputError."""
        features = [self._features[label] for label in sorted(self._features)]
        if not any(f["geometry"] for f in features):
            with suppress(OSError):
                (out / FLIGHT_MAP_FILE).unlink(missing_ok=True)
            return
        lines = ",\n".join(json.dumps(f, ensure_ascii=False) for f in features)
        text = f'{{"type": "FeatureCollection", "name": "flight", "features": [\n{lines}\n]}}\n'
        write_text(out / FLIGHT_MAP_FILE, text)


def _feature(label: str, capture: Sidecar | PanelOrSkyPart, properties: dict[str, Any]) -> dict[str, Any]:
    shape = geojson_geometry(capture.footprint, capture.position)
    return {"type": "Feature", "id": label, "geometry": shape, "properties": {"capture": label, **properties}}


def _place(capture: Sidecar | PanelOrSkyPart) -> dict[str, Any]:
    pose = capture.pose
    height_m = None if pose is None else pose.height_m
    return {
        "camera": capture.camera.name,
        "captured_at": capture.captured_at,
        **{name: getattr(capture.position, name, None) for name in ("longitude", "latitude", "altitude_m")},
        "height_m": None if height_m is None else round(height_m, 1),
        "height_from": None if pose is None or height_m is None else pose.height_from,
        "heading_deg": None if pose is None else round(pose.heading_deg, 1) % 360,
    }


def geojson_geometry(footprint: ArrayLike | None, position: Position | None) -> dict[str, Any] | None:
    """Return the GeoJSON geometry of a footprint (n, 2), else of the camera's position, or None.

    A footprint across the 180th meridian is cut there (RFC 7946, 3.1.9).
    """
    decimals, ring = 7, None if footprint is None else np.asarray(footprint)  # of a degree: 1 cm
    if ring is not None and np.ptp(ring[:, 0]) > 180:
        beyond = np.column_stack([ring[:, 0] % 360 - 180, ring[:, 1]])  # degrees east of the meridian
        parts = [_clipped(beyond, side) - np.array([side * 180.0, 0.0]) for side in (-1, 1)]
        return {"type": "MultiPolygon", "coordinates": [[part.round(decimals).tolist()] for part in parts]}
    if ring is not None:
        return {"type": "Polygon", "coordinates": [ring.round(decimals).tolist()]}
    if position is not None:
        return {"type": "Point", "coordinates": [position.longitude, position.latitude]}
    return None


def _clipped(ring: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Return the part of a closed ring (n, 2) with negative (`side` -1) or positive x."""
    kept = []
    for a, b in pairwise(ring):
        if side * a[0] >= 0:
            kept.append(a)
        if a[0] * b[0] < 0:
            kept.append(a + (b - a) * a[0] / (a[0] - b[0]))
    return np.array([*kept, kept[0]])
