"""Sizes, orders, resolutions and indices: what options make of one capture."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from synthetic_flights.aligned import list_stack, make_aligned
from synthetic_flights.troubles import make_terraces

import agalign
from agalign.batch.output_files import refuse_to_overwrite
from agalign.cameras.tag_seeds import geo_seed
from agalign.errors import ConfigurationError
from agalign.rasters.aligned_files import band_file_names
from agalign.rasters.band_reader import RAW, UNSTATED, BandReader
from agalign.records.captures import AlignedBand
from agalign.records.sidecar_file import verify_outputs
from agalign.spectral_indices.rasters import check_indices
from agalign.synthetic import flight as synthetic
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Georeference

from ..conftest import Shared, read_json, seeded, textured_image, write_band, write_capture
from ..program import agalign_here
from ..run_outputs import change, indices_of

pytestmark = pytest.mark.slow
ONLY_SEED = seeded("identity")


def written(folder: Path, settings: agalign.Settings = ONLY_SEED, **options: Any) -> agalign.CaptureReport:
    """Align the capture of `folder`/in into `folder`/out."""
    (report,) = agalign.align_folder(
        folder / "in", folder / "out", settings=settings, run=agalign.RunOptions(**options)
    )
    return report


@pytest.fixture
def pan_capture(tmp_path: Path) -> Path:
    """Green, red and NIR without tags, and a panchromatic band of twice the resolution."""
    scene = textured_image(800, 600, 7)
    small = scene.reshape(300, 2, 400, 2).mean((1, 3))
    for name, image in {"green": 900 * small, "red": 600 * small, "nir": -700 * small, "pan": 800 * scene}.items():
        write_band(tmp_path / "in" / f"field_{name}.tif", (3000 + image).clip(1).astype(np.uint16))
    return tmp_path / "in"


def test_bands_can_be_chosen_and_ordered(pan_capture: Path, flight: Path) -> None:
    def names(folder: Path = pan_capture, **options: Any) -> list[str]:
        return [b.name for b in agalign.discover(folder, agalign.DiscoverOptions(**options)).captures[0].bands]

    assert names(bands=("NIR", "green")) == ["green", "nir"]
    assert names(order="name") == ["green", "nir", "pan", "red"]
    assert names(flight, order="wavelength") == ["Blue", "Green", "Red", "Red edge", "NIR"]
    assert agalign.discover(flight, agalign.DiscoverOptions(order="wavelength")).captures[0].reference.name == "Green"


def test_the_finest_resolution_is_the_pans(pan_capture: Path, tmp_path: Path) -> None:
    sidecar = written(tmp_path, seeded("identity", resolution="finest", crop="none")).sidecar
    assert {b.status for b in sidecar.bands} == {"reference", "seed_only"}
    assert sidecar.output.scale == (2.0, 2.0)
    pan = tifffile.imread(pan_capture / "field_pan.tif").astype(float)[20:-20, 20:-20]
    with rasterio.open(tmp_path / "out" / "field.tif") as stack:
        assert stack.shape == (600, 800)
        planes = dict(zip(stack.descriptions, stack.read()[:, 20:-20, 20:-20].astype(float), strict=True))
    np.testing.assert_allclose(planes["pan"], pan, atol=1)
    assert np.corrcoef(planes["green"].ravel(), pan.ravel())[0, 1] > 0.97


def test_layout_bands_of_a_multiband_file(tmp_path: Path) -> None:
    pixels = np.stack([(3000 + g * textured_image(300, 240, 3)).clip(1) for g in (900, 500)]).astype(np.uint16)
    path = tmp_path / "in" / "ortho.tif"
    write_band(path, pixels)
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = ("red", "near infra/red")
        dataset.scales, dataset.offsets = (1e-4, 1e-4), (0.0, -0.1)
        dataset.build_overviews([2, 4])
    written(tmp_path, seeded("identity", layout="bands"))
    assert not (tmp_path / "out" / "ortho.tif").exists()
    with rasterio.open(tmp_path / "out" / "ortho_near_infra_red.tif") as band:
        np.testing.assert_array_equal(band.read(1), pixels[1])
        assert (band.scales, band.offsets) == ((1e-4,), (-0.1,))
    assert written(tmp_path, seeded("identity", layout="bands")).state == "kept"
    written(tmp_path, seeded("identity", layout="stack"))
    with rasterio.open(tmp_path / "out" / "ortho.tif") as stack:
        assert stack.overviews(1) == [2, 4]
        assert stack.offsets == (0.0, -0.1)


def test_indices_of_the_synthetic_flight_are_its_truth(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path / "in", 1, (480, 360), rng_seed=3)
    write = agalign.WriteSettings(radiometry="auto", error_map=True, indices=("ndvi", "savi"))
    report, out = written(tmp_path, agalign.Settings(write=write)), tmp_path / "out"
    assert report.result.output.radiometry == "reflectance by light sensor"
    files = [p.file for p in report.result.products if p.kind == "index"]
    assert files == ["IMG_0001_ndvi.tif", "IMG_0001_ndvi.png", "IMG_0001_savi.tif", "IMG_0001_savi.png"]
    table = (out / "indices.csv").read_text().splitlines()
    assert [line.split(",")[5] for line in table] == ["index", "ndvi", "savi"]
    (ndvi,) = indices_of(out)
    assert ndvi.kept, "the command does not replace them: their checksums are in the sidecar"
    assert [problems for _, problems in verify_outputs(out)] == [[]]
    with rasterio.open(ndvi.path) as dataset:
        value = dataset.read(1)
        assert dataset.dtypes == ("float32",)
        assert np.isnan(dataset.nodata)
        assert dataset.tags()["RADIOMETRY"] == "reflectance"
    # Bare soil and full crop of the generator, by their reflectances.
    bare, crop = (0.265 - 0.185) / (0.265 + 0.185), (0.52 - 0.055) / (0.52 + 0.055)
    assert np.nanpercentile(value, (5, 95)) == pytest.approx([bare, crop], abs=0.11)
    assert ndvi.path.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    with rasterio.open(report.path.with_suffix(".error.tif")) as errors:
        assert errors.shape == value.shape
        assert list(errors.descriptions) == [b.band for b in report.result.bands if b.status == "aligned"]
        assert ((errors.read() > 0) & (errors.read() < 1)).all()


def test_bands_in_different_units_make_no_index(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    relative = "relative reflectance"
    for bands, quantity, index, problem in (
        (("NIR",), "radiance", "ndvi", "different units"),
        (("Red",), "radiance", "savi", "needs reflectance, and the bands are radiance; align with --radiometry"),
        (("Red", "NIR"), relative, "savi", f"needs reflectance, and the bands are {relative}; a calibration panel"),
    ):
        with rasterio.open(tmp_path / "0000SET" / "IMG_0001.tif", "r+") as dataset:
            for band in bands:
                dataset.update_tags(dataset.descriptions.index(band) + 1, QUANTITY=quantity)
        list_stack(tmp_path / "0000SET" / "IMG_0001.json")
        assert problem in indices_of(tmp_path, index)[0].problem


def test_an_index_of_bands_in_different_units_is_a_problem_of_every_run_and_no_damage(tmp_path: Path) -> None:
    """No run can write it: the capture is kept, and each run says why."""
    scene, folder, out = textured_image(400, 300, 7), tmp_path / "in", tmp_path / "out"
    for name, gain in {"green": 900, "red": 600}.items():
        write_band(folder / f"f_{name}.tif", (3000 + gain * scene).clip(1).astype(np.uint16))
    write_band(folder / "f_nir.tif", (0.4 + 0.05 * scene).astype(np.float32))
    settings = agalign.Settings(write=agalign.WriteSettings(indices=("ndvi",)))
    problem = "ndvi: its bands are in different units (raw numbers, unstated, in the range of reflectance)"
    for state in ("done", "kept"):
        report = written(tmp_path, settings)
        assert (report.state, report.problems, report.is_complete) == (state, (problem,), False)
        record = read_json(out / "agalign-run.json")
        assert [(part["kind"], part["problem"]) for part in record["problems"]] == [("impossible", problem)]
    verified = agalign_here("verify", out)
    assert (verified.returncode, verified.stderr) == (0, "")
    assert problem.removeprefix("ndvi: ") in (out / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("index", "problem"),
    [
        ("ndre", "no capture has them all; there are green"),
        ("savi", "needs reflectance; add --radiometry"),
        (" ", "unknown index ''; choose from ndvi"),
    ],
)
@pytest.mark.usefixtures("pan_capture")
def test_an_index_that_no_capture_can_have_is_refused_first(tmp_path: Path, index: str, problem: str) -> None:
    with pytest.raises(agalign.ConfigurationError, match=problem):
        written(tmp_path, agalign.Settings(write=agalign.WriteSettings(indices=(index,))))


def test_captures_that_lack_a_file_each_do_not_exclude_the_index_of_their_camera(tmp_path: Path) -> None:
    for name in ("1_green", "1_red", "2_green", "2_nir"):
        write_band(tmp_path / f"{name}.tif", np.full((64, 80), 3000, np.uint16))
    captures = agalign.discover(tmp_path).captures
    assert [[b.name for b in c.bands] for c in captures] == [["green", "red"], ["green", "nir"]]
    check_indices(captures, agalign.WriteSettings(indices=("ndvi",)))
    with pytest.raises(agalign.ConfigurationError, match=r"no capture has them all; there are green, red$"):
        check_indices(captures[:1], agalign.WriteSettings(indices=("ndvi",)))


@pytest.mark.parametrize("scale", [1.0, 1e-4])
def test_both_commands_take_integers_with_a_scale_as_reflectance(tmp_path: Path, scale: float) -> None:
    red, nir = ((3000 + gain * textured_image(300, 240, 3)).clip(1) for gain in (500, 700))
    path, out, is_raw = tmp_path / "in" / "field.tif", tmp_path / "out", scale == 1.0
    write_band(path, np.stack([red, nir]).astype(np.uint16))
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions, dataset.scales = ("red", "nir"), (scale, scale)
    plan = agalign_here("align", path.parent, "-o", out, "--index", "ndvi,savi", "--dry-run")
    assert ["raw numbers" in plan.stderr, "savi: needs reflectance" in plan.stderr] == [is_raw] * 2
    written(tmp_path, agalign.Settings())
    ndvi, savi = indices_of(out, "ndvi", "savi")
    assert [ndvi.raw_numbers, "needs reflectance" in savi.problem] == [is_raw] * 2


def test_indices_go_with_the_stack_that_they_were_made_of(tmp_path: Path) -> None:
    """An index of raw numbers must not stand next to reflectance."""
    write_capture(tmp_path / "in", "green", "red")
    out = tmp_path / "out"
    written(tmp_path)
    write_band(out / "f_mine.tif", np.zeros((8, 8), np.float32))
    with rasterio.open(out / "f_mine.tif", "r+") as dataset:
        dataset.update_tags(
            TIFFTAG_SOFTWARE="agalign",
            INDEX="mine",
            INDEX_FORMULA="of a lost table",
            INDEX_STATISTICS='{"unit": "reflectance"}',
        )
    for name in ("f_mine.png", "f_notes.tif"):
        (out / name).write_bytes(b"x")
    written(tmp_path)
    assert (out / "f_mine.tif").exists(), "nothing was written again"
    removed = written(tmp_path, overwrite=True).removed
    assert {p.name for p in out.glob("f_*")} == {"f_mine.png", "f_notes.tif"}
    assert removed == ((out / "f_mine.tif", "its formula is unknown"),)


def test_geo_seed_between_coordinate_systems() -> None:
    utm, web = rasterio.CRS.from_epsg(32631), rasterio.CRS.from_epsg(3857)
    one = Georeference(np.array([[0.5, 0, 500000], [0, -0.5, 5800000], [0, 0, 1.0]]), utm.to_wkt())
    # The same corner and about the same scale in Web Mercator, from its own transformation.
    x, y = rasterio.warp.transform(utm, web, [500000, 500400], [5800000, 5799700])
    transform = np.array([[(x[1] - x[0]) / 800, 0, x[0]], [0, (y[1] - y[0]) / 600, y[0]], [0, 0, 1.0]])
    pair = one, Georeference(transform, web.to_wkt())
    seed = geo_seed(*(Band("b", Path("b"), 1, 800, 600, "uint8", georeference=g) for g in pair))
    # Meridians converge: the corners are where the projection says, not on a rectangle.
    corners = geometry.corners(801, 601)
    on_web = np.transpose(rasterio.warp.transform(utm, web, *geometry.apply(one.transform, corners).T))
    expected = geometry.apply(np.linalg.inv(transform), on_web) - 0.5
    np.testing.assert_allclose(geometry.apply(seed, corners - 0.5), expected, atol=0.1)


def test_the_references_own_mask_is_kept(tmp_path: Path) -> None:
    write_capture(tmp_path / "in", "green", "red")
    mask = np.full((240, 300), 255, np.uint8)
    mask[100:140, 50:120] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(tmp_path / "in" / "f_green.tif", "r+") as dataset:
        dataset.write_mask(mask)
    written(tmp_path)
    with rasterio.open(tmp_path / "out" / "f.tif") as stack:
        valid = stack.read_masks(stack.descriptions.index("green") + 1) > 0
    np.testing.assert_array_equal(valid, mask > 0)


def test_a_nodata_value_that_a_type_cannot_hold_is_not_declared(tmp_path: Path) -> None:
    write_capture(tmp_path / "in", "green", nodata=65535)
    write_band(tmp_path / "in" / "f_red.tif", (120 + 25 * textured_image(300, 240, 3)).astype(np.uint8))
    assert written(tmp_path, seeded("identity", layout="bands")).error is None
    with rasterio.open(tmp_path / "out" / "f_red.tif") as band:
        assert band.dtypes == ("uint8",)
        assert band.nodata in (None, 0)


def test_files_of_another_layout_or_of_a_lost_band_are_removed(tmp_path: Path) -> None:
    def files() -> list[str]:
        return sorted(p.name for p in (tmp_path / "out").glob("f*.tif"))

    write_capture(tmp_path / "in", "green", "red", "nir")
    written(tmp_path, seeded("identity", layout="both"))
    assert files() == ["f.tif", "f_green.tif", "f_nir.tif", "f_red.tif"]
    write_band(tmp_path / "in" / "f_nir.tif", np.full((240, 300), 7, np.uint16))  # without any texture
    written(tmp_path, seeded("identity", layout="bands"))
    assert files() == ["f_green.tif", "f_red.tif"]


def test_the_file_of_a_photograph_does_not_take_the_name_of_the_stack() -> None:
    green = Band("green", Path("field_green.tif"), 1, 9, 9, "uint8")
    photograph = Band("RGB Red", Path("field.jpg"), 1, 9, 9, "uint8", one_lens=True)
    names = band_file_names(Capture("field", Path(), (green, photograph), 0))
    assert names == {"green": Path("field_green.tif"), "RGB Red": Path("field_jpg.tif")}


@pytest.mark.parametrize(("stem", "other"), [("field", "field_green"), ("Field", "field_red"), ("x", "X_red")])
def test_names_differ_in_more_than_case(stem: str, other: str) -> None:
    bands = [
        Band(str(k), Path(name), 1, 9, 9, "uint8")
        for k, name in enumerate((f"{stem}.TIF", f"{other}.tif", "x_red.TIF"))
    ]
    names = band_file_names(Capture(stem.lower(), Path(), tuple(bands), 0)).values()
    assert len({str(name).lower() for name in (*names, f"{stem}.tif")}) == 4


@pytest.mark.parametrize("length", [241, 243, 245])
def test_a_name_that_is_too_long_is_refused_at_the_start(tmp_path: Path, length: int) -> None:
    name = "é" * (length // 2)
    write_capture(tmp_path / "in", "green", "red", name="f")
    for path in (tmp_path / "in").iterdir():
        path.rename(path.with_name(path.name.replace("f_", f"{name}_")))
    scan = agalign.discover(tmp_path / "in")
    if too_long := len(f"{scan.captures[0].name}.parallax.tif".encode()) > 255:
        with pytest.raises(ConfigurationError, match=r"parallax.tif would have \d+ bytes, and file systems take"):
            refuse_to_overwrite(scan.captures, tmp_path / "out", agalign.WriteSettings())
    else:
        refuse_to_overwrite(scan.captures, tmp_path / "out", agalign.WriteSettings())
    assert too_long == (length > 243)


@pytest.mark.full
@pytest.mark.parametrize(
    "options",
    [
        {"layout": "both", "undistort": True, "resolution": "finest"},
        {"layout": "bands", "format": "cog", "crop": "none", "radiometry": "auto"},
        {"layout": "both", "radiometry": "auto", "qa": True, "interpolation": "nearest"},
        {"layout": "stack", "format": "cog", "undistort": True, "compression": "none"},
    ],
    ids=str,
)
def test_options_go_together(shared: Shared, tmp_path: Path, options: dict[str, object]) -> None:
    """Of one capture of terraces and trees."""
    flight = shared("relief_flight", lambda f: make_terraces(f, (640, 480), rng_seed=5, relief_m=6.0))
    settings = agalign.Settings(
        relief=agalign.ReliefSettings(use=True), write=agalign.WriteSettings.model_validate(options)
    )
    (report,) = agalign.align_folder(flight, tmp_path, settings=settings)
    assert report.error is None
    assert report.sidecar.status == "ok"
    assert any(b.geometry is not None and b.geometry.kind != "homography" for b in report.sidecar.bands)
    planes = {}
    for band in report.sidecar.bands:
        with rasterio.open(tmp_path / "0000SET" / "000" / band.place.file) as dataset:
            assert dataset.shape == report.sidecar.output.crop[3:1:-1]
            plane = dataset.read(band.place.band_index).astype(float)
            planes[band.band] = np.where(dataset.read_masks(band.place.band_index) > 0, plane, np.nan)
    both = np.isfinite(planes["Green"]) & np.isfinite(planes["Red"])
    assert both.mean() > 0.8
    # Green and red see the same field: what options do to one they do to the other.
    assert np.corrcoef(planes["Green"][both], planes["Red"][both])[0, 1] > 0.6


@pytest.mark.parametrize(("factor", "unit"), [(1.0, UNSTATED), (60_000.0, RAW)])
def test_floats_without_a_unit_may_be_reflectance(tmp_path: Path, factor: float, unit: str) -> None:
    scene = (textured_image(320, 240, 5) * 0.05 + 0.4).clip(0, 1) * factor
    write_band(tmp_path / "a.tif", scene.astype(np.float32))
    with BandReader() as reader:
        assert reader.units(AlignedBand("red", None, tmp_path / "a.tif", 1)) == [unit]


@pytest.mark.parametrize(
    ("status", "accepted_px", "std_px", "problem"),
    [
        ("predicted", 2.0, 1.5, ""),
        ("predicted", 0.5, 0.8, "NIR is predicted with an expected error of 0.80 px, above 0.5 px of the band"),
        ("predicted", 0.5, 0.4, ""),
        ("seed_only", 0.5, 0.4, "NIR is seed only"),
    ],
)
def test_indices_of_delivered_bands(
    tmp_path: Path, status: str, accepted_px: float, std_px: float, problem: str
) -> None:
    """A band that `--accept-predicted` counts as delivered is good enough for indices, and no other."""
    make_aligned(tmp_path, 1)
    path = tmp_path / "0000SET" / "IMG_0001.json"
    prediction = {"from": "flight", "std_px": std_px, "fixed_to_moving": np.eye(3).tolist()}
    of_nir = {"status": status, "prediction": prediction, "error": {"std_px": std_px, "std_band_px": std_px}}
    bands = [part | (of_nir if part["band"] == "NIR" else {}) for part in read_json(path)["bands"]]
    change(path, bands=bands, accept_predicted_px=accepted_px)
    (result,) = indices_of(tmp_path)
    assert (result.path is None) == bool(problem)
    assert problem in result.problem
