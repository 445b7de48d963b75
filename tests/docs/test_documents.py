"""Every command and every script of the documents is run, every example too, and every link leads somewhere."""

import csv
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import tifffile
from rasterio.transform import Affine
from shapely import Polygon
from synthetic_flights.cameras import ALTUM, MAVIC_3M
from synthetic_flights.troubles import make_flight_between_panels

import agalign
from agalign.cameras.metadata import read_tags
from agalign.cameras.pix4d import perspective_lens
from agalign.records.sidecar_file import read_sidecar
from agalign.synthetic import flight as synthetic
from agalign.values import geometry

from ..builders import displaced_views, in_full_run
from ..cli.test_onto import TRUTH as MOVEMENT
from ..cli.test_onto import write_mosaic
from ..conftest import REAL_DATA, Shared, textured_pair, write_band
from ..program import agalign_here
from .blocks import PAGES, ROOT, blocks_of, commands_of, each_page, program, run_command, text_of

RUN_BY = {"docker": "tools/container.sh", "dask": "tools/dask_cluster.sh", "pip": ".ci/run"}
"""What cannot be run inside a test, and the script that runs it and what stands with it in a block."""
KINDS = {"sh", "python", "text"}
RUNNABLE = [page for page in PAGES if any(b.kind in ("sh", "python") for b in blocks_of(page))]
LONG = re.compile(
    "bad-flight|choose-captures|close-range|comparison|dji|first-flight|large-flights|micasense|paper|photogrammetry|"
    "python|qgis|reflectance|sentera|sequoia|thermal"
)
"""Pages with blocks that take seconds, and of commands that other tests run: only the full run has them."""


def write_ndvi_and_plots(folder: Path, rotation_deg: float = 0.0) -> None:
    """ndvi.tif with 0.5 and 0.8, and plots.gpkg: a square in both halves and over the edge, with and without an id, and
    a self-intersecting outline; all rotated about the top left corner.
    """
    ndvi = np.full((60, 100), 0.5, np.float32)
    ndvi[:, 50:], ndvi[:, :10] = 0.8, np.nan  # nan is outside of the flight
    transform = Affine.translation(500_000, 4_000_000) @ Affine.rotation(rotation_deg) @ Affine.scale(0.1, -0.1)
    write_band(folder / "ndvi.tif", ndvi, nodata=np.nan, crs="EPSG:32633", transform=transform)
    rings = {"A1": ((2, 1), (4, 1), (4, 3), (2, 3)), "": ((6, 1), (8, 1), (8, 3), (6, 3))}
    rings |= {"edge": ((0, 4), (2, 4), (2, 6), (0, 6)), "bow tie": ((6, 5), (9, 5), (6, 4), (9, 4))}
    outlines = [Polygon([transform @ (10 * x, 10 * y) for x, y in ring]) for ring in rings.values()]
    ids = {"plot": [name or None for name in rings]}
    import geopandas  # late: it takes a second in each process of the tests

    frame = geopandas.GeoDataFrame(ids, geometry=outlines, crs="EPSG:32633")
    frame.to_crs("EPSG:4326").to_file(folder / "plots.gpkg")


@pytest.fixture(scope="session")
def originals(shared: Shared, flight: Path) -> Path:
    """What a reader has before he begins: a flight, mosaics, pairs of images, and benchmarks and examples."""

    def fill(folder: Path) -> None:
        shutil.copytree(flight, folder / "flight")
        synthetic.make_flight(folder / "altum", captures=2, size_px=(640, 480), rng_seed=4, camera=ALTUM)
        dates = textured_pair(MOVEMENT, 640, 520)
        for name, image, off_m in zip(("spring", "summer"), dates, ((0, 0), (3, -4)), strict=True):
            write_mosaic(folder / f"{name}.tif", image, off_m, bands=4)
        for number, seed in enumerate((1, 2), start=1):
            for side, image in zip("ab", textured_pair(MOVEMENT, 240, 200, seed), strict=True):
                cv2.imwrite(str(folder / f"{number}{side}.png"), (image * 40 + 128).clip(1, 254).astype(np.uint8))
            np.savetxt(folder / f"{number}.txt", MOVEMENT)
        (folder / "pairs.csv").write_text("fixed,moving,homography\n1a.png,1b.png,1.txt\n2a.png,2b.png,2.txt\n")
        write_ndvi_and_plots(folder)
        for side, name in zip("ab", ("green", "nir"), strict=True):
            cv2.imwrite(str(folder / f"{name}.tif"), cv2.imread(str(folder / f"1{side}.png"), cv2.IMREAD_UNCHANGED))
        points = geometry.lattice(240, 200, 9, 7)
        ties = np.hstack([points, geometry.apply(MOVEMENT, points)])
        np.savetxt(folder / "ties.csv", ties, delimiter=",", header="fixed_x,fixed_y,moving_x,moving_y", comments="")
        np.savetxt(folder / "homography.txt", MOVEMENT)
        for name in ("examples", "benchmarks"):
            (folder / name).symlink_to(ROOT / name)
        if REAL_DATA.is_dir():
            (folder / "DATA").symlink_to(REAL_DATA)

    return shared("desk", fill)


@pytest.fixture
def desk(originals: Path, aligned_flight: Path, tmp_path: Path) -> Path:
    """A folder of one page, so that no page depends on another; the flight is aligned."""
    folder = shutil.copytree(originals, tmp_path / "desk", symlinks=True)
    shutil.copytree(aligned_flight, folder / "aligned")
    return folder


def run_python(text: str) -> dict[str, Any]:
    """Run a script with the images `green` and `nir`; return its variables."""
    bands = {name: f"flight/0000SET/000/IMG_0001_{number}.tif" for name, number in (("green", 2), ("nir", 4))}
    names: dict[str, Any] = {name: cv2.imread(path, cv2.IMREAD_UNCHANGED) for name, path in bands.items()}
    with warnings.catch_warnings(action="ignore"):
        exec(text, names)
    return names


def run_page(page: Path, codes: Sequence[int] = (0,)) -> None:
    """Run the blocks of a page from top to bottom, in the current folder; commands return one of these exit codes."""
    for block in blocks_of(page):
        if named := re.match(r"# (\w+\.py)\n", block.text):
            Path(named[1]).write_text(block.text, encoding="utf-8")
        if block.kind == "python":
            run_python(block.text)
        commands = commands_of(block) if block.kind == "sh" else []
        if " DATA " in block.text and not REAL_DATA.is_dir():
            pytest.skip(f"{block.where} is about real captures, which are not at {REAL_DATA}")
        expected = (3,) if "# exit code 3" in block.text else codes
        if not any(program(command) in RUN_BY for command in commands):
            for command in commands:
                run_command(command, block.where, expected)


@pytest.mark.slow
@each_page(page for page in RUNNABLE if not LONG.fullmatch(page.stem))
def test_the_blocks_of_a_page_run(page: Path, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    run_page(page)


@pytest.mark.full
@each_page(RUNNABLE)
def test_a_page_by_itself(page: Path, originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(shutil.copytree(originals, tmp_path / "desk", symlinks=True))
    run_page(page)


@pytest.fixture(scope="session")
def mixed_flight(shared: Shared) -> Path:
    """A flight of two cameras with four kinds of captures of the first: aligned, without a readable reference, with
    constant bands, and of a calibration panel.
    """

    def fill(folder: Path) -> None:
        make_flight_between_panels(folder, 4, (640, 480), sun=(1.0, 1.0))
        files = folder / "0000SET" / "000"
        for path in sorted(files.glob("IMG_*.tif")):  # the panel is IMG_0000 and IMG_0005
            path.rename(path.with_name(f"IMG_{int(path.name[4:8]) - 1:04d}{path.name[8:]}"))
        with tifffile.TiffFile(files / "IMG_0003_2.tif", mode="r+") as reference:
            offsets = reference.pages.first.tags["StripOffsets"]
            offsets.overwrite([1 << 30] * offsets.count)  # beyond the end of the file
        for number in (1, 3, 4, 5):
            with rasterio.open(files / f"IMG_0004_{number}.tif", "r+") as band:
                band.write(np.full_like(band.read(), 2000))
        synthetic.make_flight(folder / "second", captures=2, size_px=(640, 480), rng_seed=4, camera=MAVIC_3M)

    return shared("mixed flight", fill)


@pytest.fixture(scope="session")
def mixed_originals(shared: Shared, originals: Path, mixed_flight: Path) -> Path:
    """`originals` with another flight, and the flight aligned."""

    def fill(folder: Path) -> None:
        shutil.copytree(originals, folder, symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(folder / "flight")
        shutil.copytree(mixed_flight, folder / "flight")
        assert agalign_here(folder / "flight", "-o", folder / "aligned").returncode == 3

    return shared("mixed desk", fill)


@pytest.mark.full
@each_page(page for page in RUNNABLE if page.parent.name in ("how-to", "tutorial"))
def test_a_page_on_a_flight_with_panel_two_cameras_and_failed_captures(
    page: Path, mixed_originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree(mixed_originals, tmp_path / "desk", symlinks=True))
    run_page(page, codes=(0, 3))


EXAMPLES = {
    "two_arrays.py": ("", "aligned", 2),
    "training_tiles.py": ("aligned", "1 tiles for training, 1 for validation\n(1, 5, 256, 256): ", 1),
    "one_capture.py": ("flight one", ": aligned, ", 4),
    "one_day.py": ("flight 2026-06-21 day", "2 captures", 1),
    "whole_flight.py": ("flight whole", " aligned ", 8),
    "ndvi_over_a_flight.py": ("aligned", " at 52.", 2),
    "next_flight.py": ("flight flight next", "4 of 4 aligned", 2),
    "on_dask.py": ("flight dask", " done ", 2),
    "map_pixels.py": ("aligned/0000SET/000/IMG_0001.json NIR 100 80", "NIR: [", 1),
    "water.py": ("aligned/0000SET/000/IMG_0001.tif water.tif 0.05", " are water", 1),
    "plots.py": ("plots.gpkg ndvi.tif", "", 1),
    "compare_pair.py": ("green.tif nir.tif ties.csv homography.txt", "the homography: median error 0.000 px", 1),
    "two_dates.py": ("spring.tif summer.tif change.tif", "offset before alignment: ", 1),
    "warp_matrices.py": ("aligned/0000SET/000/IMG_0001.json", "_warp_matrices_opencv.npy: 5 bands", 1),
}
"""{name: (arguments, a part of what it prints, how many times)}."""


def move_second_capture_east(flight_map: Path) -> None:
    """Move its footprint by a hundredth of a degree, far from the first capture."""
    content = json.loads(flight_map.read_text(encoding="utf-8"))
    (ring,) = content["features"][1]["geometry"]["coordinates"]
    for corner in ring:
        corner[0] += 0.01
    flight_map.write_text(json.dumps(content), encoding="utf-8")


def test_every_example_is_run() -> None:
    assert {path.name for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("name", [in_full_run(n) if n in ("next_flight.py", "on_dask.py") else n for n in EXAMPLES])
def test_an_example(name: str, desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, text, times = EXAMPLES[name]
    monkeypatch.chdir(desk)
    if name == "training_tiles.py":
        assert agalign_here("flight", "-o", "aligned", "--qa").returncode == 0
        move_second_capture_east(Path("aligned/flight.geojson"))
    monkeypatch.setattr(sys, "argv", [name, *arguments.split()])
    monkeypatch.syspath_prepend(str(ROOT / "examples"))  # as `python examples/NAME` does
    with warnings.catch_warnings(action="ignore"):
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    assert capsys.readouterr().out.count(text) == times
    if name == "two_dates.py":
        with rasterio.open("change.tif") as change, rasterio.open("spring.tif") as first:
            assert (change.shape, change.transform) == (first.shape, first.transform)
            assert np.isfinite(change.read(1)).mean() > 0.8


ON_MIXED_FLIGHT = {
    "one_capture.py": ("flight one", ""),
    "whole_flight.py": ("flight whole", "IMG_0003: "),
    "ndvi_over_a_flight.py": ("aligned", ""),
    "next_flight.py": ("flight flight next", "IMG_0003: "),
    "on_dask.py": ("flight dask", "IMG_0003 error "),
}
"""{name: (arguments, a part of what it prints)}."""


@pytest.mark.full
@pytest.mark.parametrize("name", ON_MIXED_FLIGHT)
def test_an_example_on_a_flight_with_panel_two_cameras_and_failed_captures(
    name: str,
    mixed_originals: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A reason in one line may end it, as `sys.exit` prints it."""
    arguments, text = ON_MIXED_FLIGHT[name]
    monkeypatch.chdir(shutil.copytree(mixed_originals, tmp_path / "desk", symlinks=True))
    monkeypatch.setattr(sys, "argv", [name, *arguments.split()])
    with warnings.catch_warnings(action="ignore"):
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    printed = capsys.readouterr().out
    assert text in printed
    assert not re.search("IMG_000[05]", printed)
    assert not re.search(": None$", printed, re.MULTILINE)


@pytest.mark.parametrize("rotation_deg", [0.0, 31.0, 90.0])
def test_the_recipe_for_plots_has_a_row_of_any_outline(
    rotation_deg: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rasters of single captures are rotated: resampled, their plots have the same values, up to pixels at an edge."""
    monkeypatch.chdir(tmp_path)
    write_ndvi_and_plots(tmp_path, rotation_deg)
    monkeypatch.setattr(sys, "argv", ["plots.py", "plots.gpkg", "ndvi.tif"])
    runpy.run_path(str(ROOT / "examples" / "plots.py"))
    rows = list(csv.DictReader(Path("plots.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["plot"] for row in rows] == ["A1", "", "edge", "bow tie"]
    tolerance = 0.1 if rotation_deg == 0 else 1
    assert [float(row["count"]) for row in rows] == pytest.approx([400, 400, 200, 150], abs=tolerance)
    assert [float(row["mean"]) for row in rows] == pytest.approx([0.5, 0.8, 0.5, 0.8], abs=1e-6)
    shares = [float(row["valid_share"]) for row in rows]
    assert shares == pytest.approx([1, 1, 0.5, 1], abs=0.01 if rotation_deg == 0 else 0.03)


def test_the_recipe_for_plots_uses_the_raster_that_shows_most_then_the_nearest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three overlapping rasters: the first shows half of the plot, the second all, the third all and in its middle."""
    monkeypatch.chdir(tmp_path)
    write_ndvi_and_plots(tmp_path)
    for number, first_column in enumerate((-70, 10, -25), start=1):
        ndvi = np.full((60, 100), number / 10, np.float32)
        transform = Affine.translation(500_000 + first_column / 10, 4_000_000) @ Affine.scale(0.1, -0.1)
        write_band(tmp_path / f"{number}.tif", ndvi, nodata=np.nan, crs="EPSG:32633", transform=transform)
    monkeypatch.setattr(sys, "argv", ["plots.py", "plots.gpkg", "1.tif", "2.tif", "3.tif"])
    runpy.run_path(str(ROOT / "examples" / "plots.py"))
    row = next(csv.DictReader(Path("plots.csv").read_text(encoding="utf-8").splitlines()))
    assert (row["raster"], row["captures"], row["plot"]) == ("3.tif", "3", "A1")
    assert float(row["mean"]) == pytest.approx(0.3)


def test_the_recipe_for_water_masks_sun_glint_and_the_shore(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bands = np.full((2, 20, 30), 0.02, np.float32)  # water
    bands[:, 5:8, 10:12], bands[1, :, 20:], bands[:, 0] = 0.3, 0.4, np.nan  # sun glint, shore, outside of the image
    stack = Path("reflectance/0000SET/000/IMG_0001.tif")
    stack.parent.mkdir(parents=True)
    write_band(stack, bands, nodata=np.nan)
    with rasterio.open(stack, "r+") as raster:
        raster.descriptions = "Green", "NIR"
    monkeypatch.setattr(sys, "argv", ["water.py", str(stack), "water.tif", "0.05"])
    with warnings.catch_warnings(action="ignore"):
        runpy.run_path(str(ROOT / "examples" / "water.py"))
    with rasterio.open("water.tif") as water:
        result = water.read()
    expected = np.where(bands[1] < 0.05, bands, np.nan)
    assert np.isfinite(expected[0]).sum() == 19 * 20 - 6
    np.testing.assert_array_equal(result, expected)


def footprint(west: float, south: float = 52.0, accuracy_m: float = 5.0) -> dict[str, Any]:
    """A capture of the flight map: a square of 0.001 degrees."""
    ring = [[west + x, south + y] for x, y in ((0, 0), (0.001, 0), (0.001, 0.001), (0, 0.001), (0, 0))]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"id": "IMG_0001", "geometry": geometry, "properties": {"accuracy_m": accuracy_m}}


def test_the_tiles_for_validation_show_no_ground_of_those_for_training() -> None:
    names = runpy.run_path(str(ROOT / "examples" / "training_tiles.py"))
    box, split = names["box"], names["split"]
    row = {number: box(footprint(5 + 0.0002 * number)) for number in range(10)}  # neighbours overlap by 80 %
    assert split(row) == ([0, 1, 2, 3, 4, 5], [])
    long_row = {number: box(footprint(5 + 0.0002 * number)) for number in range(30, 0, -1)}
    training, validation = split(long_row)
    assert training == [*range(1, 19)]
    assert validation == [*range(24, 31)]  # 23 is 0.0010 degrees east of 18: they touch, and positions are uncertain
    far_north = box(footprint(5.0031, south=53.0))
    assert split({1: box(footprint(5.0)), 2: box(footprint(5.003)), 3: far_north}, 0.7) == ([1, 2], [3])
    with pytest.raises(SystemExit, match="IMG_0001: has no footprint"):
        box({"id": "IMG_0001", "geometry": {"type": "Point", "coordinates": [5, 52]}})


def test_tiles_have_labels_and_no_predicted_bands(tmp_path: Path) -> None:
    names = runpy.run_path(str(ROOT / "examples" / "training_tiles.py"))
    bands, labels = np.ones((2, 16, 24), np.float32), np.arange(16 * 24, dtype=np.uint16).reshape(1, 16, 24)
    flags = np.zeros((3, 16, 24), np.uint16)
    bands[0, 0, 0], flags[2, :, 8:] = np.nan, 16  # nodata, predicted
    for suffix, pixels in (("", bands), (".qa", flags), (".labels", labels)):
        write_band(tmp_path / f"IMG_0001{suffix}.tif", pixels)
    tiles = names["Tiles"]([tmp_path / "IMG_0001.tif"], side_px=8, labels=True)
    assert len(tiles) == 6
    pixels, usable, own = tiles[1]
    assert (pixels.shape, usable[0].all(), usable[1].any()) == ((2, 8, 8), True, False)
    np.testing.assert_array_equal(own, labels[0, :8, 8:16])
    assert (tiles[0][0][0, 0, 0], tiles[0][1].sum()) == (0.0, 2 * 64 - 1)


def test_captures_that_overlap_make_no_data_set(
    desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(desk)
    for stack in Path("aligned").rglob("IMG_000?.tif"):
        stack.with_suffix(".qa.tif").touch()
    monkeypatch.setattr(sys, "argv", ["training_tiles.py", "aligned"])
    with pytest.raises(SystemExit, match="overlap one for training"):
        runpy.run_path(str(ROOT / "examples" / "training_tiles.py"), run_name="__main__")
    assert capsys.readouterr().out == "captures: 1 for training, 0 for validation, 1 unused\n"


def test_the_difference_of_ndvi_is_right_for_mosaics_of_integers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflectance times 10,000 as uint16: red exceeds near infrared in places; bands of 0 or nodata have no NDVI."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    spring, summer = rng.integers(1, 10_000, (4, 30, 40)), rng.integers(1, 10_000, (5, 30, 40))
    spring[0, :3], summer[4, :, :5] = 0, 65_535  # red of spring; near infrared of summer: nodata
    Path("dates").mkdir()
    for name, bands in {"spring.tif": spring, "dates/summer.tif": summer}.items():
        write_band(Path(name), bands.astype(np.uint16), nodata=65_535)
    (block,) = (b for b in blocks_of(ROOT / "docs/how-to/two-dates.md") if b.text.startswith("rio calc"))
    run_command(*commands_of(block), block.where)
    (red, _, _, nir), (_, later_red, _, _, later_nir) = spring, summer
    expected = (later_nir - later_red) / (later_nir + later_red) - (nir - red) / (nir + red)
    expected[:3], expected[:, :5] = np.nan, np.nan
    with rasterio.open("change.tif") as change:
        np.testing.assert_allclose(change.read(1), expected, atol=1e-6)


def test_the_python_of_the_readme_aligns_pixels() -> None:
    """NIR has reversed contrast, a hole of NaN, and a displacement of 1.5 px that no homography represents."""

    def displacement_px(points: np.ndarray) -> np.ndarray:
        return 1.5 * np.stack([np.sin(points[..., 1] / 127), np.cos(points[..., 0] / 127)], axis=-1)

    green, nir = (view.pixels for view in displaced_views(displacement_px))
    nir[200:230, 300:340] = np.nan
    (block,) = (b for b in blocks_of(ROOT / "README.md") if b.kind == "python")
    names: dict[str, Any] = {"green": green, "nir": nir}
    exec(block.text, names)
    points = geometry.lattice(640, 480, 64, 48)
    errors_px = np.linalg.norm(names["result"].map(points) - points - displacement_px(points), axis=-1)
    assert np.median(errors_px) <= 0.1
    assert np.percentile(errors_px, 95) <= 0.3
    valid, difference = names["valid"], np.abs(names["nir_on_green"] - (-green + 0.15 * green**2))
    assert valid.mean() > 0.9
    assert np.percentile(difference[valid], 95) < 0.15 * green.std()


def test_the_example_has_the_matrices_of_opencv_and_micasense(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of the mapping between raw pixels, and undistorted by OpenCV as MicaSense's notebooks undistort images."""
    monkeypatch.chdir(desk)
    monkeypatch.setattr(sys, "argv", ["warp_matrices.py", "aligned/0000SET/000/IMG_0001.json"])
    names = runpy.run_path(str(ROOT / "examples" / "warp_matrices.py"))
    folder, sidecar = Path("flight/0000SET/000"), read_sidecar(Path("aligned/0000SET/000/IMG_0001.json"))
    bands = {band.band: band for band in sidecar.bands}
    assert [*names["matrices"]] == ["Blue", "Green", "Red", "NIR", "Red edge"]
    tags = read_tags(folder / "IMG_0001_1.tif")
    saved = np.load(f"{tags.serial}_warp_matrices_opencv.npy", allow_pickle=True)
    assert (saved.shape, saved.dtype) == ((5, 3, 3), np.float32)

    def straight(points: list[tuple[float, float]], file: str) -> np.ndarray:
        lens = perspective_lens(read_tags(folder / file))
        coefficients = np.array(lens.distortion[:5])
        new, _ = cv2.getOptimalNewCameraMatrix(lens.matrix, coefficients, (480, 360), 1)
        return cv2.undistortPoints(np.array(points)[:, None], lens.matrix, coefficients, P=new)[:, 0]

    for number, (name, matrix) in enumerate(names["matrices"].items()):
        band, warp_matrix = bands[name], names["warp_matrices"][number]
        np.testing.assert_array_equal(warp_matrix, saved[number])
        if name == sidecar.reference.band:
            np.testing.assert_array_equal([matrix, warp_matrix], [np.eye(3)] * 2)
            continue
        assert np.abs(geometry.apply(matrix, band.grid.reference_px) - band.grid.moving_px).max() < 2.0
        reference = straight(band.grid.reference_px, Path(sidecar.reference.file).name)
        mapped = geometry.apply(warp_matrix.astype(float), reference)
        assert np.abs(mapped - straight(band.grid.moving_px, Path(band.file).name)).max() < 0.5
        assert np.abs(mapped - reference).max() > 1.0
    nir = cv2.imread(str(folder / "IMG_0001_4.tif"), cv2.IMREAD_UNCHANGED)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    nir_on_green = cv2.warpPerspective(nir, names["matrices"]["NIR"], names["size_px"], flags=flags)
    expected, valid = agalign.read_alignment(Path("aligned/0000SET/000/IMG_0001.json"), "NIR").warp(nir)
    assert np.corrcoef(nir_on_green[valid], expected[valid])[0, 1] > 0.95


@pytest.mark.slow
def test_a_pair_that_cannot_be_aligned_has_no_error(
    originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("blank.tif", np.full((200, 240), 100, np.uint8))
    arguments = ["compare_pair.py", str(originals / "green.tif"), "blank.tif"]
    monkeypatch.setattr(sys, "argv", [*arguments, str(originals / "ties.csv")])
    runpy.run_path(str(ROOT / "examples" / "compare_pair.py"))
    reason = "agalign, failed: the moving band is constant or all invalid"
    assert capsys.readouterr().out.splitlines() == [reason, "SIFT: no mapping", "ECC: no mapping"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="nothing to compare with"):
        runpy.run_path(str(ROOT / "examples" / "compare_pair.py"))


def test_every_block_has_a_kind() -> None:
    """One without a kind would not be run."""
    assert [block.where for page in PAGES for block in blocks_of(page) if block.kind not in KINDS] == []


def test_blocks_that_are_not_run_here_are_run_by_scripts() -> None:
    blocks = (block for page in PAGES for block in blocks_of(page) if block.kind == "sh")
    assert set(RUN_BY) <= {program(command) for block in blocks for command in commands_of(block)}
    assert all((ROOT / script).is_file() for script in RUN_BY.values())


@each_page()
def test_links_have_targets(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        result = (page.parent / path) if path else page
        if not result.suffix and not result.exists():
            result = result.with_suffix(".md")
        assert result.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.+)$", result.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in heads}, target


def python(*arguments: str | Path) -> None:
    """Run a program of Python in a process of its own; it must succeed."""
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, check=False, env=variables)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("tool", ["pages.py", "licences.py"])
def test_generated_tables_are_current(tool: str) -> None:
    python(ROOT / "tools" / tool, "--check")


@pytest.mark.full
def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    """Every page, and what the docstrings say, without a warning."""
    pytest.importorskip("sphinx")
    python("-m", "sphinx", "-q", "-W", "--keep-going", ROOT / "docs", tmp_path / "site")
    page = (tmp_path / "site" / "reference" / "api.html").read_text(encoding="utf-8")
    described = set(re.findall(r'descname"><span class="pre">(\w+)<', page))
    assert set(agalign.__all__) - {"__version__"} <= described
