import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

import agalign
from agalign import ReliefSettings, Settings
from agalign.values import geometry
from agalign.values.remedies import MOSAICS

from ..builders import displaced_views
from ..conftest import read_json, textured_pair, write_band
from ..program import agalign_here

TRUTH = np.array([[1.001, 0.002, 9.3], [-0.002, 1.001, -14.6], [0, 0, 1.0]])


pytestmark = pytest.mark.slow


def write_mosaic(path: Path, image: np.ndarray, off_m: tuple[float, float] | None, bands: int = 1) -> None:
    place = {}
    if off_m is not None:
        transform = Affine(0.1, 0, 500_000 + off_m[0], 0, -0.1, 4_000_000 + off_m[1])
        place = {"crs": "EPSG:32633", "transform": transform}
    planes = [1000 + 100 * image * number for number in range(1, bands + 1)]
    write_band(path, np.float32(planes), **place)


@pytest.fixture(scope="module")
def mosaics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spring and summer with the wavelengths of their bands, and out: summer on the grid of spring."""
    folder = tmp_path_factory.mktemp("mosaics")
    spring, summer = textured_pair(TRUTH, 640, 520)
    write_mosaic(folder / "spring.tif", spring, (0, 0))
    write_mosaic(folder / "summer.tif", summer, (3.0, -4.0), bands=4)
    for name, wavelengths_nm in (("spring", (668,)), ("summer", (560, 668, 475, 840))):
        with rasterio.open(folder / f"{name}.tif", "r+") as mosaic:
            for index, wavelength_nm in enumerate(wavelengths_nm, start=1):
                mosaic.update_tags(index, wavelength=str(wavelength_nm))
    assert onto(folder, folder / "summer.tif", folder / "out").returncode == 0
    return folder


def onto(mosaics: Path, moving: Path, out: Path, reference: str = "spring.tif") -> subprocess.CompletedProcess[str]:
    return agalign_here("onto", mosaics / reference, moving, "-o", out, "--relief", "never")


def test_a_mosaic_is_aligned_to_the_grid_of_another(mosaics: Path, tmp_path: Path) -> None:
    """Rows from south to north are a mirror image: no homography maps it, so they are read in the other order."""
    sidecar = read_json(mosaics / "out" / "summer.json")
    assert [b["band"] for b in sidecar["bands"]] == ["spring band_1", "band_1", "band_2", "band_3", "band_4"]
    assert [b["status"] for b in sidecar["bands"]] == ["reference", *["aligned"] * 4]
    result = np.array(sidecar["bands"][1]["homography"]["fixed_to_moving"])
    assert geometry.corner_error_px(result, TRUTH, 640, 520) < 0.3
    assert (mosaics / "out" / "index.html").is_file()
    with rasterio.open(mosaics / "summer.tif") as source:
        flipped = source.transform * Affine(1, 0, 0, 0, -1, source.height)
        write_band(tmp_path / "south-up.tif", source.read()[:, ::-1], **{**source.profile, "transform": flipped})
    assert onto(mosaics, tmp_path / "south-up.tif", tmp_path / "turned").returncode == 0
    with rasterio.open(mosaics / "out" / "summer.tif") as out, rasterio.open(mosaics / "spring.tif") as reference:
        assert (out.shape, out.transform, out.crs) == (reference.shape, reference.transform, reference.crs)
        np.testing.assert_array_equal(out.read(1), reference.read(1))
        assert np.isnan(out.read(2)).any()  # what the moving mosaic does not show is no data
        with rasterio.open(tmp_path / "turned" / "south-up.tif") as turned:
            np.testing.assert_array_equal(out.read(), turned.read())


def test_coordinates_may_be_off_by_most_of_a_mosaic(mosaics: Path, tmp_path: Path) -> None:
    """By the coordinates, summer is 41 m east of where its image is, of 64 m."""
    with rasterio.open(mosaics / "summer.tif") as source:
        away = {**source.profile, "transform": Affine.translation(37, 0) * source.transform}
        write_band(tmp_path / "summer.tif", source.read(), **away)
    assert onto(mosaics, tmp_path / "summer.tif", tmp_path / "out").returncode == 0
    result = np.array(read_json(tmp_path / "out" / "summer.json")["bands"][1]["homography"]["fixed_to_moving"])
    assert geometry.corner_error_px(result, TRUTH, 640, 520) < 0.3


def test_colours_and_indices_are_of_one_date(mosaics: Path, tmp_path: Path) -> None:
    """The red of the reference is first in the output."""
    assert agalign_here("indices", mosaics / "out", "--index", "ndvi", "-o", tmp_path).returncode == 0
    with rasterio.open(tmp_path / "summer_ndvi.tif") as ndvi, rasterio.open(mosaics / "out" / "summer.tif") as out:
        assert [c.name for c in out.colorinterp] == ["undefined", "green", "red", "blue", "undefined"]
        assert out.descriptions[0] == "spring band_1"
        red, nir = out.read(3), out.read(5)
        np.testing.assert_allclose(ndvi.read(1), (nir - red) / (nir + red), atol=1e-6)


def test_an_orthophoto_of_colours_and_alpha_keeps_them(mosaics: Path, tmp_path: Path) -> None:
    """As OpenDroneMap writes it: 8 bits, red, green, blue and alpha, without names of bands."""
    with rasterio.open(mosaics / "summer.tif") as source:
        image, profile = source.read(1), source.profile | {"count": 4, "dtype": "uint8", "nodata": None}
    grey = np.uint8(255 * (image - image.min()) / np.ptp(image))
    alpha = np.full_like(grey, 255)
    alpha[:100] = 0
    with rasterio.open(tmp_path / "ortho.tif", "w", **profile) as dataset:
        dataset.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
        dataset.write(np.stack([grey, 255 - grey, grey // 2, alpha]))
    done = onto(mosaics, tmp_path / "ortho.tif", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    with rasterio.open(tmp_path / "out" / "ortho.tif") as out:
        assert [c.name for c in out.colorinterp[1:]] == ["red", "green", "blue"]
        red, green = out.read(2), out.read(3)
        is_hidden = out.read_masks(2) == 0
        assert 0.15 < is_hidden.mean() < 0.5
        np.testing.assert_allclose(red[~is_hidden], 255 - green[~is_hidden], atol=2)
    assert agalign_here("indices", tmp_path / "out", "--index", "vari").returncode == 0


def test_unusable_mosaics_are_one_line(mosaics: Path, tmp_path: Path) -> None:
    write_mosaic(tmp_path / "nowhere.tif", np.zeros((60, 80), np.float32), None)
    for moving, problem in (
        (tmp_path / "nowhere.tif", "has no coordinates"),
        (mosaics / "spring.tif", "is the reference itself"),
        (tmp_path / "missing.tif", "does not exist"),
    ):
        done = onto(mosaics, moving, tmp_path / "out")
        (line,) = done.stderr.splitlines()
        assert (done.returncode, problem in line) == (1, True)


def test_python_aligns_mosaics_as_the_command(mosaics: Path, tmp_path: Path) -> None:
    settings = Settings(relief=ReliefSettings(use="never"))
    (report,) = agalign.onto(mosaics / "spring.tif", [str(mosaics / "summer.tif")], tmp_path, settings=settings)
    assert (report.state, report.result.status) == ("done", "ok")
    assert (tmp_path / "summer.tif").read_bytes() == (mosaics / "out" / "summer.tif").read_bytes()


def test_a_distant_mosaic_is_reported(mosaics: Path, tmp_path: Path) -> None:
    """Before anything is aligned, which a device that does not exist prevents here."""
    with rasterio.open(mosaics / "summer.tif") as source:
        away = {**source.profile, "transform": Affine.translation(0, 111_000) * source.transform}
        write_band(tmp_path / "away.tif", source.read(), **away)
    done = agalign_here("onto", mosaics / "spring.tif", tmp_path / "away.tif", "-o", tmp_path, "--device", "cuda:99")
    assert re.search(r"away\.tif: is 11[01]\.\d km away from the reference", done.stderr)


def test_mosaics_in_a_local_reference_system_are_aligned(mosaics: Path, tmp_path: Path) -> None:
    """As Metashape writes them without positions: nobody knows where on Earth they are."""
    local = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1],AXIS["X",EAST]'
    for name in ("spring", "summer"):
        with rasterio.open(mosaics / f"{name}.tif") as source:
            in_metres = {**source.profile, "crs": rasterio.CRS.from_wkt(f'{local},AXIS["Y",NORTH]]')}
            write_band(tmp_path / f"{name}.tif", source.read(), **in_metres)
    done = onto(tmp_path, tmp_path / "summer.tif", tmp_path / "out")
    assert (done.returncode, "away from the reference" in done.stderr) == (0, False)
    with rasterio.open(tmp_path / "summer.tif", "r+") as source:
        source.transform = Affine.translation(0, 20_000) * source.transform
    nowhere = "--device", "cuda:99"
    far = agalign_here("onto", tmp_path / "spring.tif", tmp_path / "summer.tif", "-o", tmp_path / "far", *nowhere)
    assert re.search(r"summer\.tif: is (19|20)\.\d km away from the reference", far.stderr)
    other = agalign_here("onto", mosaics / "spring.tif", tmp_path / "summer.tif", "-o", tmp_path / "far", *nowhere)
    assert "summer.tif: cannot be compared with the reference by its coordinates" in other.stderr


@pytest.mark.full
def test_the_limit_is_a_pixel_of_the_reference_and_the_advice_fits_mosaics(tmp_path: Path) -> None:
    """Leaves and branches that move: 3 px of the files, less than a pixel of mosaics with the size that is needed."""
    steps = np.random.default_rng(0).normal(size=(12, 16, 2)) * 2

    def displacement_px(points: np.ndarray) -> np.ndarray:
        column, row = np.moveaxis(np.rint(points).astype(int), -1, 0)
        return steps[(row // 40).clip(0, 11), (column // 40).clip(0, 15)]

    views = displaced_views(displacement_px)
    for name, view in zip(("may", "june"), views, strict=True):
        write_mosaic(tmp_path / f"{name}.tif", view.pixels, (0, 0))
        mean = view.pixels.reshape(120, 4, 160, 4).mean(axis=(1, 3))
        write_mosaic(tmp_path / f"{name}_coarse.tif", mean, (0, 0))
    done = onto(tmp_path, tmp_path / "june.tif", tmp_path / "fine", "may.tif")
    assert done.returncode == 3
    text = " ".join(done.stderr.split())
    assert "windows are aligned within 1 px" in text
    assert "resample both mosaics to larger pixels, of the size that you need (gdalwarp -r average -tr" in text
    assert not re.search(r"fly|--relief|--bands|--model|--seed |card", text)
    assert MOSAICS.advice in (tmp_path / "fine" / "index.html").read_text()
    for moving in ("june_coarse.tif", "june.tif"):
        assert onto(tmp_path, tmp_path / moving, tmp_path / "coarse", "may_coarse.tif").returncode == 0
