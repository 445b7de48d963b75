"""The tie points between the reference and each band of a capture, as CSV and as GeoJSON.

They are measured by phase correlation of windows of the aligned bands, independently of the learned descriptors:
another program can estimate a mapping from them, or verify its own. Only the search starts from the alignment.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.errors import GeometryError
from agalign.host.files import write_csv, write_text
from agalign.host.text import escape_controls
from agalign.pixels.coordinates import transformed
from agalign.rasters.product import CapturePaths, Product, ProductContext, WrittenFile
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture, Georeference
from agalign.values.choices import PairStatus
from agalign.values.residual import Residual

_POSITIONS = "reference_x_px", "reference_y_px", "moving_x_px", "moving_y_px"
_COLUMNS = "band", "status", *_POSITIONS, "residual_px", "weight"
_MEMBER = "coordinates_in"
"""The first member of the GeoJSON after its type, which no other program writes."""
_Row = tuple[str, PairStatus, list[float]]
"""Band, its status, and the six numbers of a tie point."""


class TiePoints(Product):
    """The tie points of all bands that did not fail."""

    kind = "tie_points"
    suffix = ".ties.csv"
    option = "tie_points"
    text_starts = ",".join(_COLUMNS).encode(), f'{{"type": "FeatureCollection", "{_MEMBER}"'.encode()

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return the CSV and the GeoJSON file."""
        return [paths.file(self.suffix), paths.file(".ties.geojson")]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.ties.csv and <capture>.ties.geojson."""
        table, features = self.paths(context.capture, context.paths, context.settings.write)
        rows: list[_Row] = [
            (name, alignment.status, point)
            for name, alignment in context.with_pixels.items()
            if name in context.ties
            for point in tie_points(alignment, context.ties[name]).tolist()
        ]
        cells = ((band, status, *(f"{n:.4f}" for n in point)) for band, status, point in rows)
        write_csv(table, _COLUMNS, cells)
        write_text(features, _geojson(rows, context.capture.reference.georeference))
        return [WrittenFile(self.kind, table), WrittenFile(self.kind, features)]


def tie_points(alignment: Alignment, residual: Residual) -> NDArray[np.float64]:
    """Return the tie points of a band (n, 6) from the residual of its windows under the mapping.

    They have the raw pixels (x, y) of the reference and those of the band, (0, 0) the centre of the top-left pixel; the
    distance from the alignment, px of the reference's file; and the weight, which is the inverse of the variance, 1 for
    the median tie point of the band. The point p of the reference corresponds to p + shift in the warped band, and so
    to mapping(p + shift) in the file of the band.
    """
    measured = residual.is_measured
    at_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    # The standard error of a shift is proportional to 1 / (height of its correlation peak)^2.
    sigma = residual.peaks_sigma[measured]
    weights = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
    return np.column_stack([at_px, alignment.map(at_px + shifts_px), np.hypot(*shifts_px.T), weights])


def _geojson(rows: Sequence[_Row], georeference: Georeference | None) -> str:
    """Points in WGS 84, or, without a georeference, in px (x, -y) from the corner of the reference, where GIS programs
    display such an image.
    """
    corner_px = np.array([point[:2] for _, _, point in rows]).reshape(-1, 2) + 0.5  # GDAL's convention
    places, unit = corner_px * (1.0, -1.0), "px of the reference, y negative"
    if georeference is not None and rows:
        with suppress(GeometryError):
            on_map = geometry.apply(georeference.transform, corner_px)
            places, unit = transformed(on_map, georeference.crs_wkt, "EPSG:4326"), "EPSG:4326"
    features = []
    coordinates = places.round(8).tolist()  # 1e-8 degrees are a millimetre
    for (band, status, point), place in zip(rows, coordinates, strict=True):
        x, y, moving_x, moving_y, residual_px, weight = np.round(point, 4).tolist()
        properties = {"band": escape_controls(band), "status": status, "reference_px": (x, y)}
        properties |= {"moving_px": (moving_x, moving_y), "residual_px": residual_px, "weight": weight}
        shape = {"type": "Point", "coordinates": place}
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return json.dumps({"type": "FeatureCollection", _MEMBER: unit, "features": features}) + "\n"
