"""A STAC item beside each capture's files: where and when, which bands, and where to find them."""

import json
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from agalign.errors import ConfigurationError, GeometryError
from agalign.pixels.raster import transformed
from agalign.products.write import Written
from agalign.values import geometry
from agalign.values.capture import Band, Capture
from agalign.values.files import write_text
from agalign.values.image import OutputGrid

_WGS84 = "EPSG:4326"
_PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
_ELECTRO_OPTICAL = "https://stac-extensions.github.io/eo/v2.0.0/schema.json"


def need_stac() -> None:
    """Raises ConfigurationError where the library is not installed."""
    try:
        import pystac  # noqa: F401
    except ImportError:
        raise ConfigurationError("STAC needs more than is installed; pip install 'agalign[stac]'") from None


def write_item(capture: Capture, written: Written, sidecar: Path, picture: Path) -> Path:
    """Write <capture>.stac.json and return its path. Raises OutputError."""
    import pystac

    footprint = _footprint(capture.reference, written.grid)
    position = capture.position
    geometry_part: dict[str, Any] | None = None
    box: list[float] | None = None
    if footprint is not None:
        geometry_part = {"type": "Polygon", "coordinates": [footprint.tolist()]}
        box = [*footprint.min(axis=0).tolist(), *footprint.max(axis=0).tolist()]
    elif position is not None:
        geometry_part = {"type": "Point", "coordinates": [position.longitude, position.latitude]}
        box = [position.longitude, position.latitude] * 2
    moment, source = _moment(capture)
    item = pystac.Item(
        id=capture.label, geometry=geometry_part, bbox=box, datetime=moment,
        properties={"agalign:datetime_source": source, "proj:shape": [written.grid.height, written.grid.width]},
        stac_extensions=[_PROJECTION, _ELECTRO_OPTICAL],
    )  # fmt: skip
    if capture.camera.model:
        item.properties["instruments"] = [f"{capture.camera.make} {capture.camera.model}".strip()]
    if footprint is not None:
        item.properties["proj:wkt2"] = (
            capture.reference.georeference.crs_wkt if capture.reference.georeference else None
        )
    by_name = {b.name: b for b in capture.bands}
    for path, names in written.contents.items():
        asset = pystac.Asset(
            path.relative_to(sidecar.parent).as_posix(), media_type=pystac.MediaType.GEOTIFF, roles=["data"],
            extra_fields={"bands": [_band(by_name[name]) for name in names]},
        )  # fmt: skip
        item.add_asset("stack" if path == written.stack else asset.href, asset)
    item.add_asset("sidecar", pystac.Asset(sidecar.name, media_type=pystac.MediaType.JSON, roles=["metadata"]))
    if picture.is_file():
        item.add_asset("picture", pystac.Asset(picture.name, media_type=pystac.MediaType.PNG, roles=["thumbnail"]))
    target = sidecar.with_suffix(".stac.json")
    write_text(target, json.dumps(item.to_dict(include_self_link=False), indent=1) + "\n")
    return target


def _band(band: Band) -> dict[str, Any]:
    found: dict[str, Any] = {"name": band.name}
    if band.wavelength_nm is not None:
        found["eo:center_wavelength"] = round(band.wavelength_nm / 1000, 6)
    if band.bandwidth_nm is not None:
        found["eo:full_width_half_max"] = round(band.bandwidth_nm / 1000, 6)
    return found


def _footprint(reference: Band, grid: OutputGrid) -> Any:
    """(5, 2) closed ring of longitudes and latitudes; None without a georeference."""
    if reference.georeference is None:
        return None
    x0, y0 = grid.x0, grid.y0
    x1, y1 = x0 + grid.width, y0 + grid.height
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], dtype=np.float64) / grid.scale_xy
    try:
        on_map = geometry.apply(reference.georeference.transform, corners)
        return transformed(on_map, reference.georeference.crs_wkt, _WGS84)
    except GeometryError:
        return None


def _moment(capture: Capture) -> tuple[datetime, str]:
    """(when, and how that is known). Cameras give no time zone: it is taken as UTC."""
    with suppress(ValueError):
        moment = datetime.fromisoformat(capture.captured_at)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)), "camera"
    # STAC wants a time; orthos seldom have one.
    return datetime.fromtimestamp(capture.reference.path.stat().st_mtime, UTC), "change of the reference's file"
