"""Items and collections as the libraries of STAC read and validate them."""

import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import numpy as np
import pystac
import pytest
import rasterio
from pystac.extensions.eo import EOExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.raster import RasterExtension
from pystac.validation import RegisteredValidator
from pystac.validation.stac_validator import JsonSchemaSTACValidator

import agalign
from agalign.flight.groups import flights_of
from agalign.products.exports.stac import bounding_box, write_collections
from agalign.products.run.flight_map import ground_m
from agalign.values.capture import Band, CameraIdentity, Capture, Pose
from agalign.values.files import write_text

from ..conftest import Shared, read_json, seeded, write_capture

pytestmark = pytest.mark.slow
GREEN = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")
EXTENSIONS = "https://stac-extensions.github.io/{}/schema.json"


@pytest.fixture(autouse=True)
def offline() -> Iterator[None]:
    """Schemas are those that pystac brings along, and ours of the extensions."""
    validator = JsonSchemaSTACValidator()
    for path in Path(__file__).with_name("schemas").glob("*.json"):
        uri = EXTENSIONS.format(path.stem.replace("-v", "/v"))
        validator.schema_cache[uri] = read_json(path)
    before = RegisteredValidator.get_validator()
    RegisteredValidator.set_validator(validator)
    yield
    RegisteredValidator.set_validator(before)


@pytest.fixture
def run(between_panels: Path, shared: Shared) -> Path:
    """A flight after a panel, which determines the height of the captures."""
    settings = seeded(stac=True, format="cog", radiometry="auto")
    return shared("stac", lambda out: agalign.align_folder(between_panels, out, settings=settings))


def test_items_and_collection_are_valid_and_find_each_other(run: Path) -> None:
    (path,) = run.glob("*.collection.json")
    collection = pystac.Collection.from_file(str(path))
    collection.validate()
    items = list(collection.get_items())
    assert [i.id for i in items] == ["0000SET/000/IMG_0002", "0000SET/000/IMG_0003"]
    for item in items:
        item.validate()
        assert item.collection_id == item.get_collection().id == collection.id
        assert item.assets
        for asset in item.assets.values():
            assert Path(asset.get_absolute_href() or "").is_file(), asset.href
    assert collection.id.startswith("syntheticflight00001-")
    box = collection.extent.spatial.bboxes[0]
    assert box[0] < 5.0 < box[2]
    assert box[1] < 52.0 < box[3]


def test_a_wrong_field_is_seen_by_the_schemas(run: Path) -> None:
    item = pystac.Item.from_file(str(run / "0000SET" / "000" / "IMG_0002.stac.json"))
    shape, code, band = (item.full_copy() for _ in range(3))
    shape.properties["proj:shape"] = [1]
    code.properties["proj:epsg"] = 4326
    band.assets["stack"].extra_fields["raster:bands"][0]["data_type"] = "uint17"
    for broken in (shape, code, band):
        with pytest.raises(pystac.STACValidationError):
            broken.validate()


def test_assets_describe_their_bands(run: Path) -> None:
    item = pystac.Item.from_file(str(run / "0000SET" / "000" / "IMG_0002.stac.json"))
    assert item.datetime.isoformat() == "2026-06-21T10:00:02+00:00"
    assert item.properties["agalign:datetime_source"] == "camera"
    stack = item.assets["stack"]
    assert stack.media_type == pystac.MediaType.COG
    raster, eo = RasterExtension.ext(stack).bands, EOExtension.ext(stack).bands
    assert raster is not None
    assert [(b.data_type, b.nodata, b.unit, b.scale) for b in raster] == [("float32", "nan", "1", 1.0)] * 5
    assert [b.common_name for b in eo] == ["blue", "green", "red", "nir", "rededge"]
    assert eo[3].center_wavelength == 0.84
    assert [b["eo:common_name"] for b in stack.extra_fields["bands"]] == [b.common_name for b in eo]
    projection = ProjectionExtension.ext(item)
    with rasterio.open(run / "0000SET" / "000" / stack.href) as dataset:
        assert projection.shape == list(dataset.shape)
    assert (projection.code, projection.transform) == (None, None)


@pytest.mark.parametrize(
    ("pose", "point_px", "expected_m"),
    [
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (599.5, 239.5), (28.0, 0.0)),
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (0.0, 23.95)),
        (Pose(90.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (23.95, 0.0)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 239.5), (0.0, 17.633)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 0.0), (0.0, 43.414)),
        (Pose(0.0, 0.0, 10.0, 100.0, 1000.0), (319.5, 239.5), (-17.633, 0.0)),
        (None, (0.0, 0.0), None),
        (Pose(0.0), (0.0, 0.0), None),
        (Pose(0.0, 60.0, 0.0, 100.0, 1000.0), (0.0, 0.0), None),
        (Pose(0.0, height_m=10.0), (0.0, 0.0), None),
    ],
)
def test_position_of_a_pixel_on_the_ground(
    pose: Pose | None, point_px: tuple[float, float], expected_m: tuple[float, float] | None
) -> None:
    result = ground_m(Capture("a", Path(), (GREEN,), 0, pose=pose), np.array([point_px]))
    if expected_m is None:
        assert result is None
    else:
        np.testing.assert_allclose(result[0], expected_m, atol=0.01)


def test_odc_stac_opens_a_capture_by_its_common_names(tmp_path: Path) -> None:
    odc_stac = pytest.importorskip("odc.stac")
    place = {"crs": rasterio.CRS.from_epsg(32631), "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    write_capture(tmp_path / "in", "green", "red", **place)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=seeded(stac=True))
    item = pystac.Item.from_file(str(tmp_path / "out" / "f.stac.json"))
    item.validate()
    assert "change of" in item.properties["agalign:datetime_source"]
    ring = np.array(item.geometry["coordinates"][0])
    assert ring.shape == (5, 2)
    assert abs(ring[0] - ring[2]).max() < 0.001
    assert ring[0] == pytest.approx([3.0, 52.35], abs=0.05)
    assert ProjectionExtension.ext(item).code == "EPSG:32631"
    assert ProjectionExtension.ext(item).transform == [0.1, 0, 5e5, 0, -0.1, 5.8e6, 0, 0, 1]
    loaded = odc_stac.load([item], bands=["red", "green"])
    assert loaded.odc.crs.epsg == 32631
    with rasterio.open(tmp_path / "out" / "f.tif") as dataset:
        for name in ("green", "red"):
            index = dataset.descriptions.index(name) + 1
            np.testing.assert_array_equal(loaded[name].values[0], dataset.read(index))


def test_collections_are_the_flights_that_share_a_network(tmp_path: Path) -> None:
    """Two units of one model on one day are two flights, with or without a flight id."""

    def capture(name: str, serial: str, day: str, flight_id: str = "") -> Capture:
        item = pystac.Item(name, None, None, datetime.fromisoformat(f"{day}T10:00:00+00:00"), {})
        write_text(tmp_path / f"{name}.stac.json", json.dumps(item.to_dict(include_self_link=False)))
        camera = CameraIdentity("Make", "Model", serial)
        return Capture(name, Path(), (GREEN,), 0, camera, captured_at=f"{day}T10:00:00", flight_id=flight_id)

    flown = "a 1 2026-06-21, b 2 2026-06-21, c 1 2026-06-22, d 1 2026-06-22 F, e 2 2026-06-22 F, f 1 2026-06-22 F"
    captures = [capture(*words.split()) for words in flown.split(", ")]
    collections = [pystac.Collection.from_file(str(path)) for path in write_collections(captures, tmp_path)]
    members = [[item.id for item in collection.get_items()] for collection in collections]
    assert members == [["a", "c"], ["b"], ["d", "f"], ["e"]]
    assert members == [[c.name for c in flight] for flight in flights_of(captures)]
    assert len(list(tmp_path.glob("*.collection.json"))) == 4


def test_a_damaged_item_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.stac.json").write_bytes(b"\0\0")
    with pytest.raises(agalign.OutputError, match=r"a\.stac\.json: cannot be read as a STAC item .* --overwrite"):
        write_collections([Capture("a", Path(), (GREEN,), 0)], tmp_path)


def test_the_box_of_a_footprint_across_the_180th_meridian_crosses_it() -> None:
    west = [[[179.9, -17.0], [180.0, -17.0], [180.0, -16.9], [179.9, -17.0]]]
    east = [[[-180.0, -17.1], [-179.8, -17.1], [-180.0, -16.9], [-180.0, -17.0], [-180.0, -17.1]]]
    across = {"type": "MultiPolygon", "coordinates": [west, east]}
    assert bounding_box(across) == [179.9, -17.1, -179.8, -16.9]
    assert bounding_box({"type": "Polygon", "coordinates": west}) == [179.9, -17.0, 180.0, -16.9]
    assert bounding_box({"type": "Point", "coordinates": [8.0, 50.0]}) == [8.0, 50.0, 8.0, 50.0]
