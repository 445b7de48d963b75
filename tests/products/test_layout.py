from pathlib import Path

import numpy as np
import pytest
import rasterio

from agalign.config import WriteSettings
from agalign.products.layout import lay_out
from agalign.products.write import write_raster
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Band, Capture
from agalign.values.lens import Lens

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
LENS = Lens(150.0, 150.0, 59.5, 44.5, (-0.1, 0.05))


def capture_of(folder: Path) -> Capture:
    bands = []
    for name in ("green", "nir"):
        path = folder / f"{name}.tif"
        with rasterio.open(path, "w", driver="GTiff", width=120, height=90, count=1, dtype="uint16") as dataset:
            dataset.write(np.full((1, 90, 120), 500, np.uint16))
        bands.append(Band(name, path, 1, 120, 90, "uint16", lens=LENS))
    return Capture("c", Path(), tuple(bands), 0)


def aligned_by(shift_px: float) -> Alignment:
    seed = Seed("identity", geometry.translation(shift_px, 0), 0.0)
    return Alignment(seed.fixed_to_moving, "undistorted", "aligned", (), seed, None, None, 0.0)


@pytest.mark.parametrize("undistort", [False, True])
def test_without_a_common_area_what_no_band_shows_is_nodata(tmp_path: Path, undistort: bool) -> None:
    capture, settings = capture_of(tmp_path), WriteSettings(undistort=undistort)
    layers, grid = lay_out(capture, {"nir": aligned_by(200.0)}, settings)
    assert (grid.width, grid.height, grid.has_gaps) == (120, 90, True)
    write_raster(capture, layers, grid, tmp_path / "out.tif", settings)
    with rasterio.open(tmp_path / "out.tif") as written:
        assert not written.read_masks(2).any()


def test_where_all_bands_show_everything_no_nodata_is_declared(tmp_path: Path) -> None:
    capture = capture_of(tmp_path)
    for crop in ("common", "none"):
        _, grid = lay_out(capture, {"nir": aligned_by(0.0)}, WriteSettings(crop=crop))
        assert not grid.has_gaps
    moved, cut = lay_out(capture, {"nir": aligned_by(9.0)}, WriteSettings())
    assert not cut.has_gaps
    assert cut.width < 120
    _, whole = lay_out(capture, {"nir": aligned_by(9.0)}, WriteSettings(crop="none"))
    assert whole.has_gaps
    assert write_raster(capture, moved, cut, tmp_path / "out.tif", WriteSettings()) is None
