"""Statistics of plots, against a plain numpy computation."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from synthetic_flights.aligned import make_aligned

import agalign
from agalign.products.plots import write_plots
from agalign.products.sidecar_file import read_sidecar, write_sidecar

from ..program import agalign_here

pytest.importorskip("exactextract", reason="needs pip install '.[plots]'")
geopandas = pytest.importorskip("geopandas", reason="needs pip install '.[plots]'")

BANDS = {"green": 560, "red": 668, "nir": 842, "red edge": 717}
NORTH_UP = Affine(0.5, 0, 600000, 0, -0.5, 5761000)
ROTATED = Affine.translation(600000, 5761000) * Affine.rotation(30) * Affine.scale(0.5, -0.5)
CRS = "EPSG:32631"


def write_field(path: Path, transform: Affine = NORTH_UP, seed: int = 0, **tags: str) -> np.ndarray:
    """A mosaic with holes; returns its bands (4, 120, 160)."""
    bands = np.random.default_rng(seed).uniform(0.05, 0.6, (4, 120, 160)).astype(np.float32)
    bands[:, 30:33, 40:60] = np.nan
    profile = {"driver": "GTiff", "width": 160, "height": 120, "count": 4, "dtype": "float32", "nodata": math.nan}
    with rasterio.open(path, "w", crs=CRS, transform=transform, **profile) as field:
        field.write(bands)
        field.descriptions = tuple(BANDS)
        field.update_tags(RADIOMETRY="reflectance", **tags)
        for k, wavelength_nm in enumerate(BANDS.values(), start=1):
            field.update_tags(k, wavelength=str(wavelength_nm))
    return bands


WINDOWS = {"A1": (10, 20, 30, 25), "A2": (35, 25, 20, 20), "B1": (150, 100, 30, 40)}
"""x0, y0, width, height of the plots, px; the last one reaches beyond the raster."""


def write_outlines(path: Path, transform: Affine = NORTH_UP, name: str = "plot") -> Path:
    """The plots in the CRS of the raster, so that they are whole pixels."""
    features = []
    for plot, (x, y, w, h) in WINDOWS.items():
        ring = [list(transform * corner) for corner in ((x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y))]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {name: plot}, "geometry": geometry})
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    return path


@pytest.mark.parametrize("transform", [NORTH_UP, ROTATED], ids=["north-up", "rotated"])
def test_the_numbers_are_those_of_numpy(tmp_path: Path, transform: Affine) -> None:
    bands = write_field(tmp_path / "field.tif", transform)
    outlines = write_outlines(tmp_path / "plots.geojson", transform)
    table = agalign.plot_statistics([tmp_path / "field.tif"], outlines, ["ndvi", "NDRE"]).table
    assert len(table) == 6
    _, red, nir, red_edge = bands.astype(np.float64)
    for _, row in table.iterrows():
        other = red if row["index"] == "ndvi" else red_edge
        x, y, w, h = WINDOWS[row["plot"]]
        values = ((nir - other) / (nir + other))[y : y + h, x : x + w].ravel()
        known = values[np.isfinite(values)]
        expected = {"mean": known.mean(), "median": np.median(known), "std": known.std()}
        expected |= {
            "p5": np.percentile(known, 5),
            "p95": np.percentile(known, 95),
            "valid_share": known.size / (w * h),
        }
        assert {k: row[k] for k in expected} == pytest.approx(expected, abs=1e-6)
        assert (row["unit"], row["capture"]) == ("reflectance", "field")
        assert math.isnan(row["expected_error_px"])


def test_pixels_at_the_edge_count_by_their_share(tmp_path: Path) -> None:
    bands = write_field(tmp_path / "field.tif")
    ring = [list(NORTH_UP * corner) for corner in ((100.5, 50), (102, 50), (102, 51), (100.5, 51), (100.5, 50))]
    frame = geopandas.GeoDataFrame(
        geometry=geopandas.GeoSeries.from_wkt([f"POLYGON (({', '.join(f'{x} {y}' for x, y in ring)}))"], crs=CRS)
    )
    frame.to_file(tmp_path / "plots.gpkg")
    (row,) = agalign.plot_statistics([tmp_path / "field.tif"], tmp_path / "plots.gpkg").table.to_dict("records")
    ndvi = (bands[2] - bands[1]) / (bands[2] + bands[1])
    assert row["mean"] == pytest.approx((0.5 * ndvi[50, 100] + ndvi[50, 101]) / 1.5, abs=1e-6)
    assert (row["plot"], row["valid_share"]) == ("1", pytest.approx(1.0))


def test_dates_are_rows_of_one_table_in_every_format(tmp_path: Path) -> None:
    write_field(tmp_path / "june.tif", seed=1, TIFFTAG_DATETIME="2026:06:21 10:00:00", GEOREFERENCE_ACCURACY_M="5.5")
    write_field(tmp_path / "may.tif", seed=2, TIFFTAG_DATETIME="2026:05:02 09:30:00")
    outlines = write_outlines(tmp_path / "plots.geojson", name="Name")
    rasters = tmp_path / "june.tif", tmp_path / "may.tif"
    for suffix in (".csv", ".geojson", ".parquet"):
        done = agalign_here("plots", *rasters, outlines, "-o", tmp_path / f"table{suffix}", "--index", "ndvi,ndre")
        assert done.returncode == 0, done.stderr
        assert "12 rows (plots: 3, captures: 2, indices: 2)" in " ".join(done.stdout.split())
        assert "accurate to 5.5 m" in " ".join(done.stdout.split())
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert [r["date"] for r in rows] == ["2026-05-02T09:30:00"] * 6 + ["2026-06-21T10:00:00"] * 6
    assert {r["plot"] for r in rows} == set(WINDOWS)
    assert (rows[0]["georeference_accuracy_m"], rows[-1]["georeference_accuracy_m"]) == ("", "5.5")
    on_map, parquet = (
        geopandas.read_file(tmp_path / "table.geojson"),
        geopandas.read_parquet(tmp_path / "table.parquet"),
    )
    assert on_map.crs == "EPSG:4326"
    assert parquet.crs == CRS
    for frame in (on_map, parquet):
        np.testing.assert_allclose(frame["mean"], [float(r["mean"]) for r in rows], rtol=1e-9)
        assert (frame.geometry.geom_type == "Polygon").all()


def test_a_formula_in_a_name_is_quoted(tmp_path: Path) -> None:
    write_field(tmp_path / "field.tif")
    outlines = write_outlines(tmp_path / "plots.geojson")
    outlines.write_text(outlines.read_text().replace('"A1"', '"=1+1"'))
    report = agalign.plot_statistics([tmp_path / "field.tif"], outlines)
    write_plots(report.table, tmp_path / "t.csv")
    assert "'=1+1" in (tmp_path / "t.csv").read_text()


def test_the_expected_error_is_that_of_the_worst_band(tmp_path: Path) -> None:
    write_field(tmp_path / "field.tif")
    profile = {"driver": "GTiff", "width": 160, "height": 120, "count": 3, "dtype": "float32", "nodata": math.nan}
    with rasterio.open(tmp_path / "field.error.tif", "w", crs=CRS, transform=NORTH_UP, **profile) as errors:
        for k, value in enumerate((0.1, 0.3, 0.7), start=1):
            errors.write(np.full((120, 160), value, np.float32), k)
        errors.descriptions = ("red", "nir", "red edge")
    outlines = write_outlines(tmp_path / "plots.geojson")
    table = agalign.plot_statistics([tmp_path / "field.tif"], outlines, ["ndvi", "ndre"]).table
    by_index = table.groupby("index")["expected_error_px"].mean()
    assert by_index.to_dict() == pytest.approx({"ndvi": 0.3, "ndre": 0.7})


def test_missing_bands_of_a_raster_are_listed(tmp_path: Path) -> None:
    write_field(tmp_path / "field.tif")
    outlines = write_outlines(tmp_path / "plots.geojson")
    done = agalign_here("plots", tmp_path / "field.tif", outlines, "-i", "ndvi,evi", "-o", tmp_path / "t.csv")
    assert done.returncode == 3
    (line,) = done.stderr.splitlines()
    assert "field: left out: evi needs a blue band" in line


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("field.tif", "plots.geojson", "-o", "t.xlsx"), 2, "t.xlsx: give a new file that ends in .csv, .geojson"),
        (("field.tif", "plots.geojson", "-o", "plots.geojson"), 2, "plots.geojson: give a new file"),
        (("field.tif", "plots.geojson", "--id", "x"), 2, "has no attribute 'x'; choose from plot"),
        (("field.tif", "points.geojson"), 1, "points.geojson: has no polygons"),
        (("field.tif", "nothing.geojson"), 1, "nothing.geojson: cannot be read as a vector file"),
        (("nothing.tif", "plots.geojson"), 1, "nothing.tif: does not exist"),
        (("flat.tif", "plots.geojson"), 1, "flat: has no georeference; align with --georeference, or use"),
        (("field.tif", "elsewhere.geojson"), 1, "elsewhere.geojson: none of its plots has pixels in the rasters"),
    ],
)
def test_unusable_input_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_field(Path("field.tif"))
    write_outlines(Path("plots.geojson"))
    write_outlines(Path("elsewhere.geojson"), Affine.translation(5000, 0) * NORTH_UP)
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [4.0, 52.0]}}
    Path("points.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [point]}))
    with rasterio.open("flat.tif", "w", driver="GTiff", width=9, height=9, count=1, dtype="uint8") as flat:
        flat.write(np.ones((9, 9), np.uint8), 1)
    before = Path("plots.geojson").read_text()
    done = agalign_here("plots", *arguments)
    assert done.returncode == code, done.stderr
    (line,) = done.stderr.splitlines()
    assert said in line
    assert Path("plots.geojson").read_text() == before
    assert not Path("plots.csv").exists()


def test_captures_of_a_run_are_rows_with_their_times(tmp_path: Path) -> None:
    out, outlines = tmp_path / "out", write_outlines(tmp_path / "plots.geojson")
    make_aligned(out, 3)
    failed = read_sidecar(out / "0000SET" / "IMG_0003.json").model_copy(update={"output": None})
    write_sidecar(out / "0000SET" / "IMG_0003.json", failed)
    with pytest.raises(agalign.InputError, match=r"align with --georeference|has no aligned bands"):
        agalign.plot_statistics([out], outlines)
    with rasterio.open(out / "0000SET" / "IMG_0002.tif", "r+") as stack:
        stack.crs, stack.transform = CRS, NORTH_UP
        nir, red = stack.read(3).astype(float), stack.read(2).astype(float)
    report = agalign.plot_statistics([out], outlines)
    assert sorted(label for label, _ in report.problems) == ["0000SET/IMG_0001", "0000SET/IMG_0003"]
    table = report.table
    assert set(table["capture"]) == {"0000SET/IMG_0002"}
    assert set(table["date"]) == {"2026-06-21T10:00:02"}
    x, y, w, h = WINDOWS["A1"]
    (row,) = table[table["plot"] == "A1"].to_dict("records")
    assert row["mean"] == pytest.approx(((nir - red) / (nir + red))[y : y + h, x : x + w].mean(), abs=1e-6)
