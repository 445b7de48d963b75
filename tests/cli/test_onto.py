import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from agalign.values import geometry

from ..conftest import textured_pair
from ..program import agalign_here

TRUTH = np.array([[1.001, 0.002, 9.3], [-0.002, 1.001, -14.6], [0, 0, 1.0]])


pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]


def write_mosaic(path: Path, image: np.ndarray, off_m: tuple[float, float] | None, bands: int = 1) -> None:
    height, width = image.shape
    place = {}
    if off_m is not None:
        transform = Affine(0.1, 0, 500_000 + off_m[0], 0, -0.1, 4_000_000 + off_m[1])
        place = {"crs": "EPSG:32633", "transform": transform}
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=bands, dtype="float32", **place
    ) as dataset:
        for index in range(1, bands + 1):
            dataset.write((1000 + 100 * image * index).astype(np.float32), index)


@pytest.fixture(scope="module")
def mosaics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mosaics")
    spring, summer = textured_pair(TRUTH, 640, 520)
    write_mosaic(folder / "spring.tif", spring, (0, 0))
    write_mosaic(folder / "summer.tif", summer, (3.0, -4.0), bands=2)
    return folder


def test_a_mosaic_is_laid_on_the_grid_of_another(mosaics: Path, tmp_path: Path) -> None:
    done = agalign_here(
        "onto", mosaics / "spring.tif", mosaics / "summer.tif", "-o", tmp_path / "out", "--relief", "never"
    )
    assert done.returncode == 0, done.stderr
    sidecar = json.loads((tmp_path / "out" / "summer.json").read_text())
    assert [b["band"] for b in sidecar["bands"]] == ["spring band_1", "band_1", "band_2"]
    assert [b["status"] for b in sidecar["bands"]] == ["reference", "aligned", "aligned"]
    result = np.array(sidecar["bands"][1]["homography"]["fixed_to_moving"])
    assert geometry.corner_error_px(result, TRUTH, 640, 520) < 0.3
    with rasterio.open(tmp_path / "out" / "summer.tif") as out, rasterio.open(mosaics / "spring.tif") as reference:
        assert (out.shape, out.transform, out.crs) == (reference.shape, reference.transform, reference.crs)
        np.testing.assert_array_equal(out.read(1), reference.read(1))
        assert np.isnan(out.read(2)).any()  # what the moving mosaic does not show is no data
    assert (tmp_path / "out" / "index.html").is_file()


def test_bad_mosaics_are_told_in_a_line(mosaics: Path, tmp_path: Path) -> None:
    write_mosaic(tmp_path / "nowhere.tif", np.zeros((60, 80), np.float32), None)
    for moving, problem in (
        (tmp_path / "nowhere.tif", "has no coordinates"),
        (mosaics / "spring.tif", "is the reference itself"),
        (tmp_path / "missing.tif", "does not exist"),
    ):
        done = agalign_here("onto", mosaics / "spring.tif", moving, "-o", tmp_path / "out")
        assert done.returncode == 1
        assert problem in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_a_south_up_mosaic_is_turned_when_it_is_read(mosaics: Path, tmp_path: Path) -> None:
    """Rows from south to north are a mirror image, which no homography between images is."""
    with rasterio.open(mosaics / "summer.tif") as source:
        flipped = source.transform * Affine(1, 0, 0, 0, -1, source.height)
        with rasterio.open(tmp_path / "south-up.tif", "w", **{**source.profile, "transform": flipped}) as target:
            target.write(source.read()[:, ::-1])
    for name, path in (("out", mosaics / "summer.tif"), ("turned", tmp_path / "south-up.tif")):
        done = agalign_here("onto", mosaics / "spring.tif", path, "-o", tmp_path / name, "--relief", "never")
        assert done.returncode == 0, done.stderr
    with (
        rasterio.open(tmp_path / "out" / "summer.tif") as one,
        rasterio.open(tmp_path / "turned" / "south-up.tif") as two,
    ):
        np.testing.assert_array_equal(one.read(), two.read())


def test_a_mosaic_of_another_place_is_told(mosaics: Path, tmp_path: Path) -> None:
    with rasterio.open(mosaics / "summer.tif") as source:
        away = {**source.profile, "transform": Affine.translation(0, 111_000) * source.transform}
        with rasterio.open(tmp_path / "away.tif", "w", **away) as target:
            target.write(source.read())
    done = agalign_here(
        "onto", mosaics / "spring.tif", tmp_path / "away.tif", "-o", tmp_path / "out", "--relief", "never"
    )
    assert re.search(r"away\.tif: is 11[01]\.\d km away from the reference", done.stderr)
