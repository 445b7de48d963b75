from pathlib import Path

import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401

import agalign
from agalign.config import SeedSettings, Settings, WriteSettings
from agalign.errors import AgalignError, InputError
from agalign.synthetic.flight import make_flight

from ..conftest import textured_image
from .test_outputs import write_band

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
SEEDED = Settings(seed=SeedSettings(only=True))


@pytest.fixture(scope="module", params=["stack", "bands"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, out = tmp_path_factory.mktemp("in"), tmp_path_factory.mktemp("out")
    make_flight(folder, 2, (480, 360), rng_seed=3)
    write = WriteSettings(layout=request.param, crop="none", radiometry="sun")
    agalign.align_folder(folder, out, settings=SEEDED.model_copy(update={"write": write}))
    return out


def test_a_capture_is_its_files(run: Path) -> None:
    dataset = agalign.open_capture(run / "0000SET" / "000" / "IMG_0001.tif")
    assert dataset.equals(agalign.open_capture(str(run / "0000SET" / "000" / "IMG_0001.stac.json")))
    assert set(dataset.data_vars) == {"Blue", "Green", "Red", "NIR", "Red edge"}
    assert (dataset.NIR.attrs["wavelength_nm"], dataset.NIR.attrs["units"]) == (840, "1")
    assert dataset.NIR.dims == ("y", "x")
    assert dataset.attrs["reference_band"] == "Green"
    path = run / "0000SET" / "000" / "IMG_0001.tif"
    file, index = (path, 4) if path.exists() else (path.with_name("IMG_0001_4.tif"), 1)
    with rasterio.open(file) as source:
        np.testing.assert_array_equal(dataset.NIR.values, source.read(index))


def test_a_flight_is_read_when_it_is_asked_for(run: Path) -> None:
    flight = agalign.open_flight(run)
    assert flight.sizes == {"capture": 2, "band": 5, "y": 360, "x": 480}
    assert flight.NIR.chunks is not None  # dask's: nothing was read
    assert list(flight.capture.values) == ["0000SET/000/IMG_0001", "0000SET/000/IMG_0002"]
    assert str(flight.time.values[1]).startswith("2026-06-21T10:00:02")
    assert flight.latitude.values[0] == pytest.approx(52.0)
    one = agalign.open_capture(run / "0000SET" / "000" / "IMG_0002.json")
    np.testing.assert_array_equal(flight.Red.isel(capture=1).values, one.Red.values)
    ndvi = (flight.NIR - flight.Red) / (flight.NIR + flight.Red)
    assert 0 < float(ndvi.mean()) < 1
    assert flight.NIR.dtype == np.float32
    assert flight.status.dims == ("capture", "band")
    assert set(flight.status.sel(band=["Red", "NIR"]).values.ravel()) <= {"seed_only", "aligned"}
    assert "status" not in flight.NIR.attrs
    # (0, 0) is the centre of the top-left pixel in both.
    assert (float(one.x[0]), float(flight.x[0])) == (0.0, 0.0)


def test_a_place_on_the_map_and_masked_pixels_follow(tmp_path: Path) -> None:
    place = {"crs": rasterio.CRS.from_epsg(32631), "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    for name, gain in (("green", 900), ("red", 500)):
        pixels = (3000 + gain * textured_image(300, 240, 3)).clip(1).astype(np.uint16)
        pixels[:40, :40] = 0
        write_band(tmp_path / "in" / f"f_{name}.tif", pixels, nodata=0, **place)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=SEEDED)
    raw = agalign.open_capture(tmp_path / "out" / "f.json", masked=False)
    assert raw.red.rio.crs.to_epsg() == 32631
    assert raw.red.dtype == np.uint16
    assert (raw.red.attrs["_FillValue"], raw.red.attrs["units"]) == (0, "count")
    assert float(raw.x[0]) == pytest.approx(5e5 + 0.05)
    masked = agalign.open_capture(tmp_path / "out" / "f.json")
    assert masked.red.dtype == np.float32
    assert float((masked.red - masked.green).min()) < 0  # integers would wrap around
    assert np.isnan(masked.red.values[:40, :40]).all()


def test_captures_on_rotated_grids_are_stacked(tmp_path: Path) -> None:
    make_flight(tmp_path / "in", 2, (480, 360), rng_seed=3)
    write = WriteSettings(georeference=True, ground_elevation_m=0.0)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=SEEDED.model_copy(update={"write": write}))
    one = agalign.open_capture(tmp_path / "out" / "0000SET" / "000" / "IMG_0001.json")
    assert one.xc.shape == (one.sizes["y"], one.sizes["x"])
    flight = agalign.open_flight(tmp_path / "out")
    assert (flight.sizes["capture"], float(flight.x[0]), float(flight.y[0])) == (2, 0.0, 0.0)
    assert "xc" not in flight.coords


def test_what_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no aligned captures"):
        agalign.open_flight(tmp_path)
    with pytest.raises(AgalignError, match=r"missing\.json"):
        agalign.open_capture(tmp_path / "missing.tif")
    with pytest.raises(InputError, match="is a folder; give the sidecar of a capture, or use open_flight"):
        agalign.open_capture(tmp_path)


def test_captures_of_different_sizes_make_no_stack(tmp_path: Path) -> None:
    for number, size in enumerate(((300, 240), (320, 240))):
        for name, gain in (("green", 900), ("red", 500)):
            pixels = (3000 + gain * textured_image(*size, 3)).clip(1).astype(np.uint16)
            write_band(tmp_path / "in" / f"{number}_{name}.tif", pixels)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=SEEDED)
    with pytest.raises(InputError, match="differ in size"):
        agalign.open_flight(tmp_path / "out")
