"""A STAC item for each capture and a collection for each flight, by the specification 1.1 and its extensions
electro-optical, raster and projection.
"""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import from_json

from agalign.cameras.base import is_thermal
from agalign.errors import ConfigurationError, OutputError
from agalign.flight.fingerprint import hashed
from agalign.flight.groups import camera_key, flight_key, flights_of
from agalign.pixels.raster import crs_code
from agalign.products.indices.formulas import role_of_band
from agalign.products.product import CapturePaths, Product, ProductContext, WrittenFile
from agalign.products.rasters.aligned_files import UNITS
from agalign.products.rasters.checked_raster import georeferenced
from agalign.products.rasters.pan_sharpen import panchromatic
from agalign.products.run.flight_map import footprint, geojson_geometry
from agalign.values.capture import Band, Capture, CaptureTime
from agalign.values.files import file_name, read_regular, write_text
from agalign.values.image import OutputGrid

if TYPE_CHECKING:
    import pystac


class StacItem(Product):
    """The STAC item of a capture, with the files of the other products as assets."""

    kind = "stac_item"
    suffix = ".stac.json"
    option = "stac"

    def check(self, capture: Capture) -> None:  # noqa: ARG002
        """Raise ConfigurationError if pystac is not installed."""
        need_stac()

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.stac.json."""
        path = context.paths.file(self.suffix)
        item = _item(context)
        _add_assets(item, context)
        write_text(path, json.dumps(item.to_dict(include_self_link=False), indent=1) + "\n")
        return [WrittenFile(self.kind, path)]


def need_stac() -> None:
    """Raise ConfigurationError if pystac is not installed."""
    try:
        import pystac  # noqa: F401
    except ImportError:
        raise ConfigurationError("STAC needs more than is installed; in a checkout: pip install '.[stac]'") from None


def write_collections(captures: Sequence[Capture], out: Path) -> list[Path]:
    """Write a collection for each flight with items below OUT. Raises OutputError."""
    written = []
    for flight in flights_of(captures):
        paths = [path for c in flight if (path := CapturePaths.of(c, out).file(StacItem.suffix)).is_file()]
        if paths:
            written.append(_write_collection(flight[0], paths, out))
    return written


def _write_collection(capture: Capture, items: Sequence[Path], out: Path) -> Path:
    """Write the collection of the flight of `capture`."""
    import pystac

    name, read = _collection_id(capture), [_read_item(path) for path in items]
    target = out / f"{name}.collection.json"
    extent = pystac.Extent.from_items(read)
    if all(item.bbox is None for item in read):
        extent.spatial = pystac.SpatialExtent([[-180.0, -90.0, 180.0, 90.0]])
    description = f"Captures of {camera_key(capture)} with co-registered bands"
    collection = pystac.Collection(name, description, extent, license="other")
    collection.add_link(pystac.Link("root", f"./{target.name}", pystac.MediaType.JSON))
    for path in items:
        collection.add_link(pystac.Link("item", f"./{path.relative_to(out).as_posix()}", pystac.MediaType.GEOJSON))
    write_text(target, json.dumps(collection.to_dict(include_self_link=False), indent=1) + "\n")
    return target


def _read_item(path: Path) -> "pystac.Item":
    """Raises OutputError."""
    import pystac

    try:
        return pystac.Item.from_dict(from_json(read_regular(path)))
    except (OSError, ValueError, KeyError, pystac.STACError) as error:
        raise OutputError(f"{path}: cannot be read as a STAC item ({error}); run again with --overwrite") from None


def _collection_id(capture: Capture) -> str:
    """The id or camera of the capture's flight, and a checksum that is unique for the flight.

    It depends only on tags of the capture, so that captures of one flight in several runs have the same collection.
    """
    camera = f"{capture.camera.model} {capture.camera.serial}".strip()
    return f"{file_name(capture.flight_id or camera or 'flight')}-{hashed(*flight_key(capture))[:8]}"


def _item(context: ProductContext) -> "pystac.Item":
    """The item of a capture, without assets."""
    import pystac
    from pystac.extensions.projection import ProjectionExtension

    capture, grid = context.capture, context.grid
    shape = geojson_geometry(footprint(capture, grid), capture.position, decimals=8)
    box = None if shape is None else bounding_box(shape)
    moment, source = _moment(capture)
    properties = {"agalign:datetime_source": source, "agalign:reference_band": capture.reference.name}
    item = pystac.Item(capture.label, geometry=shape, bbox=box, datetime=moment, properties=properties)
    if capture.camera.model:
        item.properties["instruments"] = [f"{capture.camera.make} {capture.camera.model}".strip()]
    ProjectionExtension.ext(item, add_if_missing=True).apply(**_projection(capture, grid))
    item.collection_id = _collection_id(capture)
    to_out = "/".join([".."] * len(capture.folder.parts)) or "."
    for relation in ("collection", "parent", "root"):
        item.add_link(pystac.Link(relation, f"{to_out}/{item.collection_id}.collection.json", pystac.MediaType.JSON))
    return item


def bounding_box(shape: Mapping[str, Any]) -> list[float]:
    """Return [west, south, east, north] of a GeoJSON point, polygon, or multipolygon with a part on each side of the
    180th meridian: then west is larger than east (RFC 7946, 5.2).
    """
    parts = shape["coordinates"] if shape["type"] == "MultiPolygon" else [shape["coordinates"]]
    first, last = (np.reshape(part, (-1, 2)) for part in (parts[0], parts[-1]))
    latitudes = np.concatenate([first, last])[:, 1]
    return [float(first[:, 0].min()), float(latitudes.min()), float(last[:, 0].max()), float(latitudes.max())]


def _projection(capture: Capture, grid: OutputGrid) -> dict[str, Any]:
    """The fields of the projection extension."""
    shape, georeference = [grid.height, grid.width], capture.reference.georeference
    if georeference is None:
        return {"shape": shape, "code": None}
    code = crs_code(georeference.crs_wkt)
    transform = list(georeferenced(georeference, grid)["transform"])[:9]
    return {"shape": shape, "code": code, "wkt2": None if code else georeference.crs_wkt, "transform": transform}


def _add_assets(item: "pystac.Item", context: ProductContext) -> None:
    """Add the sidecar and every file with a STAC asset."""
    import pystac
    from pystac.extensions.eo import EOExtension
    from pystac.extensions.raster import RasterExtension

    sidecar = context.paths.sidecar
    by_name = {b.name: b for b in context.capture.bands}
    for file in context.written:
        if file.asset is None:
            continue
        href, roles = context.paths.relative(file.path), list(file.asset.roles)
        asset = pystac.Asset(href, roles=roles, media_type=file.asset.media_type)
        item.add_asset(file.asset.key, asset)
        if file.bands:
            EOExtension.add_to(item)
            RasterExtension.add_to(item)
            _describe_bands(asset, [by_name[n] for n in file.bands], file.nodata_in_json, context)
    item.add_asset("sidecar", pystac.Asset(sidecar.name, media_type=pystac.MediaType.JSON, roles=["metadata"]))


def _describe_bands(
    asset: "pystac.Asset", bands: Sequence[Band], nodata: float | str | None, context: ProductContext
) -> None:
    """Describe the bands of an asset in the fields of the extensions, and in the common `bands` of STAC 1.1."""
    raw = context.settings.write.radiometry == "off"
    dtype = np.result_type(*(b.dtype for b in bands)).name if raw else "float32"
    described: list[tuple[dict[str, Any], ...]] = []
    for band in bands:
        scale, offset = band.scale_offset if raw else (1.0, 0.0)
        unit = UNITS[band.radiometry.quantity] if not raw and band.radiometry is not None else None
        eo = {"common_name": _common_name(band, context.capture), "center_wavelength": _um(band.wavelength_nm)}
        eo |= {"full_width_half_max": _um(band.bandwidth_nm)}
        raster = {"nodata": nodata, "data_type": dtype, "unit": unit, "scale": scale, "offset": offset}
        common = {"name": band.name, "data_type": dtype, "nodata": nodata, "unit": unit}
        described.append(({"name": band.name, **eo}, raster, common | {f"eo:{k}": v for k, v in eo.items()}))
    for key, parts in zip(("eo:bands", "raster:bands", "bands"), zip(*described, strict=True), strict=True):
        asset.extra_fields[key] = [{k: v for k, v in part.items() if v is not None} for part in parts]


def _um(length_nm: float | None) -> float | None:
    return None if length_nm is None else round(length_nm / 1000, 6)


def _common_name(band: Band, capture: Capture) -> str | None:
    """The common name of a band in the electro-optical extension; None if it has none."""
    if is_thermal(band):
        return "lwir11"
    if band in panchromatic(capture) and not band.companion:
        return "pan"
    role = role_of_band(band)
    return None if role is None else role.replace(" ", "")


def _moment(capture: Capture) -> tuple[datetime, str]:
    """(time of the capture in UTC, its source). STAC requires a time, which orthomosaics seldom have."""
    if (known := CaptureTime.of(capture.captured_at)) is not None:
        return known
    return datetime.fromtimestamp(capture.reference.path.stat().st_mtime, UTC), "change of the reference's file"
