"""OUT/flight.geojson: footprints of the captures of a run, with their results and links to their files."""

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from agalign.products.indices.rasters import IndexReport, read_table
from agalign.products.product import CapturePaths
from agalign.products.run.footprint import accuracy_of_footprint_m, footprint, geojson_geometry, with_assumed_height
from agalign.products.sidecar.schema import CaptureResult
from agalign.values.capture import Capture
from agalign.values.files import read_regular, write_text
from agalign.values.image import OutputGrid

FLIGHT_MAP_FILE = "flight.geojson"


class FlightMap:
    """The GeoJSON features of the captures of a run, added one by one."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._features: dict[str, dict[str, Any]] = {}

    def add(self, capture: Capture, status: str, result: CaptureResult | None = None) -> None:
        """Add a capture, with the result in its sidecar if there is one.

        The geometry is the footprint of the aligned rasters, or of the reference if there are none; else the position
        of the camera; else null.
        """
        # Panels are photographed from 1 m, and the sky is not on the ground.
        shown = capture if status in ("panel", "sky") else with_assumed_height(capture)
        output = None if result is None else result.output
        ring = footprint(shown, OutputGrid(0, 0, *capture.reference.size_px) if output is None else output.grid)
        position, pose = shown.position, shown.pose
        # RFC 7946: outer rings are counter-clockwise. 1e-7 degrees are a centimetre.
        geometry = geojson_geometry(None if ring is None else ring[::-1], position, decimals=7)
        georeference = capture.reference.georeference
        if georeference is None:
            accuracy_m = None if ring is None else accuracy_of_footprint_m(shown)
        else:
            accuracy_m = georeference.accuracy_m
        height_m = None if pose is None else pose.height_m
        bands = [] if result is None else [b for b in result.bands if b.status != "reference"]
        after = [b.metrics.after for b in bands if b.metrics is not None]
        paths = CapturePaths.of(capture, Path())
        products = [] if result is None else result.products
        files = [(part.kind, (paths.folder / part.file).as_posix()) for part in products]
        properties = {
            "capture": capture.label,
            "status": status,
            "camera": f"{capture.camera.make} {capture.camera.model}".strip(),
            "captured_at": capture.captured_at,
            **{name: getattr(position, name, None) for name in ("longitude", "latitude", "altitude_m")},
            "height_m": None if height_m is None else round(height_m, 1),
            "height_from": None if pose is None or height_m is None else pose.height_from,
            "heading_deg": None if pose is None else round(pose.heading_deg, 1) % 360,
            "accuracy_m": accuracy_m,
            "bands": len(bands),
            "bands_aligned": sum(b.status == "aligned" for b in bands),
            "bands_predicted": sum(b.status == "predicted" for b in bands),
            # The largest of a band, px of the reference.
            "residual_px": max((a.residual_px for a in after if a.residual_px is not None), default=None),
            "residual_p95_px": max((a.residual_p95_px for a in after if a.residual_p95_px is not None), default=None),
            # Files are relative to the output folder.
            "sidecar": None if result is None else paths.sidecar.as_posix(),
            "stack": dict(files).get("stack"),
            "picture": dict(files).get("picture"),
            "indices": [file for kind, file in files if kind == "index" and file.endswith(".tif")],
        }
        feature = {"type": "Feature", "id": capture.label, "geometry": geometry, "properties": properties}
        self._features[capture.label] = feature

    def write(self) -> Path | None:
        """Write the file atomically and return it; None if no capture has a position. Raises OutputError.

        Captures of earlier runs whose sidecars are still in the folder are kept, as in the report. Index rasters that
        `agalign indices` wrote in earlier commands are linked too.
        """
        earlier = {f["id"]: f for f in features_in(self._out) if self._has_sidecar(f["properties"].get("sidecar"))}
        by_label = earlier | self._features
        features = [by_label[label] for label in sorted(by_label)]
        if not any(f.get("geometry") for f in features):
            return None
        _write(self._out, features, read_table(self._out))
        return self._out / FLIGHT_MAP_FILE

    def _has_sidecar(self, file: object) -> bool:
        return isinstance(file, str) and (self._out / file).is_file()


def link_indices(out: Path, rows: Iterable[IndexReport]) -> None:
    """Link the rasters of an index table in OUT/flight.geojson. Raises OutputError.

    Without the file, or with a file that a run did not write, nothing is changed.
    """
    if features := features_in(out):
        _write(out, features, rows)


def features_in(out: Path) -> list[dict[str, Any]]:
    """The features of OUT/flight.geojson; none if there is no such file, or if a run did not write it."""
    try:
        features = from_json(read_regular(out / FLIGHT_MAP_FILE), allow_inf_nan=False)["features"]
        is_of_a_run = all(
            isinstance(f["id"], str)
            and f["id"] == f["properties"]["capture"]
            and isinstance(f["properties"]["indices"], list)
            for f in features
        )
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return features if is_of_a_run else []


def _write(out: Path, features: Sequence[dict[str, Any]], rows: Iterable[IndexReport]) -> None:
    rasters: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if row.path is not None:
            rasters[row.capture].append(row.path.relative_to(out).as_posix())
    for feature in features:
        properties = feature["properties"]
        properties["indices"] = list(dict.fromkeys([*properties["indices"], *rasters[properties["capture"]]]))
    lines = ",\n".join(json.dumps(f, ensure_ascii=False) for f in features)
    text = f'{{"type": "FeatureCollection", "name": "flight", "features": [\n{lines}\n]}}\n'
    write_text(out / FLIGHT_MAP_FILE, text)
