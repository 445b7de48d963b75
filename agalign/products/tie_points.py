"""The tie points of a capture: where windows of each band show the same as the reference, as CSV and as GeoJSON.

They are measured on the aligned bands and independent of the descriptors: another program can estimate any mapping from
them, or verify its own. Only their search starts from the alignment.
"""

import csv
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agalign.config import WriteSettings
from agalign.errors import GeometryError
from agalign.pixels.raster import transformed
from agalign.products.product import CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture, Georeference
from agalign.values.choices import PairStatus
from agalign.values.files import write_text
from agalign.values.geometry import Points
from agalign.values.mapping import mapping_of
from agalign.values.pixel_units import FixedFilePx
from agalign.values.text import harmless

_COLUMNS = (
    "band", "status", "reference_x_px", "reference_y_px", "moving_x_px", "moving_y_px", "residual_px", "weight",
)  # fmt: skip
_WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class TiePoint:
    """One window: raw pixels of both files, (0, 0) the centre of the top-left pixel."""

    band: str
    status: PairStatus
    reference_px: tuple[float, float]
    moving_px: tuple[float, float]
    residual_px: float
    """Distance from the alignment, px of the reference's file."""
    weight: float
    """Inverse of the variance, 1 for the median window of the band."""


class TiePoints(Product):
    """The tie points of all bands that are not failed."""

    kind = "tie_points"
    suffix = ".ties.csv"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True with `--tie-points`."""
        return settings.tie_points

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """The CSV and the GeoJSON."""
        return [paths.file(self.suffix), paths.file(".ties.geojson")]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.ties.csv and <capture>.ties.geojson."""
        table, features = self.paths(context.capture, context.paths, context.write_settings)
        points = list(_points(context))
        write_text(table, _csv(points))
        write_text(features, _geojson(points, context.capture.reference.georeference))
        return [
            WrittenFile(self.kind, table, StacAsset("tie_points", "text/csv", ("metadata",))),
            WrittenFile(self.kind, features, StacAsset("tie_points_geojson", "application/geo+json", ("metadata",))),
        ]


def _points(context: ProductContext) -> Iterator[TiePoint]:
    for band in context.capture.moving:
        alignment = context.usable.get(band.name)
        if alignment is not None and alignment.residual is not None:
            yield from tie_points(context.capture.reference, band, alignment)


def tie_points(reference: Band, band: Band, alignment: Alignment[FixedFilePx]) -> Iterator[TiePoint]:
    """The tie points of a band with a residual.

    What the reference shows at p, the warped band shows at p + shift: it is at mapping(p + shift) in the band's file.
    """
    residual = alignment.residual
    assert residual is not None
    measured = np.isfinite(residual.shifts_px[:, 0])
    at_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    moving_px = mapping_of(reference, band, alignment)(at_px + shifts_px)
    # The error of a shift falls with the square of its peak's height.
    sigma = residual.peaks_sigma[measured] if len(residual.peaks_sigma) else np.ones(len(at_px))
    weights = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
    rows = zip(at_px.tolist(), moving_px.tolist(), np.hypot(*shifts_px.T).tolist(), weights.tolist(), strict=True)
    for (x, y), (moving_x, moving_y), residual_px, weight in rows:
        yield TiePoint(band.name, alignment.status, (x, y), (moving_x, moving_y), residual_px, weight)


def _csv(points: Sequence[TiePoint]) -> str:
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for p in points:
        numbers = (*p.reference_px, *p.moving_px, p.residual_px, p.weight)
        writer.writerow([harmless(p.band), p.status, *(f"{n:.4f}" for n in numbers)])
    return table.getvalue()


def _geojson(points: Sequence[TiePoint], georeference: Georeference | None) -> str:
    """Points in WGS 84, or in px (x, -y) from the corner of the reference where it has no georeference: GIS programs
    display such an image there.
    """
    places, unit = _places(np.array([p.reference_px for p in points]).reshape(-1, 2), georeference)
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(x, 8), round(y, 8)]},
            "properties": {
                "band": harmless(p.band), "status": p.status, "reference_px": [round(v, 4) for v in p.reference_px],
                "moving_px": [round(v, 4) for v in p.moving_px], "residual_px": round(p.residual_px, 4),
                "weight": round(p.weight, 4),
            },
        }
        for p, (x, y) in zip(points, places.tolist(), strict=True)
    ]  # fmt: skip
    return json.dumps({"type": "FeatureCollection", "coordinates_in": unit, "features": features}, indent=None) + "\n"


def _places(points_px: Points, georeference: Georeference | None) -> tuple[Points, str]:
    corner_px = points_px + 0.5
    if georeference is not None and len(points_px):
        try:
            on_map = geometry.apply(georeference.transform, corner_px)
            return transformed(on_map, georeference.crs_wkt, _WGS84), _WGS84
        except GeometryError:
            pass
    return corner_px * (1.0, -1.0), "px of the reference, y negative"
