"""The tie points between the reference and each band of a capture, as CSV and as GeoJSON.

They are measured by phase correlation of windows of the aligned bands, independently of the learned descriptors:
another program can estimate a mapping from them, or verify its own. Only the search starts from the alignment.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
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
from agalign.values.files import write_csv, write_text
from agalign.values.pixel_units import FixedFilePx
from agalign.values.text import escape_controls


@dataclass(frozen=True)
class TiePoint:
    """Corresponding raw pixels of both files, (0, 0) the centre of the top-left pixel."""

    band: str
    status: PairStatus
    reference_px: tuple[float, float]
    moving_px: tuple[float, float]
    residual_px: float
    """Distance from the alignment, px of the reference's file."""
    weight: float
    """Inverse of the variance, 1 for the median tie point of the band."""


class TiePoints(Product):
    """The tie points of all bands that did not fail."""

    kind = "tie_points"
    suffix = ".ties.csv"
    option = "tie_points"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return the CSV and the GeoJSON file."""
        return [paths.file(self.suffix), paths.file(".ties.geojson")]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.ties.csv and <capture>.ties.geojson."""
        table, features = self.paths(context.capture, context.paths, context.settings.write)
        ties = ((b, a) for b in context.capture.moving if (a := context.with_pixels.get(b.name)) is not None and a.ties)
        points = [point for band, alignment in ties for point in tie_points(band, alignment)]
        positions = [f"{side}_{axis}_px" for side in ("reference", "moving") for axis in "xy"]
        numbers = ((*p.reference_px, *p.moving_px, p.residual_px, p.weight) for p in points)
        rows = ([p.band, p.status, *(f"{n:.4f}" for n in of_p)] for p, of_p in zip(points, numbers, strict=True))
        write_csv(table, ("band", "status", *positions, "residual_px", "weight"), rows)
        write_text(features, _geojson(points, context.capture.reference.georeference))
        return [
            WrittenFile(self.kind, table, StacAsset("tie_points", "text/csv", ("metadata",))),
            WrittenFile(self.kind, features, StacAsset("tie_points_geojson", "application/geo+json", ("metadata",))),
        ]


def tie_points(band: Band, alignment: Alignment[FixedFilePx]) -> Iterator[TiePoint]:
    """Yield the tie points of a band with windows that were measured under its final mapping.

    The point p of the reference corresponds to p + shift in the warped band, and so to mapping(p + shift) in the file
    of the band.
    """
    residual = alignment.ties
    assert residual is not None
    measured = np.isfinite(residual.shifts_px[:, 0])
    at_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    moving_px = alignment.map(at_px + shifts_px)
    # The standard error of a shift is proportional to 1 / (height of its correlation peak)^2.
    sigma = residual.peaks_sigma[measured]
    weights = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
    rows = zip(at_px.tolist(), moving_px.tolist(), np.hypot(*shifts_px.T).tolist(), weights.tolist(), strict=True)
    for (x, y), (moving_x, moving_y), residual_px, weight in rows:
        yield TiePoint(band.name, alignment.status, (x, y), (moving_x, moving_y), residual_px, weight)


def _geojson(points: Sequence[TiePoint], georeference: Georeference | None) -> str:
    """Points in WGS 84, or, without a georeference, in px (x, -y) from the corner of the reference, where GIS programs
    display such an image.
    """
    corner_px = np.array([p.reference_px for p in points]).reshape(-1, 2) + 0.5  # GDAL's convention
    places, unit = corner_px * (1.0, -1.0), "px of the reference, y negative"
    if georeference is not None and points:
        with suppress(GeometryError):
            on_map = geometry.apply(georeference.transform, corner_px)
            places, unit = transformed(on_map, georeference.crs_wkt, "EPSG:4326"), "EPSG:4326"
    features = []
    for point, place in zip(points, places, strict=True):
        rounded = {k: v if isinstance(v, str) else np.round(v, 4).tolist() for k, v in vars(point).items()}
        coordinates = [round(v, 8) for v in place.tolist()]  # 1e-8 degrees are a millimetre
        feature = {"type": "Feature", "geometry": {"type": "Point", "coordinates": coordinates}}
        features.append(feature | {"properties": rounded | {"band": escape_controls(point.band)}})
    return json.dumps({"type": "FeatureCollection", "coordinates_in": unit, "features": features}) + "\n"
