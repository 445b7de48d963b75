from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from agalign.config import WriteSettings
from agalign.flight.rig import CaptureFactors, Rig
from agalign.products.layout import output_layers
from agalign.products.raster_file import write_raster
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Band, Capture
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping

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
    return Alignment(PixelMapping(seed.fixed_to_moving, LENS, LENS), (120, 90), "aligned", (), seed)


@pytest.mark.parametrize("undistort", [False, True])
def test_without_a_common_area_what_no_band_shows_is_nodata(tmp_path: Path, undistort: bool) -> None:
    capture, settings = capture_of(tmp_path), WriteSettings(undistort=undistort)
    layers, grid = output_layers(capture, {"nir": aligned_by(200.0)}, settings)
    assert (grid.width, grid.height, grid.has_gaps) == (120, 90, True)
    write_raster(capture, layers, grid, tmp_path / "out.tif", settings)
    with rasterio.open(tmp_path / "out.tif") as written:
        assert not written.read_masks(2).any()


def test_where_all_bands_show_everything_no_nodata_is_declared(tmp_path: Path) -> None:
    capture = capture_of(tmp_path)
    for crop in ("common", "none"):
        _, grid = output_layers(capture, {"nir": aligned_by(0.0)}, WriteSettings(crop=crop))
        assert not grid.has_gaps
    moved, cut = output_layers(capture, {"nir": aligned_by(9.0)}, WriteSettings())
    assert not cut.has_gaps
    assert cut.width < 120
    _, whole = output_layers(capture, {"nir": aligned_by(9.0)}, WriteSettings(crop="none"))
    assert whole.has_gaps
    assert write_raster(capture, moved, cut, tmp_path / "out.tif", WriteSettings()) is None


def rig_between(low_px: float, high_px: float) -> Rig:
    """One band that moves to the right as the ground comes nearer."""
    middle = (low_px + high_px) / 2
    factors = [(v - middle, 0.0, 0.0, 0.0, 0.0) for v in (low_px, middle, high_px)]
    seen = tuple(CaptureFactors(float(k), None, None, f) for k, f in enumerate(factors))
    bars = {"nir": 0.1}
    return Rig(
        (120, 90), {"nir": geometry.translation(middle, 0)}, {"nir": (1.0, 0.0)}, {"nir": 0.0}, bars,
        ("distance",), seen, bars,
    )  # fmt: skip


def test_all_captures_of_a_flight_have_one_geometry(tmp_path: Path) -> None:
    capture, rig = capture_of(tmp_path), rig_between(2.0, 12.0)
    grids = [output_layers(capture, {"nir": aligned_by(shift)}, WriteSettings(), rig)[1] for shift in (2.0, 7.0, 12.0)]
    assert len(set(grids)) == 1
    assert not grids[0].has_gaps
    # The farthest band leaves 12 px at the right; two more are left for captures that the rig has not seen.
    assert 120 - (grids[0].x0 + grids[0].width) in range(13, 17)
    alone = [
        output_layers(capture, {"nir": aligned_by(shift)}, WriteSettings(crop="common"), rig)[1]
        for shift in (2.0, 12.0)
    ]
    assert alone[0].width > alone[1].width


def test_a_capture_beyond_its_flight_keeps_the_geometry_and_declares_nodata(tmp_path: Path) -> None:
    capture, rig = capture_of(tmp_path), rig_between(2.0, 12.0)
    (_, within), (_, beyond) = (
        output_layers(capture, {"nir": aligned_by(shift)}, WriteSettings(), rig) for shift in (5.0, 30.0)
    )
    assert replace(beyond, has_gaps=False) == within
    assert beyond.has_gaps
