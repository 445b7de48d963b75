"""A STAC item beside each capture's files, and a collection for each flight: where and when, which bands, and where to
find them.
"""

import json
import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agalign.cameras.base import is_thermal
from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, GeometryError
from agalign.flight.groups import camera_key
from agalign.pixels.raster import crs_code, transformed
from agalign.products.indices import role_of
from agalign.products.pan_sharpen import panchromatic
from agalign.products.raster_file import georeferenced
from agalign.products.raster_tags import UNITS
from agalign.products.write import Written
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Position
from agalign.values.files import write_text
from agalign.values.image import OutputGrid

if TYPE_CHECKING:
    import pystac

_WGS84 = "EPSG:4326"
_ITEM_SUFFIX = ".stac.json"
_COLLECTION_SUFFIX = ".collection.json"
_GEOJSON = "application/geo+json"
_COMMON_NAMES = {"blue": "blue", "green": "green", "red": "red", "red edge": "rededge", "nir": "nir"}
_MAX_TILT_DEG = 45.0
"""A camera that looks farther aside, or is said to, has no footprint."""


def need_stac() -> None:
    """Raises ConfigurationError where the library is not installed."""
    try:
        import pystac  # noqa: F401
    except ImportError:
        raise ConfigurationError("STAC needs more than is installed; pip install 'agalign[stac]'") from None


def write_item(
    capture: Capture, written: Written, sidecar: Path, settings: WriteSettings, beside: Iterable[tuple[Path, str]]
) -> Path:
    """Write <capture>.stac.json and return its path; `beside` are more files of the capture, with their roles.

    Raises OutputError.
    """
    import pystac
    from pystac.extensions.projection import ProjectionExtension

    georeference = capture.reference.georeference
    footprint = _footprint(capture, written.grid)
    position = capture.position
    shape: dict[str, Any] | None = None
    box: list[float] | None = None
    if footprint is not None:
        shape = {"type": "Polygon", "coordinates": [footprint.round(8).tolist()]}
        box = [*footprint.min(axis=0).round(8).tolist(), *footprint.max(axis=0).round(8).tolist()]
    elif position is not None:
        shape = {"type": "Point", "coordinates": [position.longitude, position.latitude]}
        box = [position.longitude, position.latitude] * 2
    moment, source = _moment(capture)
    item = pystac.Item(
        id=capture.label, geometry=shape, bbox=box, datetime=moment,
        properties={"agalign:datetime_source": source, "agalign:reference_band": capture.reference.name},
    )  # fmt: skip
    if capture.camera.model:
        item.properties["instruments"] = [f"{capture.camera.make} {capture.camera.model}".strip()]
    code = None if georeference is None else crs_code(georeference.crs_wkt)
    ProjectionExtension.ext(item, add_if_missing=True).apply(
        code=code, shape=[written.grid.height, written.grid.width],
        wkt2=None if georeference is None or code else georeference.crs_wkt,
        transform=None if georeference is None else list(georeferenced(georeference, written.grid)["transform"])[:9],
    )  # fmt: skip
    by_name = {b.name: b for b in capture.bands}
    is_cog = settings.format == "cog"
    for path, names in written.contents.items():
        asset = pystac.Asset(
            path.relative_to(sidecar.parent).as_posix(), roles=["data"],
            media_type=pystac.MediaType.COG if is_cog else pystac.MediaType.GEOTIFF,
        )  # fmt: skip
        item.add_asset("stack" if path == written.stack else asset.href, asset)
        _describe(asset, [by_name[name] for name in names], capture, written.nodata[path], settings)
    item.add_asset("sidecar", pystac.Asset(sidecar.name, media_type=pystac.MediaType.JSON, roles=["metadata"]))
    for path, role in beside:
        if path.is_file():
            kind = pystac.MediaType.PNG if path.suffix == ".png" else pystac.MediaType.GEOTIFF
            item.add_asset(_asset_key(path, sidecar), pystac.Asset(path.name, media_type=kind, roles=[role]))
    target = sidecar.with_suffix(_ITEM_SUFFIX)
    up = "/".join([".."] * len(capture.folder.parts))
    collection = _collection_file(capture)
    for relation in ("collection", "parent", "root"):
        item.add_link(pystac.Link(relation, f"{up}/{collection}" if up else f"./{collection}", pystac.MediaType.JSON))
    item.collection_id = _collection_id(capture)
    _write(target, item.to_dict(include_self_link=False))
    return target


def write_collections(captures: Sequence[Capture], out: Path) -> list[Path]:
    """Write a collection for each flight of which items lie below OUT. Raises OutputError."""
    import pystac

    flights: dict[str, list[Capture]] = {}
    for capture in captures:
        flights.setdefault(_collection_id(capture), []).append(capture)
    written = []
    for name, flight in flights.items():
        paths = [out / c.folder / f"{c.name}{_ITEM_SUFFIX}" for c in flight]
        items = [pystac.Item.from_dict(json.loads(p.read_text(encoding="utf-8"))) for p in paths if p.is_file()]
        if not items:
            continue
        collection = pystac.Collection(
            id=name, license="other", extent=_extent(items),
            description=f"Captures of {camera_key(flight[0])} with their bands laid on each other",
        )  # fmt: skip
        collection.add_link(pystac.Link("root", f"./{_collection_file(flight[0])}", pystac.MediaType.JSON))
        for path in (p for p in paths if p.is_file()):
            collection.add_link(pystac.Link("item", f"./{path.relative_to(out).as_posix()}", _GEOJSON))
        target = out / _collection_file(flight[0])
        _write(target, collection.to_dict(include_self_link=False))
        written.append(target)
    return written


def _collection_id(capture: Capture) -> str:
    """Of the flight: its id, or where it has none its camera's model and day."""
    name = capture.flight_id or f"{capture.camera.model or 'flight'} {capture.captured_at[:10]}".strip()
    return re.sub(r"[^\w.-]+", "_", name)


def _collection_file(capture: Capture) -> str:
    return f"{_collection_id(capture)}{_COLLECTION_SUFFIX}"


def _extent(items: Sequence["pystac.Item"]) -> "pystac.Extent":
    import pystac

    boxes = [i.bbox for i in items if i.bbox is not None]
    world = [-180.0, -90.0, 180.0, 90.0]
    box = [*np.min(boxes, axis=0)[:2].tolist(), *np.max(boxes, axis=0)[2:].tolist()] if boxes else world
    times = [i.datetime for i in items if i.datetime is not None]
    return pystac.Extent(pystac.SpatialExtent([box]), pystac.TemporalExtent([[min(times), max(times)]]))


def _describe(
    asset: "pystac.Asset", bands: Sequence[Band], capture: Capture, nodata: float | None, settings: WriteSettings
) -> None:
    """The asset's bands: as extensions have them, and as STAC 1.1 has them itself."""
    from pystac.extensions.eo import Band as EoBand
    from pystac.extensions.eo import EOExtension
    from pystac.extensions.raster import DataType, NoDataStrings, RasterBand, RasterExtension

    raw = settings.radiometry == "off"
    dtype = "float32" if not raw else np.result_type(*(b.dtype for b in bands)).name
    missing = NoDataStrings.NAN if nodata is not None and math.isnan(nodata) else nodata
    eo, raster, common = [], [], []
    for band in bands:
        scale, offset = band.scale_offset if raw else (1.0, 0.0)
        unit = UNITS[band.radiometry.quantity] if not raw and band.radiometry is not None else None
        name, nm, width = _common_name(band, capture), band.wavelength_nm, band.bandwidth_nm
        middle, across = (None if v is None else round(v / 1000, 6) for v in (nm, width))
        eo.append(EoBand.create(band.name, name, None, middle, across))
        result = RasterBand.create(data_type=DataType(dtype), nodata=missing, unit=unit, scale=scale, offset=offset)
        raster.append(result)
        facts = {
            "name": band.name, "data_type": dtype, "nodata": missing, "unit": unit, "eo:common_name": name,
            "eo:center_wavelength": middle, "eo:full_width_half_max": across,
        }  # fmt: skip
        common.append({k: v for k, v in facts.items() if v is not None})
    EOExtension.ext(asset, add_if_missing=True).bands = eo
    RasterExtension.ext(asset, add_if_missing=True).bands = raster
    asset.extra_fields["bands"] = common


def _common_name(band: Band, capture: Capture) -> str | None:
    """In the words of the electro-optical extension; None of a band that it has none for."""
    if is_thermal(band):
        return "lwir11"
    if band in panchromatic(capture) and not band.companion:
        return "pan"
    role = None if band.companion else role_of(band.name, band.wavelength_nm)
    return None if role is None else _COMMON_NAMES[role]


def _asset_key(path: Path, sidecar: Path) -> str:
    """`picture`, `pan` or `error`: what the file's name has after the capture's."""
    return path.stem.removeprefix(sidecar.stem).strip(".") or "picture"


def _footprint(capture: Capture, grid: OutputGrid) -> NDArray[np.float64] | None:
    """(5, 2) closed ring of longitudes and latitudes, by the georeference or else by how the camera hung; None where
    neither is known.
    """
    x0, y0 = grid.x0, grid.y0
    x1, y1 = x0 + grid.width, y0 + grid.height
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], dtype=np.float64) / grid.scale_xy
    georeference = capture.reference.georeference
    try:
        if georeference is not None:
            return transformed(geometry.apply(georeference.transform, corners), georeference.crs_wkt, _WGS84)
        on_ground, position = ground_m(capture, corners - 0.5), capture.position
        if on_ground is None or position is None:
            return None
        return transformed(on_ground, _around(position), _WGS84)
    except GeometryError:
        return None


def ground_m(capture: Capture, points_px: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Where pixels of the reference (n, 2) lie on a plane below, (n, 2) metres east and north of the camera; None where
    the tags do not tell its height, heading and focal length, or it looks far aside.
    """
    pose = capture.pose
    if pose is None or pose.height_m is None or pose.focal_length_px is None:
        return None
    if math.hypot(pose.pitch_deg, pose.roll_deg) > _MAX_TILT_DEG:
        return None
    middle = (np.array(capture.reference.size_px) - 1) / 2
    right, down = ((points_px - middle) / pose.focal_length_px).T
    # Turned about the axis of the wings, then about that of the flight: what is ahead, to the right and below.
    pitch, roll, heading = np.radians((pose.pitch_deg, pose.roll_deg, pose.heading_deg))
    ahead, below = -down * np.cos(pitch) + np.sin(pitch), np.cos(pitch) + down * np.sin(pitch)
    aside, below = right * np.cos(roll) - below * np.sin(roll), below * np.cos(roll) + right * np.sin(roll)
    if not (below > 0).all():
        return None
    ahead_m, aside_m = pose.height_m * ahead / below, pose.height_m * aside / below
    east = aside_m * np.cos(heading) + ahead_m * np.sin(heading)
    return np.stack([east, ahead_m * np.cos(heading) - aside_m * np.sin(heading)], axis=-1)


def _around(position: Position) -> str:
    """A map of metres east and north of a place."""
    return f"+proj=aeqd +lat_0={position.latitude:.9f} +lon_0={position.longitude:.9f} +datum=WGS84 +units=m"


def _write(path: Path, facts: dict[str, Any]) -> None:
    write_text(path, json.dumps(facts, indent=1) + "\n")


def _moment(capture: Capture) -> tuple[datetime, str]:
    """(when, and how that is known). Cameras give no time zone: it is taken as UTC."""
    with suppress(ValueError):
        moment = datetime.fromisoformat(capture.captured_at)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)), "camera"
    # STAC wants a time; orthos seldom have one.
    return datetime.fromtimestamp(capture.reference.path.stat().st_mtime, UTC), "change of the reference's file"
