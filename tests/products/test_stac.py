"""Items and collections as STAC's own libraries read and judge them."""

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
from synthetic_flights.panel import make_flight_between_panels

import agalign
from agalign.config import SeedSettings, Settings, WriteSettings
from agalign.errors import OutputError
from agalign.flight.groups import flights_of
from agalign.products.footprint import ground_m
from agalign.products.stac import write_collections
from agalign.values.capture import Band, CameraIdentity, Capture, Pose
from agalign.values.files import write_text

from ..conftest import textured_image
from .test_outputs import write_band

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
SEEDED = Settings(seed=SeedSettings(only=True))
EXTENSIONS = "https://stac-extensions.github.io/{}/schema.json"


@pytest.fixture(autouse=True)
def offline() -> Iterator[None]:
    """Schemas are those that pystac brings along, and ours of the extensions."""
    validator = JsonSchemaSTACValidator()
    for path in Path(__file__).with_name("schemas").glob("*.json"):
        uri = EXTENSIONS.format(path.stem.replace("-v", "/v"))
        validator.schema_cache[uri] = json.loads(path.read_text())
    before = RegisteredValidator.get_validator()
    RegisteredValidator.set_validator(validator)
    yield
    RegisteredValidator.set_validator(before)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight after a panel, whose captures' height is known by it."""
    folder, out = tmp_path_factory.mktemp("flight"), tmp_path_factory.mktemp("out")
    make_flight_between_panels(folder, 2, (640, 480))
    write = WriteSettings(stac=True, format="cog", radiometry="auto")
    agalign.align_folder(folder, out, settings=SEEDED.model_copy(update={"write": write}))
    return out


def test_items_and_collection_are_valid_and_find_each_other(run: Path) -> None:
    (path,) = run.glob("*.collection.json")
    collection = pystac.Collection.from_file(str(path))
    collection.validate()
    items = list(collection.get_items())
    assert [i.id for i in items] == ["0000SET/000/IMG_0002", "0000SET/000/IMG_0003"]
    for item in items:
        item.validate()
        assert item.collection_id == collection.id
        assert collection.id.startswith("syntheticflight00001-")
        result = item.get_collection()
        assert result is not None
        assert result.id == collection.id
        assert item.assets
        for asset in item.assets.values():
            assert Path(asset.get_absolute_href() or "").is_file(), asset.href
    box = collection.extent.spatial.bboxes[0]
    assert box[0] < 5.0 < box[2]
    assert box[1] < 52.0 < box[3]


def test_a_wrong_field_is_seen_by_the_schemas(run: Path) -> None:
    item = pystac.Item.from_file(str(run / "0000SET" / "000" / "IMG_0002.stac.json"))
    for change in ({"proj:shape": [1]}, {"proj:epsg": 4326}):
        broken = item.full_copy()
        broken.properties |= change
        with pytest.raises(pystac.STACValidationError):
            broken.validate()
    broken = item.full_copy()
    broken.assets["stack"].extra_fields["raster:bands"][0]["data_type"] = "uint17"
    with pytest.raises(pystac.STACValidationError):
        broken.validate()


def test_assets_say_what_their_bands_are(run: Path) -> None:
    item = pystac.Item.from_file(str(run / "0000SET" / "000" / "IMG_0002.stac.json"))
    stack = item.assets["stack"]
    assert stack.media_type == pystac.MediaType.COG
    raster, eo = RasterExtension.ext(stack).bands, EOExtension.ext(stack).bands
    assert raster is not None
    assert eo is not None
    assert [(b.data_type, b.nodata, b.unit, b.scale) for b in raster] == [("float32", "nan", "1", 1.0)] * 5
    assert [b.common_name for b in eo] == ["blue", "green", "red", "nir", "rededge"]
    assert eo[3].center_wavelength == 0.84
    assert [b["eo:common_name"] for b in stack.extra_fields["bands"]] == [b.common_name for b in eo]
    projection = ProjectionExtension.ext(item)
    with rasterio.open(run / "0000SET" / "000" / stack.href) as dataset:
        assert projection.shape == list(dataset.shape)
    assert (projection.code, projection.transform) == (None, None)


def test_the_footprint_is_where_the_camera_looked(run: Path) -> None:
    """28 m up, 640 px are 4.8 mm behind 5.45 mm: 24.7 m wide, less the crop; all look north within a few degrees."""
    item = json.loads((run / "0000SET" / "000" / "IMG_0002.stac.json").read_text())
    ring = np.array(item["geometry"]["coordinates"][0])
    assert ring.shape == (5, 2)
    metres = (ring - [5.0, 52.0]) * [68_680, 111_270]
    width, height = np.linalg.norm(metres[1] - metres[0]), np.linalg.norm(metres[2] - metres[1])
    crop = json.loads((run / "0000SET" / "000" / "IMG_0002.json").read_text())["output"]["crop"]
    expected = [28 / 5.45 * 4.8 * n / 640 for n in crop[2:]]
    np.testing.assert_allclose([width, height], expected, rtol=0.08)  # 0.7 m up or down
    assert metres[0][1] > metres[3][1]  # the first row is north
    assert np.abs(metres[:4].mean(axis=0)).max() < 2.0


@pytest.mark.parametrize(
    ("pose", "point_px", "expected_m"),
    [
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (599.5, 239.5), (28.0, 0.0)),
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (0.0, 23.95)),
        (Pose(90.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (23.95, 0.0)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 239.5), (0.0, 17.633)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 0.0), (0.0, 43.414)),
        (Pose(0.0, 0.0, 10.0, 100.0, 1000.0), (319.5, 239.5), (-17.633, 0.0)),
    ],
)
def test_where_a_pixel_lies_on_the_ground(
    pose: Pose, point_px: tuple[float, float], expected_m: tuple[float, float]
) -> None:
    band = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")
    result = ground_m(Capture("a", Path(), (band,), 0, pose=pose), np.array([point_px]))
    assert result is not None
    np.testing.assert_allclose(result[0], expected_m, atol=0.01)


@pytest.mark.parametrize("pose", [None, Pose(0.0), Pose(0.0, 60.0, 0.0, 100.0, 1000.0), Pose(0.0, height_m=10.0)])
def test_where_the_camera_was_is_not_where_it_looked(pose: Pose | None) -> None:
    band = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")
    assert ground_m(Capture("a", Path(), (band,), 0, pose=pose), np.zeros((1, 2))) is None


def test_odc_stac_opens_a_capture_by_its_common_names(tmp_path: Path) -> None:
    odc_stac = pytest.importorskip("odc.stac")
    place = {"crs": rasterio.CRS.from_epsg(32631), "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    for name, gain in (("green", 900), ("red", 500)):
        pixels = (3000 + gain * textured_image(300, 240, 3)).clip(1).astype(np.uint16)
        write_band(tmp_path / "in" / f"f_{name}.tif", pixels, **place)
    settings = SEEDED.model_copy(update={"write": WriteSettings(stac=True)})
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    item = pystac.Item.from_file(str(tmp_path / "out" / "f.stac.json"))
    item.validate()
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
    band = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")

    def capture(name: str, serial: str, day: str, flight_id: str = "") -> Capture:
        item = pystac.Item(name, None, None, datetime.fromisoformat(f"{day}T10:00:00+00:00"), {})
        write_text(tmp_path / f"{name}.stac.json", json.dumps(item.to_dict(include_self_link=False)))
        camera = CameraIdentity("Make", "Model", serial)
        return Capture(name, Path(), (band,), 0, camera, captured_at=f"{day}T10:00:00", flight_id=flight_id)

    captures = [
        capture("a", "1", "2026-06-21"), capture("b", "2", "2026-06-21"), capture("c", "1", "2026-06-22"),
        capture("d", "1", "2026-06-22", "F"), capture("e", "2", "2026-06-22", "F"),
        capture("f", "1", "2026-06-22", "F"),
    ]  # fmt: skip
    members = []
    for path in write_collections(captures, tmp_path):
        collection = pystac.Collection.from_file(str(path))
        members.append([item.id for item in collection.get_items()])
    assert members == [["a", "c"], ["b"], ["d", "f"], ["e"]]
    assert members == [[c.name for c in flight] for flight in flights_of(captures)]
    assert len(list(tmp_path.glob("*.collection.json"))) == 4


def test_a_damaged_item_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.stac.json").write_bytes(b"\0\0")
    band = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")
    with pytest.raises(OutputError, match=r"a\.stac\.json: cannot be read as a STAC item .* --overwrite"):
        write_collections([Capture("a", Path(), (band,), 0)], tmp_path)
