"""Sizes, orders, resolutions, indices and items: what options make of one capture."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import tifffile

import agalign
from agalign.batch import RunOptions
from agalign.batch.index_run import do_indices, index_tasks, run_indices
from agalign.cameras.discover import DiscoverOptions, discover
from agalign.capture.tag_seeds import geo_seed
from agalign.config import CheckSettings, JointSettings, ReliefSettings, SeedSettings, Settings, WriteSettings
from agalign.errors import ConfigurationError, InputError
from agalign.products.aligned_files import band_file_names
from agalign.products.index_table import IndexReport
from agalign.products.indices import INDICES
from agalign.products.layout import output_layers
from agalign.products.sidecar_file import verify_outputs
from agalign.synthetic import flight as synthetic
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Band, Capture, Georeference
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale

from ..conftest import textured_image

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
ONLY_SEED = Settings(seed=SeedSettings(only=True, force="identity"), joint=JointSettings())


def indices_of(out: Path, *names: str) -> list[IndexReport]:
    tasks = index_tasks(out, [INDICES[name] for name in names], out, overwrite=True)
    return [report for done in run_indices(tasks) for report in done.reports]


def write_band(path: Path, pixels: np.ndarray, **profile: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = {"driver": "GTiff", "width": pixels.shape[1], "height": pixels.shape[0], "count": 1, "dtype": pixels.dtype}
    with rasterio.open(path, "w", **{**shape, **profile}) as dataset:
        dataset.write(pixels, 1)


@pytest.fixture
def aligned_capture(tmp_path: Path) -> Path:
    """Green, red, NIR at 400 and 900 nm tags missing, and a panchromatic band of twice the resolution."""
    scene = textured_image(800, 600, 7)
    small = scene.reshape(300, 2, 400, 2).mean((1, 3))
    levels = {"green": 900, "red": 600, "nir": -700}
    for name, gain in levels.items():
        write_band(tmp_path / "in" / f"field_{name}.tif", (3000 + gain * small).clip(1).astype(np.uint16))
    write_band(tmp_path / "in" / "field_pan.tif", (3000 + 800 * scene).clip(1).astype(np.uint16))
    return tmp_path / "in"


def test_bands_can_be_chosen_and_ordered(aligned_capture: Path) -> None:
    def names(**options: object) -> list[str]:
        return [b.name for b in discover(aligned_capture, DiscoverOptions(**options)).captures[0].bands]  # type: ignore[arg-type]

    assert names(bands=("NIR", "green")) == ["green", "nir"]
    assert names(order="name") == ["green", "nir", "pan", "red"]
    with pytest.raises(ConfigurationError, match="no capture has a band 'swir'"):
        discover(aligned_capture, DiscoverOptions(bands=("nir", "swir")))
    result = discover(aligned_capture, DiscoverOptions(bands=("nir",)))
    assert not result.captures
    assert "leaves nir" in result.problems[0].text


def test_order_by_wavelength_keeps_the_reference(flight: Path) -> None:
    capture = discover(flight, DiscoverOptions(order="wavelength")).captures[0]
    assert [b.wavelength_nm for b in capture.bands] == [475, 560, 668, 717, 840]
    assert capture.reference.name == "Green"


def test_the_finest_resolution_is_the_pans(aligned_capture: Path, tmp_path: Path) -> None:
    settings = ONLY_SEED.model_copy(update={"write": WriteSettings(resolution="finest", crop="none")})
    (report,) = agalign.align_folder(aligned_capture, tmp_path / "out", settings=settings)
    assert report.sidecar is not None
    assert {b.status for b in report.sidecar.bands} == {"reference", "seed_only"}
    assert report.sidecar.output is not None
    assert report.sidecar.output.scale == (2.0, 2.0)
    pan = tifffile.imread(aligned_capture / "field_pan.tif").astype(float)
    with rasterio.open(tmp_path / "out" / "field.tif") as stack:
        assert stack.shape == (600, 800)
        written = stack.read(stack.descriptions.index("pan") + 1)[20:-20, 20:-20]
        np.testing.assert_allclose(written, pan[20:-20, 20:-20], atol=1)
        green = stack.read(stack.descriptions.index("green") + 1)[20:-20, 20:-20].astype(float)
    assert np.corrcoef(green.ravel(), pan[20:-20, 20:-20].ravel())[0, 1] > 0.97


def test_a_finer_grid_has_the_same_outline_on_the_map() -> None:
    transform = np.array([[0.1, 0, 5e5], [0, -0.1, 5e6], [0, 0, 1.0]])
    place = Georeference(transform, rasterio.CRS.from_epsg(32631).to_wkt())
    one = Band("a", Path("a"), 1, 100, 80, "uint8", georeference=place)
    pan = Band("pan", Path("b"), 1, 200, 160, "uint8")
    seed = Seed("identity", PixelScale(2.0, 2.0).matrix, 0.0)
    alignment = Alignment(PixelMapping(seed.fixed_to_moving), (100, 80), "aligned", (), seed)
    capture = Capture("c", Path(), (one, pan), 0)
    layers, grid = output_layers(capture, {"pan": alignment}, WriteSettings(resolution="finest", crop="none"))
    assert (grid.width, grid.height, grid.scale) == (200, 160, (2.0, 2.0))
    assert layers[1].mapping is not None
    np.testing.assert_allclose(layers[1].mapping(np.array([[10.0, 7.0]])), [[10.0, 7.0]], atol=1e-9)
    np.testing.assert_allclose(alignment.map(np.array([[0.0, 0.0]])), [[0.5, 0.5]])


def test_layout_bands_of_a_multiband_file(tmp_path: Path) -> None:
    pixels = np.stack([(3000 + g * textured_image(300, 240, 3)).clip(1) for g in (900, 500)]).astype(np.uint16)
    path = tmp_path / "in" / "ortho.tif"
    path.parent.mkdir()
    profile = {"driver": "GTiff", "width": 300, "height": 240, "count": 2, "dtype": "uint16"}
    with rasterio.open(path, "w", **profile) as dataset:
        dataset.write(pixels)
        dataset.descriptions = ("red", "near infra/red")
        dataset.scales, dataset.offsets = (1e-4, 1e-4), (0.0, -0.1)
        dataset.build_overviews([2, 4])
    for layout in ("bands", "stack"):
        settings = ONLY_SEED.model_copy(update={"write": WriteSettings(layout=layout)})
        agalign.align_folder(tmp_path / "in", tmp_path / layout, settings=settings)
    assert not (tmp_path / "bands" / "ortho.tif").exists()
    with rasterio.open(tmp_path / "bands" / "ortho_near_infra_red.tif") as band:
        np.testing.assert_array_equal(band.read(1), pixels[1])
        assert (band.scales, band.offsets) == ((1e-4,), (-0.1,))
    with rasterio.open(tmp_path / "stack" / "ortho.tif") as stack:
        assert stack.overviews(1) == [2, 4]
        assert stack.offsets == (0.0, -0.1)
    again = agalign.align_folder(
        tmp_path / "in",
        tmp_path / "bands",
        settings=ONLY_SEED.model_copy(update={"write": WriteSettings(layout="bands")}),
    )
    assert [r.state for r in again] == ["kept"]


def test_radiometry_without_tags_is_refused(aligned_capture: Path, tmp_path: Path) -> None:
    settings = ONLY_SEED.model_copy(update={"write": WriteSettings(radiometry="auto")})
    (report,) = agalign.align_folder(aligned_capture, tmp_path / "out", settings=settings)
    assert report.state == "error"
    assert report.error is not None
    assert "leave --radiometry out" in report.error
    assert not list((tmp_path / "out").glob("*.tif"))


@pytest.fixture(scope="module")
def calibrated_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic capture in `in`, and aligned in `out`, as reflectance and with an error map."""
    folder = tmp_path_factory.mktemp("calibrated")
    synthetic.make_flight(folder / "in", 1, (480, 360), rng_seed=3)
    settings = Settings(write=WriteSettings(radiometry="auto", error_map=True, indices=("ndvi", "savi")))
    (report,) = agalign.align_folder(folder / "in", folder / "out", settings=settings)
    assert report.good
    return folder


@pytest.fixture
def calibrated(calibrated_capture: Path, tmp_path: Path) -> Path:
    """A copy of `calibrated_capture`, which a test may change."""
    return shutil.copytree(calibrated_capture, tmp_path / "calibrated")


def test_ndvi_of_the_synthetic_flight_is_its_truth(calibrated: Path) -> None:
    out = calibrated / "out"
    (result,) = indices_of(out, "ndvi")
    assert not result.problem
    assert not result.raw_numbers
    assert result.path is not None
    with rasterio.open(result.path) as dataset:
        value = dataset.read(1)
        assert dataset.dtypes == ("float32",)
        assert np.isnan(dataset.nodata)
        assert dataset.tags()["RADIOMETRY"] == "reflectance"
    sidecar = json.loads(next(out.rglob("IMG_0001.json")).read_text())
    assert sidecar["output"]["radiometry"] == "reflectance by light sensor"
    # Bare soil and full crop of the generator, by their reflectances.
    bare, crop = (0.265 - 0.185) / (0.265 + 0.185), (0.52 - 0.055) / (0.52 + 0.055)
    low, high = np.nanpercentile(value, (5, 95))
    assert low == pytest.approx(bare, abs=0.12)
    assert high == pytest.approx(crop, abs=0.1)
    assert result.path.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"


def test_indices_of_the_same_pass_are_outputs_of_the_run(calibrated: Path) -> None:
    out = calibrated / "out"
    sidecar = json.loads(next(out.rglob("IMG_0001.json")).read_text())
    written = [p["file"] for p in sidecar["products"] if p["kind"] == "index"]
    assert written == ["IMG_0001_ndvi.tif", "IMG_0001_ndvi.png", "IMG_0001_savi.tif", "IMG_0001_savi.png"]
    table = (out / "indices.csv").read_text().splitlines()
    assert [line.split(",")[5] for line in table] == ["index", "ndvi", "savi"]
    (task,) = index_tasks(out, [INDICES["ndvi"]], out)
    (report,) = do_indices(task).reports
    assert report.kept, "the command does not replace them: their checksums are in the sidecar"
    assert [problems for _, problems in verify_outputs(out)] == [[]]
    agalign.align_folder(calibrated / "in", out, settings=ONLY_SEED)
    assert not list(out.rglob("*_ndvi.*"))


@pytest.mark.parametrize(
    ("index", "problem"),
    [
        ("xyz", "unknown index 'xyz'"), ("ndre", "no capture has them all; there are green"),
        ("savi", "needs reflectance; add --radiometry"),
    ],
)  # fmt: skip
def test_an_index_that_no_capture_can_have_is_refused_first(
    aligned_capture: Path, tmp_path: Path, index: str, problem: str
) -> None:
    settings = Settings(write=WriteSettings(indices=(index,)))
    with pytest.raises(ConfigurationError, match=problem):
        agalign.align_folder(aligned_capture, tmp_path / "out", settings=settings)


def test_an_index_of_bands_that_are_not_aligned_is_left_out(aligned_capture: Path, tmp_path: Path) -> None:
    agalign.align_folder(aligned_capture, tmp_path / "out", settings=ONLY_SEED)
    (result,) = indices_of(tmp_path / "out", "ndvi")
    assert "nir is seed_only" in result.problem
    assert not list((tmp_path / "out").glob("*ndvi*"))
    with pytest.raises(InputError, match="no sidecars"):
        indices_of(tmp_path / "nowhere", "ndvi")


def test_indices_go_with_the_stack_that_they_were_made_of(aligned_capture: Path, tmp_path: Path) -> None:
    """An index of raw numbers must not stand beside reflectance."""
    out = tmp_path / "out"
    agalign.align_folder(aligned_capture, out, settings=ONLY_SEED)
    write_band(out / "field_mine.tif", np.zeros((8, 8), np.float32))
    with rasterio.open(out / "field_mine.tif", "r+") as dataset:
        dataset.update_tags(INDEX_STATISTICS='{"unit": "reflectance"}')
    for name in ("field_mine.png", "field_notes.tif"):
        (out / name).write_bytes(b"x")
    agalign.align_folder(aligned_capture, out, settings=ONLY_SEED)
    assert (out / "field_mine.tif").exists(), "nothing was written anew"
    agalign.align_folder(aligned_capture, out, settings=ONLY_SEED, run=RunOptions(overwrite=True))
    assert {p.name for p in out.glob("field_*")} == {"field_notes.tif"}


def test_geo_seed_between_coordinate_systems() -> None:
    utm, web = rasterio.CRS.from_epsg(32631), rasterio.CRS.from_epsg(3857)
    one = Georeference(np.array([[0.5, 0, 500000], [0, -0.5, 5800000], [0, 0, 1.0]]), utm.to_wkt())
    # The same corner and about the same scale in Web Mercator, from its own transformation.
    x, y = rasterio.warp.transform(utm, web, [500000, 500400], [5800000, 5799700])
    other = Georeference(
        np.array([[(x[1] - x[0]) / 800, 0, x[0]], [0, (y[1] - y[0]) / 600, y[0]], [0, 0, 1.0]]), web.to_wkt()
    )
    bands = [Band("b", Path("b"), 1, 800, 600, "uint8", georeference=g) for g in (one, other)]
    seed = geo_seed(*bands)
    corners = geometry.apply(seed, np.array([[-0.5, -0.5], [799.5, 599.5]]))
    np.testing.assert_allclose(corners, [[-0.5, -0.5], [799.5, 599.5]], atol=0.1)
    # Meridians converge: the other two corners lie where the projection says, not on a rectangle.
    x2, y2 = rasterio.warp.transform(utm, web, [500400], [5800000])
    expected = np.linalg.inv(other.transform) @ [x2[0], y2[0], 1]
    np.testing.assert_allclose(geometry.apply(seed, np.array([[799.5, -0.5]]))[0], expected[:2] - 0.5, atol=0.1)


def test_a_stac_item_lies_beside_each_capture(flight: Path, tmp_path: Path) -> None:
    pystac = pytest.importorskip("pystac")
    settings = ONLY_SEED.model_copy(update={"write": WriteSettings(stac=True)})
    agalign.align_folder(flight, tmp_path, settings=settings)
    folder = tmp_path / "0000SET" / "000"
    item = pystac.Item.from_file(str(folder / "IMG_0001.stac.json"))
    assert item.geometry["coordinates"] == pytest.approx([5.0, 52.0])
    assert item.datetime.isoformat().startswith("2026-06-21T10:00:01")
    stack = item.assets["stack"]
    assert (folder / stack.href).is_file()
    nir = next(b for b in stack.extra_fields["bands"] if b["name"] == "NIR")
    assert nir["eo:center_wavelength"] == 0.84
    assert json.loads((folder / "IMG_0001.json").read_text())["position"]["latitude"] == pytest.approx(52.0)


def test_a_georeferenced_item_has_a_footprint(tmp_path: Path) -> None:
    pytest.importorskip("pystac")
    place = {"crs": rasterio.CRS.from_epsg(32631), "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    for name, gain in (("green", 900), ("red", 500)):
        pixels = (3000 + gain * textured_image(300, 240, 3)).clip(1).astype(np.uint16)
        write_band(tmp_path / "in" / f"f_{name}.tif", pixels, **place)
    agalign.align_folder(
        tmp_path / "in", tmp_path / "out", settings=ONLY_SEED.model_copy(update={"write": WriteSettings(stac=True)})
    )
    item = json.loads((tmp_path / "out" / "f.stac.json").read_text())
    ring = np.array(item["geometry"]["coordinates"][0])
    assert ring.shape == (5, 2)
    assert abs(ring[0] - ring[2]).max() < 0.001
    assert ring[0] == pytest.approx([3.0, 52.35], abs=0.05)
    assert "change of" in item["properties"]["agalign:datetime_source"]


def test_the_references_own_mask_is_kept(tmp_path: Path) -> None:
    for name, gain in (("green", 900), ("red", 500)):
        pixels = (3000 + gain * textured_image(300, 240, 3)).clip(0).astype(np.uint16)
        write_band(tmp_path / "in" / f"f_{name}.tif", pixels)
    mask = np.full((240, 300), 255, np.uint8)
    mask[100:140, 50:120] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(tmp_path / "in" / "f_green.tif", "r+") as dataset:
        dataset.write_mask(mask)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=ONLY_SEED)
    with rasterio.open(tmp_path / "out" / "f.tif") as stack:
        valid = stack.read_masks(stack.descriptions.index("green") + 1) > 0
        assert not valid[100:140, 50:120].any()
        assert valid.mean() == pytest.approx((mask > 0).mean())


def test_a_nodata_value_that_a_type_cannot_hold_is_not_declared(tmp_path: Path) -> None:
    scene = textured_image(300, 240, 3)
    write_band(tmp_path / "in" / "f_green.tif", (3000 + 900 * scene).astype(np.uint16), nodata=65535)
    write_band(tmp_path / "in" / "f_red.tif", (120 + 25 * scene).astype(np.uint8))
    settings = ONLY_SEED.model_copy(update={"write": WriteSettings(layout="bands")})
    (report,) = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    assert report.error is None
    with rasterio.open(tmp_path / "out" / "f_red.tif") as band:
        assert band.dtypes == ("uint8",)
        assert band.nodata in (None, 0)


def test_nothing_of_another_layout_or_of_a_lost_band_stays(tmp_path: Path) -> None:
    scene = textured_image(300, 240, 3)
    for name, gain in (("green", 900), ("red", 500), ("nir", 700)):
        write_band(tmp_path / "in" / f"f_{name}.tif", (3000 + gain * scene).clip(1).astype(np.uint16))
    settings = ONLY_SEED.model_copy(update={"write": WriteSettings(layout="both")})
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    assert (tmp_path / "out" / "f_nir.tif").is_file()
    write_band(tmp_path / "in" / "f_nir.tif", np.full((240, 300), 7, np.uint16))  # nothing to see any more
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    assert not (tmp_path / "out" / "f_nir.tif").exists()
    assert (tmp_path / "out" / "f_red.tif").is_file()
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=ONLY_SEED)
    assert sorted(p.name for p in (tmp_path / "out").glob("f*.tif")) == ["f.tif"]


def test_the_stack_and_a_photograph_of_its_name_live_beside_each_other(aligned_capture: Path) -> None:
    green = Band("green", aligned_capture / "field_green.tif", 1, 9, 9, "uint8")
    photograph = Band("RGB Red", aligned_capture / "field.jpg", 1, 9, 9, "uint8", one_lens=True)
    names = band_file_names(Capture("field", Path(), (green, photograph), 0))
    assert names == {"green": Path("field_green.tif"), "RGB Red": Path("field_jpg.tif")}


def test_bands_in_different_units_make_no_index(calibrated: Path) -> None:
    out = calibrated / "out"
    (stack,) = out.rglob("IMG_0001.tif")
    with rasterio.open(stack, "r+") as dataset:
        dataset.update_tags(dataset.descriptions.index("NIR") + 1, QUANTITY="radiance")
    assert "different units" in indices_of(out, "ndvi")[0].problem
    with rasterio.open(stack, "r+") as dataset:
        dataset.update_tags(dataset.descriptions.index("Red") + 1, QUANTITY="radiance")
    assert "needs reflectance, and the bands are radiance" in indices_of(out, "savi")[0].problem


def test_the_folder_of_the_images_is_no_output(aligned_capture: Path) -> None:
    with pytest.raises(ConfigurationError, match="is the folder of the images"):
        agalign.align_folder(aligned_capture, aligned_capture, settings=ONLY_SEED)


def test_bands_of_other_sizes_are_aligned(tmp_path: Path) -> None:
    canvas = cv2.GaussianBlur(textured_image(3000, 2400, 5), (0, 0), 1.5)

    def view(pixel_to_canvas: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(canvas, pixel_to_canvas, size_px, flags=flags)

    def turned(scale: float, angle: float, x: float, y: float) -> np.ndarray:
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        return np.array([[c, -s, x], [s, c, y], [0, 0, 1.0]])

    green = view(turned(1, 0, 198.5, 148.5), (2560, 1920)).reshape(480, 4, 640, 4).mean((1, 3))
    truth = {"pan": turned(2, 0.012, 230, 120), "lwir": turned(16, 0.01, 210, 160)}
    # Reversed contrast at twice the resolution, and a blurred image at a quarter.
    images = {
        "green": green, "pan": -view(truth["pan"], (1280, 960)),
        "lwir": cv2.GaussianBlur(view(truth["lwir"], (160, 120)), (0, 0), 0.7),
    }  # fmt: skip
    for name, pixels in images.items():
        write_band(tmp_path / "in" / f"f_{name}.tif", (3000 + 600 * pixels).clip(1).astype(np.uint16))
    (report,) = agalign.align_folder(tmp_path / "in", tmp_path / "out")
    assert report.sidecar is not None
    assert [b.band for b in report.sidecar.bands if b.grid is None] == ["green"]
    assert len(report.sidecar.bands) == 3
    for band in report.sidecar.bands:
        if band.grid is None:
            continue
        assert band.status == "aligned", band.reason
        expected = geometry.apply(
            geometry.compose(geometry.invert(truth[band.band]), turned(4, 0, 200, 150)),
            np.array(band.grid.reference_px),
        )
        width, height = images[band.band].shape[::-1]
        inside = ((expected > 0) & (expected < (width - 1, height - 1))).all(axis=1)
        error = np.linalg.norm(np.array(band.grid.moving_px) - expected, axis=1)[inside]
        assert np.median(error) < 0.15


@pytest.mark.parametrize(
    "options",
    [
        {"layout": "both", "undistort": True, "resolution": "finest"},
        {"layout": "bands", "format": "cog", "crop": "none", "radiometry": "auto"},
        {"layout": "both", "radiometry": "auto", "stac": True, "interpolation": "nearest"},
        {"layout": "stack", "format": "cog", "undistort": True, "compression": "none"},
    ],
    ids=str,
)
def test_options_go_together(relief_flight: Path, tmp_path: Path, options: dict[str, object]) -> None:
    write = WriteSettings.model_validate(options)
    settings = Settings(relief=ReliefSettings(use=True), write=write)
    (report,) = agalign.align_folder(relief_flight, tmp_path, settings=settings)
    assert report.error is None
    assert report.sidecar is not None
    assert report.sidecar.status == "ok"
    assert any(b.geometry is not None and b.geometry.kind != "homography" for b in report.sidecar.bands)
    folder = tmp_path / "0000SET" / "000"
    planes = {}
    for band in report.sidecar.bands:
        assert band.place is not None
        with rasterio.open(folder / band.place.file) as dataset:
            assert dataset.shape == report.sidecar.output.crop[3:1:-1]  # type: ignore[union-attr]
            plane = dataset.read(band.place.band_index).astype(float)
            planes[band.band] = np.where(dataset.read_masks(band.place.band_index) > 0, plane, np.nan)
    both = np.isfinite(planes["Green"]) & np.isfinite(planes["Red"])
    assert both.mean() > 0.8
    # Green and red see the same field: what options do to one they do to the other.
    assert np.corrcoef(planes["Green"][both], planes["Red"][both])[0, 1] > 0.6


@pytest.fixture(scope="module")
def relief_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One capture of terraces and trees."""
    folder = tmp_path_factory.mktemp("relief")
    synthetic.make_flight(folder, 1, (640, 480), rng_seed=5, relief_m=6.0)
    return folder


@pytest.mark.parametrize(("factor", "written"), [(1.0, True), (60_000.0, False)])
def test_floats_without_a_unit_are_reflectance_only_where_they_can_be(
    tmp_path: Path, factor: float, written: bool
) -> None:
    scene = (textured_image(320, 240, 5) * 0.05 + 0.4).clip(0, 1) * factor
    for name in ("red", "nir"):
        write_band(tmp_path / "in" / f"field_{name}.tif", scene.astype(np.float32))
    agalign.align_folder(tmp_path / "in", tmp_path / "out")
    by_name = {r.index: r for r in indices_of(tmp_path / "out", "savi", "ndvi")}
    assert (by_name["savi"].path is not None) == written
    assert "needs reflectance, and the bands are raw numbers" in by_name["savi"].problem or written
    assert by_name["ndvi"].path is not None
    assert by_name["ndvi"].raw_numbers != written


def test_the_error_map_lies_on_the_stack_s_grid_and_goes_when_not_asked_for(calibrated: Path) -> None:
    out = calibrated / "out"
    bands = json.loads(next(out.rglob("IMG_0001.json")).read_text())["bands"]
    (path,) = out.rglob("*.error.tif")
    with rasterio.open(path) as errors, rasterio.open(path.with_name("IMG_0001.tif")) as aligned:
        assert (errors.width, errors.height) == (aligned.width, aligned.height)
        assert list(errors.descriptions) == [b["band"] for b in bands if b["status"] == "aligned"]
        values = errors.read()
    assert ((values > 0) & (values < 1)).all()
    agalign.align_folder(calibrated / "in", out, settings=ONLY_SEED)
    assert not list(out.rglob("*.error.tif"))


@pytest.mark.parametrize(("accepted_px", "std_px", "written"), [(2.0, 1.5, True), (0.5, 0.8, False), (0.5, 0.4, True)])
def test_indices_take_the_bands_that_the_run_delivered(
    tmp_path: Path, accepted_px: float, std_px: float, written: bool
) -> None:
    """A band that `--accept-predicted` counts as delivered is good enough for indices, and no other."""
    for name, gain in (("green", 900), ("red", 500), ("nir", 700)):
        pixels = (3000 + gain * textured_image(300, 240, 3)).clip(1).astype(np.uint16)
        write_band(tmp_path / "in" / f"field_{name}.tif", pixels)
    settings = ONLY_SEED.model_copy(update={"check": CheckSettings(accept_predicted_px=accepted_px)})
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    path = tmp_path / "out" / "field.json"
    sidecar = json.loads(path.read_text())
    for band in sidecar["bands"]:
        if band["status"] != "reference":
            band |= {"status": "predicted", "prediction": {"from": "flight", "std_px": std_px, "off_px": None}}
    path.write_text(json.dumps(sidecar))
    (result,) = indices_of(tmp_path / "out", "ndvi")
    assert (result.path is not None) == written
    assert written or f"predicted to {std_px:g} px, not {accepted_px:g}" in result.problem
