import json
import os
import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from synthetic_flights.aligned import list_stack, make_aligned

from agalign.batch import index_run
from agalign.batch.index_run import index_tasks, run_indices
from agalign.errors import ConfigurationError, InputError, OutputError, WorkerError
from agalign.rasters.band_reader import RAW, UNSTATED
from agalign.rasters.output_grid import Layer
from agalign.records.captures import AlignedBand
from agalign.records.sidecar import FilePart
from agalign.records.sidecar_file import add_products, read_sidecar, verify_outputs, write_sidecar
from agalign.report.pages import write_pages
from agalign.spectral_indices import rasters
from agalign.spectral_indices.before_alignment import index_before
from agalign.spectral_indices.formulas import INDICES, bands_for, compute, evaluate, index_named, index_of_formula
from agalign.spectral_indices.indices_csv import current_rows, update_table
from agalign.spectral_indices.picture import write_picture
from agalign.spectral_indices.rasters import IndexReport
from agalign.values import geometry
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping

from ..conftest import raising, write_band, write_signed
from ..program import agalign_here
from ..run_outputs import aligned, context_of, index_of, indices_of, table_in

NO_FORMULAS = """__import__('os').system('true')\nN.real\n(lambda: N)()\nN if R else B\n[N][0]\nN; R\nN @ R\n'a'*N
sqrt(N, R)\nopen(N)\nN < R\nf'{N}'\n1e40*N\nN and R\nN*True"""


def test_the_index_before_alignment_is_that_of_the_files(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    raw = {name: random.integers(1, 900, (30, 40)).astype(np.uint16) for name in ("Red", "NIR")}
    bands = []
    for name, wavelength_nm in (("Red", 668.0), ("NIR", 840.0)):
        write_band(tmp_path / f"{name}.tif", raw[name])
        bands.append(Band(name, tmp_path / f"{name}.tif", 1, 40, 30, "uint16", wavelength_nm=wavelength_nm))
    capture, mapping = Capture("a", tmp_path, tuple(bands), 0), PixelMapping(geometry.translation(3, 2))
    layers = [Layer(bands[0], None, is_reference=True), Layer(bands[1], mapping)]
    grid, ndvi = OutputGrid(4, 5, 32, 20), INDICES["ndvi"]
    context = context_of(capture, {"NIR": aligned(mapping, (40, 30))}, layers=layers, grid=grid)
    red, nir = (raw[name][5:25, 4:36].astype(float) for name in ("Red", "NIR"))
    expected = ((nir - red) / (nir + red) + 1) / 2 * 255
    np.testing.assert_allclose(index_before(context, ndvi, (-1.0, 1.0)), expected, atol=0.51)
    # The files declare what their numbers mean, which the aligned index applies too.
    scaled = [replace(layer, band=replace(layer.band, scale_offset=(1e-4, 0.02))) for layer in layers]
    red, nir = (1e-4 * band + 0.02 for band in (red, nir))
    expected = ((nir - red) / (nir + red) + 1) / 2 * 255
    np.testing.assert_allclose(index_before(replace(context, layers=scaled), ndvi, (-1.0, 1.0)), expected, atol=0.51)
    # Bands of another size have no pixels at the same places.
    small = replace(capture, bands=(bands[0], replace(bands[1], width_px=20, height_px=15)))
    layers = [layers[0], replace(layers[1], band=small.bands[1])]
    assert index_before(replace(context, capture=small, layers=layers), ndvi, (-1.0, 1.0)) is None
    undistorted = replace(context, grid=OutputGrid(4, 5, 32, 20, undistorted=True))
    assert index_before(undistorted, ndvi, (-1.0, 1.0)) is None
    outside = replace(context, grid=OutputGrid(-1, 0, 32, 20))
    assert index_before(outside, ndvi, (-1.0, 1.0)) is None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        *((text, "formula") for text in NO_FORMULAS.splitlines()),
        *((text, "formula") for text in ("", "N\0", "\ud800", "(" * 200, "N" * 400, "-" * 290 + "(")),
        ("Q+N", "uses Q; the bands are B, G, R, RE and N"),
        ("1+1", "uses no band"),
        ("ndvi=N/R", "'ndvi' cannot name"),
        ("../x=N/R", "'../x' cannot name"),
        ("N+", "is not a formula"),
        ("2band=N/R", "'2band' cannot name a formula; use a letter, then up to 30 letters, digits or _"),
    ],
)
def test_a_formula_is_arithmetic_of_bands_and_nothing_else(text: str, problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem):
        index_of_formula(text)


ARITHMETIC = st.recursive(
    st.sampled_from(["B", "G", "R", "RE", "N", "0.5", "9"]),
    lambda inner: st.tuples(
        st.sampled_from(["(", "-(", "sqrt(", "log("]),
        inner,
        st.sampled_from(["+", "-", "*", "/", "^"]),
        inner,
        st.just(")"),
    ).map("".join),
)
SCRAPS = st.sampled_from(
    [*re.split(r"\s", NO_FORMULAS), *"()[]{}.,;:=#~@%&|<>^'", "**", "//", "1e400", "1j", "\0", "\ud800"]
)


@given(text=ARITHMETIC | st.lists(ARITHMETIC | SCRAPS, max_size=5).map("".join))
def test_any_formula_is_refused_or_has_one_value_per_pixel(text: str) -> None:
    with suppress(ConfigurationError):
        index = index_of_formula(text)
        bands = [np.full((2, 3), 0.1 * k, np.float32) for k, _ in enumerate(index.symbols)]
        assert compute(index, bands).shape == (2, 3)


def test_a_formula_has_the_value_of_its_arithmetic() -> None:
    n, r = np.float32([[0.5, 0.0, 0.2]]), np.float32([[0.1, 0.0, -0.2]])
    value = evaluate("-(N - R)^2 / (N + R) + sqrt(4) * 1.5e0", {"N": n, "R": r})
    assert value.dtype == np.float32
    assert value[0, 0] == pytest.approx(-(0.4**2) / 0.6 + 3, rel=1e-6)
    assert not np.isfinite(value[0, 1:]).any()
    assert np.isinf(evaluate("9**9**9 + 0*N", {"N": n})).all(), "and takes no time"
    towers = "N**" + "1**(" * 50 + "1" + ")" * 50, "(" * 40 + "N" + ")**-1" * 40, "N/(1/" * 40 + "N**-2" + ")" * 40
    towers += ("N/" + "2**(-1/" * 36 + "2" + ")" * 36,)
    assert [evaluate(tower, {"N": n}).shape for tower in towers] == [n.shape] * 4, "and these take none either"
    golden_ratio = evaluate("1/(1+" * 40 + "N" + ")" * 40, {"N": n})
    np.testing.assert_allclose(golden_ratio[0, ::2], (5**0.5 - 1) / 2, rtol=1e-6)


@pytest.mark.parametrize(
    "denominator",
    [
        *("N-R", "0.5*N-0.5*R", "2*(N-R)", "(N-R)/2", "-(R-N)", "+(N-R)", "abs(N-R)", "abs(R-N)", "sqrt(N-R)"),
        *("(N-R)*(N+R)", "(N-R)/(N+R)", "(N-R)**2", "R+2*(N-R)-N", "1/(1/(N-R))"),
    ],
)
def test_a_denominator_near_zero_has_no_value_however_it_is_written(denominator: str) -> None:
    """The difference of N and R is 0.1 % of their sum in the first pixel, and 25 % in the second."""
    n, r = np.float32([[0.5, 0.5]]), np.float32([[0.499, 0.3]])
    assert np.isfinite(evaluate(f"1/({denominator})", {"N": n, "R": r})).tolist() == [[False, True]]


def test_a_factor_of_a_denominator_is_compared_with_its_own_terms() -> None:
    """A product of differences of 10 % is not near zero, and infinite denominators have no value."""
    values = {"N": np.float32([[0.55]]), "R": np.float32([[0.45]])}
    finite = [np.isfinite(evaluate(text, values)).all() for text in ("1/((N-R)*(N-R))", "1/(N-R)**2", "1/exp(N*999)")]
    assert finite == [True, True, False]


def test_the_catalogue_gives_names_and_constants() -> None:
    pytest.importorskip("spyndex")
    wdrvi = index_named("WDRVI")
    assert (wdrvi.symbols, wdrvi.constants, wdrvi.any_unit) == (("N", "R"), (("alpha", 0.1),), True)
    assert not index_named("evi2").any_unit
    assert index_named("iavi").any_unit
    with pytest.raises(ConfigurationError, match="uses S1"):
        index_named("ndbi")


@pytest.mark.parametrize("name", INDICES)
def test_a_built_in_index_has_the_value_of_the_catalogue(name: str) -> None:
    spyndex = pytest.importorskip("spyndex")
    entry = spyndex.indices[{"ndre": "NDREI"}.get(name, name.upper())]
    rng = np.random.default_rng(0)
    values = {"RE1" if s == "RE" else s: rng.uniform(0.02, 0.3, 50) for s in INDICES[name].symbols}
    values |= {"N": rng.uniform(0.3, 0.6, 50)} if "N" in values else {}
    constants = {s: spyndex.constants[s].default for s in entry.bands if s not in values}
    constants |= {"L": 0.5} if name == "savi" else {}  # Huete's; the catalogue's default of L is that of EVI
    expected = spyndex.computeIndex(entry.short_name, values | constants)
    result = compute(INDICES[name], [np.float32(v)[None] for v in values.values()])[0]
    known = np.isfinite(result)
    assert known.mean() > 0.7
    np.testing.assert_allclose(result[known], expected[known], rtol=1e-4, atol=1e-5)


def test_values_statistics_and_tags_of_a_raster(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    mine = index_of_formula("mine = (N-RE)/(N+RE)")
    ndvi, ndre, by_formula = indices_of(tmp_path, "ndvi", "ndre", mine)
    with rasterio.open(tmp_path / "0000SET" / "IMG_0001.tif") as stack:
        _, red, nir, _ = stack.read().astype(float)
    truth = (nir - red) / (nir + red)
    with rasterio.open(ndvi.path) as dataset:
        np.testing.assert_allclose(dataset.read(1), truth, rtol=1e-5)
        tags = dataset.tags()
    known = ndvi.statistics
    assert [known.p5, known.median, known.p95] == pytest.approx(np.percentile(truth, (5, 50, 95)), abs=1e-5)
    assert (known.valid_share, known.unit, known.low, known.high) == (1.0, "reflectance", -0.2, 1.0)
    assert json.loads(tags["INDEX_STATISTICS"])["median"] == known.median
    assert tags["INDEX_FORMULA"] == "(N - R) / (N + R)"
    assert "INPUT" not in tags
    assert by_formula.median == ndre.median


def test_pixels_that_the_percentiles_skip_are_valid(tmp_path: Path) -> None:
    plane = np.full((2001, 2001), np.nan, np.float32)
    plane[1::2, 1::2] = 0.2
    write_band(tmp_path / "a.tif", np.stack([plane, 2 * plane]))
    bands = [AlignedBand(name, None, tmp_path / "a.tif", number) for number, name in enumerate(("red", "nir"), start=1)]
    report = index_of(bands, INDICES["ndvi"], tmp_path / "a")
    assert np.isnan(report.median)
    assert report.statistics.valid_share == pytest.approx(0.25, abs=1e-3)


def test_an_index_that_needs_reflectance_says_that_no_tag_states_it(tmp_path: Path) -> None:
    """Numbers from 0 to 1 may be radiance."""
    make_aligned(tmp_path, 1)
    path = tmp_path / "0000SET" / "IMG_0001.json"
    with rasterio.open(path.with_suffix(".tif")) as stack:
        pixels = stack.read()
    write_band(path.with_suffix(".tif"), pixels, nodata=np.nan)
    list_stack(path)
    (savi,) = indices_of(tmp_path, "savi")
    assert savi.statistics.unit == UNSTATED
    assert savi.problem == "its value depends on the unit of the bands, which no tag states"


def test_raw_numbers_are_named_and_drawn_in_neutral_greys(tmp_path: Path) -> None:
    import cv2

    folders = tmp_path / "raw", tmp_path / "reflectance"
    for folder in folders:
        make_aligned(folder, 1, raw=folder.name == "raw")
    (of_raw,), (of_reflectance,) = map(indices_of, folders)
    assert [report.statistics.unit for report in (of_raw, of_reflectance)] == [RAW, "reflectance"]
    with rasterio.open(of_raw.path) as dataset:
        assert dataset.tags()["INPUT"] == "raw numbers, not reflectance"
        low, high = np.percentile(dataset.read(1), (2, 98))
    assert (of_raw.statistics.low, of_raw.statistics.high) == pytest.approx((low, high), abs=1e-4)
    pictures = (cv2.imread(str(r.path.with_suffix(".png"))) for r in (of_raw, of_reflectance))
    grey, colour = (picture[:120, :160].astype(int) for picture in pictures)
    assert np.ptp(grey, axis=2).max() == 0
    assert np.ptp(colour, axis=2).max() > 50
    assert np.ptp(grey) > 150, "stretched over all greys"


def test_a_formula_of_the_user_that_depends_on_the_unit_is_told(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    with rasterio.open(tmp_path / "0000SET" / "IMG_0001.tif", "r+") as dataset:
        for number in dataset.indexes:
            dataset.update_tags(number, QUANTITY="radiance")
    list_stack(tmp_path / "0000SET" / "IMG_0001.json")
    formulas = "--formula", "mine=1.5*(N-R)/(N+R+0.5)", "--formula", "ratio=1.5*(N-R)/(N+R)"
    done = agalign_here("indices", tmp_path, *formulas)
    assert done.returncode == 0
    problem = "its value depends on the unit of the bands, which are radiance, not reflectance"
    assert done.stderr.endswith(f"(column problem of indices.csv), such as 0000SET/IMG_0001 mine: {problem}\n")
    write_pages(tmp_path, pytest.fail)
    of_ratio = "the light in each band is a part of its value, as the bands are radiance, not reflectance"
    assert [row["problem"] for row in table_in(tmp_path / "indices.csv")] == [problem, of_ratio]


def test_only_new_indices_are_calculated(tmp_path: Path) -> None:
    make_aligned(tmp_path, 3)
    assert [r.kept for r in indices_of(tmp_path)] == [False] * 3
    rasters = sorted(tmp_path.rglob("*_ndvi.tif"))
    before = [p.stat().st_mtime_ns for p in rasters]
    assert [r.kept for r in indices_of(tmp_path, "ndvi", "ndre")] == [True, False] * 3
    assert [p.stat().st_mtime_ns for p in rasters] == before
    os.truncate(rasters[0], rasters[0].stat().st_size - 300)
    rasters[1].with_suffix(".png").unlink()
    with rasterio.open(rasters[2].with_name("IMG_0003.tif"), "r+") as stack:
        stack.write(stack.read(1) / 2, 1)
    list_stack(rasters[2].with_name("IMG_0003.json"))
    assert [r.kept for r in indices_of(tmp_path)] == [False] * 3
    assert [r.kept for r in indices_of(tmp_path)] == [True] * 3
    changed = index_of_formula("x=N/R"), index_of_formula("x=N/G")
    assert [r.kept for index in changed for r in indices_of(tmp_path, index)] == [False] * 6
    assert [r.kept for r in indices_of(tmp_path, changed[1], overwrite=True)] == [False] * 3


def test_the_table_has_a_row_per_capture_and_index(tmp_path: Path) -> None:
    make_aligned(tmp_path / "out", 2)
    target = tmp_path / "indices"
    indices_of(tmp_path / "out", "ndvi", target=target)
    indices_of(tmp_path / "out", "ndre", target=target)
    rows = table_in(target / "indices.csv")
    names = [(capture, index) for capture in ("IMG_0001", "IMG_0002") for index in ("ndre", "ndvi")]
    assert [(r["capture"], r["index"]) for r in rows] == names
    assert [(r["latitude"], r["valid_share"], r["input"]) for r in rows] == [("52.0", "1.0", "reflectance")] * 4
    assert float(rows[1]["p5"]) < float(rows[1]["median"]) < float(rows[1]["p95"])
    assert not list((tmp_path / "out").rglob("*ndvi*"))
    (target / rows[0]["file"]).unlink()
    assert len(update_table(target, [])) == len(current_rows(target)) == 3


@pytest.mark.parametrize("line", [b",,", b"," * 40 + b"x", b"a\0b", b"1,2,3", b"\xe9", b"x" * 200_000 + b",y"])
def test_a_damaged_line_costs_only_its_own_row(tmp_path: Path, line: bytes) -> None:
    update_table(tmp_path, [IndexReport("IMG_0001", "ndvi", problem="left out")])
    path = tmp_path / "indices.csv"
    undamaged = path.read_bytes()
    path.write_bytes(undamaged + line + b"\n")
    assert [row.problem for row in current_rows(tmp_path)] == ["left out"]
    update_table(tmp_path, [])
    assert path.read_bytes() == undamaged


def test_one_damaged_stack_costs_only_its_own_indices(tmp_path: Path) -> None:
    make_aligned(tmp_path, 2)
    os.truncate(tmp_path / "0000SET" / "IMG_0001.tif", 3000)
    bad, good = indices_of(tmp_path)
    assert "IMG_0001.tif" in bad.problem
    assert good.path is not None


def test_the_exit_code_is_3_for_files_that_the_pages_lack(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    picture, sidecar = (tmp_path / "0000SET" / f"IMG_0001.{suffix}" for suffix in ("preview.jpg", "json"))
    picture.write_bytes(b"x")
    add_products(sidecar, "picture", [picture])
    write_pages(tmp_path, lambda _: None)
    for content, code in ((b"x", 0), (b"y", 3)):
        picture.write_bytes(content)
        done = agalign_here("indices", tmp_path)
        assert ("IMG_0001.preview.jpg: is not what was written" in done.stderr, done.returncode) == (code == 3, code)


@pytest.mark.parametrize("has_samples", [True, False])
@pytest.mark.parametrize("ids", [("a", "b"), ("a", ""), ("", "")])
def test_indices_of_another_flight_are_not_replaced(tmp_path: Path, ids: tuple[str, str], has_samples: bool) -> None:
    """Cameras give the captures of each flight the same names, and tags may be lost."""
    for flight, capture_id in zip(("one", "two"), ids, strict=True):
        make_aligned(tmp_path / flight, 1)
        path = tmp_path / flight / "0000SET" / "IMG_0001.json"
        with rasterio.open(path.with_suffix(".tif"), "r+") as stack:
            time = {} if has_samples else {"TIFFTAG_DATETIME": f"2026:06:21 10:00:0{int(flight == 'two')}"}
            stack.update_tags(CAPTURE_ID=capture_id, **time)
        samples = {"NIR": f"sample-of-{flight}"} if has_samples else {}
        list_stack(path, read_sidecar(path).model_copy(update={"input_samples": samples}))
    target = tmp_path / "indices"
    (report,) = indices_of(tmp_path / "one", target=target)
    before = report.path.read_bytes()
    with pytest.raises(ConfigurationError, match=r"IMG_0001_ndvi\.tif: is of another flight; choose another folder"):
        indices_of(tmp_path / "two", target=target)
    assert report.path.read_bytes() == before
    assert indices_of(tmp_path / "one", target=target)[0].kept


def test_a_formula_does_not_replace_the_index_of_another_capture(tmp_path: Path) -> None:
    """Captures `plot` and `plot_b`: NDVI of one has the name of a formula `b_ndvi` of the other."""
    formula = index_of_formula("b_ndvi=(N-G)/(N+G)")
    make_aligned(tmp_path, 2)
    second = tmp_path / "0000SET" / "IMG_0002.json"
    write_signed(second.with_name("IMG_0001_b.json"), second.read_text().replace("IMG_0002", "IMG_0001_b"))
    second.with_suffix(".tif").rename(second.with_name("IMG_0001_b.tif"))
    second.unlink()
    with pytest.raises(ConfigurationError, match=r"IMG_0001_b_ndvi\.tif: would be an index of .*'b_ndvi' another"):
        indices_of(tmp_path, "ndvi", formula)
    (ndvi,) = (report for report in indices_of(tmp_path, "ndvi") if report.path.name == "IMG_0001_b_ndvi.tif")
    before = ndvi.path.read_bytes()
    problem = next(report.problem for report in indices_of(tmp_path, formula) if report.problem)
    assert "is the index 'ndvi', not 'b_ndvi'; give the formula 'b_ndvi' another name" in problem
    assert ndvi.path.read_bytes() == before


def test_every_capture_that_failed_has_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_aligned(tmp_path, 2)
    write_pages(tmp_path, pytest.fail)
    os.truncate(tmp_path / "0000SET" / "IMG_0001.json", 900)
    monkeypatch.setattr(index_run, "write_index", raising(MemoryError()))
    indices_of(tmp_path)
    damaged, without_memory = table_in(tmp_path / "indices.csv")
    assert "IMG_0001.json" in damaged["problem"]
    assert "out of memory" in without_memory["problem"]


@pytest.mark.parametrize(("name", "problem"), [("green", "file of a band"), ("mine", "differs in size")])
def test_an_index_neither_replaces_a_band_nor_reads_one_of_another_size(
    tmp_path: Path, name: str, problem: str
) -> None:
    bands = []
    for band, size_px in (("green", (160, 120)), ("red", (320, 240))):
        path = tmp_path / f"a_{band}.tif"
        write_band(path, np.full(size_px[::-1], 0.1, np.float32))
        bands.append(AlignedBand(band, None, path, 1))
    report = index_of(bands, index_of_formula(f"{name}=(G-R)/(G+R)"), tmp_path / "a")
    assert report.path is None
    assert problem in report.problem
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a_green.tif", "a_red.tif"]


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_a_file_that_is_not_of_agalign_is_not_replaced(tmp_path: Path, suffix: str) -> None:
    make_aligned(tmp_path / "out", 1)
    place = tmp_path / "maps" / "0000SET" / f"IMG_0001_ndvi{suffix}"
    place.parent.mkdir(parents=True)
    shutil.copy(tmp_path / "out" / "0000SET" / "IMG_0001.tif", tmp_path / "stack.tif")
    before = (tmp_path / "stack.tif").read_bytes() if suffix == ".tif" else b"a picture of the user"
    place.write_bytes(before)
    (report,) = indices_of(tmp_path / "out", target=tmp_path / "maps", overwrite=True)
    assert report.problem == f"{place}: was not written by agalign; choose another folder with -o"
    assert place.read_bytes() == before


def test_a_table_that_is_not_of_agalign_is_not_replaced(tmp_path: Path) -> None:
    make_aligned(tmp_path / "out", 1)
    table = tmp_path / "maps" / "indices.csv"
    table.parent.mkdir()
    table.write_text("plot,ndvi\n1,0.7\n")
    with pytest.raises(ConfigurationError, match=r"indices\.csv: was not written by agalign; choose another folder"):
        indices_of(tmp_path / "out", target=tmp_path / "maps")
    assert table.read_text() == "plot,ndvi\n1,0.7\n"


@pytest.mark.slow
def test_the_sidecar_has_the_checksums_of_replaced_rasters(tmp_path: Path) -> None:
    """`agalign indices` after `agalign align --index` replaces files that the sidecar lists."""
    make_aligned(tmp_path, 1)
    path = tmp_path / "0000SET" / "IMG_0001.json"
    old = [FilePart(kind="index", file=f"IMG_0001_ndvi{end}", bytes=1, sha256="0" * 64) for end in (".tif", ".png")]
    write_sidecar(path, read_sidecar(path).model_copy(update={"products": old}))
    indices_of(tmp_path, "ndvi", target=tmp_path / "elsewhere")
    assert read_sidecar(path).products == old
    indices_of(tmp_path, "ndvi", "ndre")
    assert list(verify_outputs(tmp_path)) == [(path, [])]
    listed = [f"IMG_0001_{name}.{suffix}" for name in ("ndvi", "ndre") for suffix in ("tif", "png")]
    assert [part.file for part in read_sidecar(path).products] == listed


@pytest.mark.full
def test_processes_write_what_one_process_writes(tmp_path: Path) -> None:
    make_aligned(tmp_path, 20)
    serial = {r.capture: r.statistics for r in indices_of(tmp_path, target=tmp_path / "a")}
    tasks = index_tasks(tmp_path, [INDICES["ndvi"]], tmp_path / "b")
    parallel = {r.capture: r.statistics for d in run_indices(tasks, jobs=2) for r in d}
    assert parallel == serial
    one, other = (tmp_path / n / "0000SET" / "IMG_0007_ndvi.tif" for n in "ab")
    assert one.read_bytes() == other.read_bytes()


def test_the_report_has_the_indices(tmp_path: Path) -> None:
    make_aligned(tmp_path, 2)
    indices_of(tmp_path, "ndvi", "ndre")
    write_pages(tmp_path, pytest.fail)
    page = (tmp_path / "index.html").read_text()
    facts = json.loads(page.split('id="facts">')[1].split("</script>")[0])
    names = [[i["name"] for i in c["indices"]] for c in facts["details"]["records"]]
    assert names == [["ndre", "ndvi"]] * 2
    ndvi = facts["details"]["records"][0]["indices"][1]
    assert ndvi["span"] == [-0.2, 1.0]
    assert ndvi["picture"] == "0000SET/IMG_0001_ndvi.png"
    assert facts["rows"]["records"][0]["indices"]["ndvi"] == ndvi["median"]


NAMES = ("Blue-444", "Blue", "Green", "Red-650", "Red", "Red edge-705", "Red edge", "NIR")
NM = (444.0, 475.0, 560.0, 650.0, 668.0, 705.0, 717.0, 842.0)


@pytest.mark.parametrize(
    ("index", "names", "wavelengths_nm", "expected"),
    [
        ("ndvi", NAMES, NM, "NIR, Red"),
        ("ndre", NAMES, NM, "NIR, Red edge"),
        ("evi", NAMES, NM, "NIR, Red, Blue"),
        ("ndre", ("red", "NIR", "RedEdge"), (None,) * 3, "NIR, RedEdge"),
    ],
)
def test_bands_are_those_nearest_to_the_nominal_wavelength_or_with_the_name(
    index: str, names: tuple[str, ...], wavelengths_nm: tuple[float | None, ...], expected: str
) -> None:
    assert ", ".join(bands_for(INDICES[index], dict(zip(names, wavelengths_nm, strict=True)))) == expected


def test_a_missing_band_is_named() -> None:
    with pytest.raises(InputError, match="ndre needs a red edge band; there are Red, NIR"):
        bands_for(INDICES["ndre"], {"Red": 668.0, "NIR": 840.0})
    with pytest.raises(InputError, match="needs a red band"):
        bands_for(INDICES["ndvi"], {"Blue": 475.0, "Panchro": 634.5, "NIR": 842.0})
    assert index_named(" NDVI ").name == "ndvi"


def test_values_and_nodata() -> None:
    nir, red = np.float32([[0.5, 0.0, np.nan, 0.3]]), np.float32([[0.1, 0.0, 0.2, -0.3]])
    assert compute(INDICES["ndvi"], [nir, red]).dtype == np.float32
    np.testing.assert_allclose(compute(INDICES["ndvi"], [nir, red]), [[0.4 / 0.6, *[np.nan] * 3]], rtol=1e-6)
    # Noise around zero has no index.
    noise = compute(INDICES["ndvi"], [np.float32([[-0.01, 0.03]]), np.float32([[0.006, -0.01]])])
    visible = np.float32([[[0.1, 0.05]], [[0.02, 0.04]], [[0.118, 0.19]]])
    assert np.isnan([noise, compute(INDICES["vari"], list(visible))]).all()


@pytest.mark.parametrize(
    ("power", "division"),
    [
        ("(G-R) * (G+R-B)**-1", "(G-R) / (G+R-B)"),
        ("(G+R-B)^(-1/2)", "1 / (G+R-B)**0.5"),
        ("(G-R)**-2.0", "1 / ((G-R) * (G-R))"),
    ],
)
def test_a_negative_power_is_a_division(power: str, division: str) -> None:
    bands = {"G": [0.1, 0.5, 0.1, 0.0, 0.0], "R": [0.02, 0.1, 0.4, 0.0, 0.1], "B": [0.118, 0.1, 0.1, 0.0, 0.2]}
    values = {name: np.float32([band]) for name, band in bands.items()}
    by_power, by_division = evaluate(power, values), evaluate(division, values)
    assert 0 < np.isfinite(by_power).sum() < 5
    np.testing.assert_allclose(by_power, by_division, rtol=1e-5)


def test_a_raster_of_a_killed_command_is_listed_by_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_aligned(tmp_path, 1)
    with monkeypatch.context() as patch:
        patch.setattr(index_run, "add_products", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            indices_of(tmp_path)
    (report,) = indices_of(tmp_path)
    assert report.kept
    listed = read_sidecar(tmp_path / "0000SET" / "IMG_0001.json").products
    assert [part.file for part in listed if part.kind == "index"] == ["IMG_0001_ndvi.tif", "IMG_0001_ndvi.png"]


def test_an_index_raster_that_a_user_has_edited_is_not_replaced(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    (report,) = indices_of(tmp_path)
    with rasterio.open(report.path, "r+") as raster:
        raster.write(np.zeros((40, 160), np.float32), 1, window=((0, 40), (0, 160)))
    edited = report.path.read_bytes()
    (kept,) = indices_of(tmp_path)
    assert kept.problem.endswith(
        "is not what was written; delete it and run 'agalign indices' again; --overwrite replaces it"
    )
    assert report.path.read_bytes() == edited
    (again,) = indices_of(tmp_path, overwrite=True)
    assert (again.problem, report.path.read_bytes() == edited) == ("", False)


def test_the_output_folder_of_another_run_takes_no_indices(tmp_path: Path) -> None:
    """Its report would show them as its own."""
    for name in ("one", "two"):
        make_aligned(tmp_path / name, 1)
    (tmp_path / "two" / "agalign-run.json").touch()
    with pytest.raises(ConfigurationError, match="two: is the output folder of another run; choose another folder"):
        indices_of(tmp_path / "one", target=tmp_path / "two")


def test_the_output_folder_of_the_run_may_be_spelled_differently(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its sidecars list the rasters, and its report shows them."""
    make_aligned(tmp_path / "out", 1)
    write_pages(tmp_path / "out", pytest.fail)
    monkeypatch.chdir(tmp_path)
    for target, formula in ((Path("out"), "a=N-R"), (tmp_path / "out", "a=N+R"), (tmp_path / "out", "b=N-R")):
        assert agalign_here("indices", "out", "-o", target, "--formula", formula).returncode == 0
        assert agalign_here("verify", "out").returncode == 0
    listed = [part.file for part in read_sidecar(tmp_path / "out" / "0000SET" / "IMG_0001.json").products]
    assert {"IMG_0001_a.tif", "IMG_0001_b.tif"} <= {*listed}
    assert "IMG_0001_b.png" in (tmp_path / "out" / "index.html").read_text()


def test_paths_of_workers_are_below_the_folder_as_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_aligned(tmp_path / "out", 1)
    monkeypatch.chdir(tmp_path)
    tasks = index_tasks(Path("out"), [INDICES["ndvi"]], Path("out"))
    with ThreadPoolExecutor(1) as executor:
        [(report,)] = run_indices(tasks, executor=executor)
    assert report.path == Path("out/0000SET/IMG_0001_ndvi.tif")


def test_lost_workers_do_not_cost_the_finished_indices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_aligned(tmp_path, 2)

    def lost_after_one(function: Any, tasks: Any) -> Iterator[Any]:
        yield 0, partial(function, tasks[0])
        raise WorkerError("the Dask scheduler does not answer any more")

    monkeypatch.setattr(index_run, "open_workers", lambda *_, **__: nullcontext(lost_after_one))
    done = agalign_here("indices", tmp_path, "--json")
    assert done.returncode == 3
    assert [one["capture"] for one in json.loads(done.stdout)["indices"]] == ["0000SET/IMG_0001"]
    assert [row["capture"] for row in table_in(tmp_path / "indices.csv")] == ["IMG_0001"]
    assert "the Dask scheduler does not answer any more\n" in done.stderr


def test_an_index_that_cannot_be_written_does_not_cost_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_aligned(tmp_path, 1)

    def write_but_ndre(index: str, *arguments: Any, **options: Any) -> None:
        if index == "ndre":
            raise OutputError("the disk is full")
        write_picture(index, *arguments, **options)

    monkeypatch.setattr(rasters, "write_picture", write_but_ndre)
    written, unwritten, last = indices_of(tmp_path, "ndvi", "ndre", "gndvi")
    assert unwritten.problem == "the disk is full"
    listed = [part.file for part in read_sidecar(tmp_path / "0000SET" / "IMG_0001.json").products]
    assert [r.path.name in listed for r in (written, last)] == [True, True]


def test_the_table_has_no_failure_of_a_capture_that_is_gone(tmp_path: Path) -> None:
    make_aligned(tmp_path, 2)
    captures = [read_sidecar(path).capture for path in sorted(tmp_path.rglob("*.json"))]
    update_table(tmp_path, [IndexReport(f"0000SET/{name}", "ndre", problem="the disk is full") for name in captures])
    write_pages(tmp_path, pytest.fail)
    assert [row["capture"] for row in table_in(tmp_path / "indices.csv")] == captures
    for path in tmp_path.rglob(f"{captures[0]}*"):
        path.unlink()
    write_pages(tmp_path, pytest.fail)
    assert [row["capture"] for row in table_in(tmp_path / "indices.csv")] == captures[1:]
