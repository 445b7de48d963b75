import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from synthetic_flights.aligned import list_stack

import agalign

from ..conftest import Shared, seeded, write_capture
from ..run_outputs import change

pytestmark = pytest.mark.slow


@pytest.fixture(params=["stack", "bands"])
def run(request: pytest.FixtureRequest, flight: Path, shared: Shared) -> Path:
    settings = seeded(layout=request.param, crop="none", radiometry="sun")
    return shared(f"dataset_{request.param}", lambda out: agalign.align_folder(flight, out, settings=settings))


def test_a_capture_is_its_files(run: Path) -> None:
    path = run / "0000SET" / "000" / "IMG_0001.tif"
    dataset = agalign.open_capture(path)
    assert dataset.equals(agalign.open_capture(str(path.with_suffix(".json"))))
    assert set(dataset.data_vars) == {"Blue", "Green", "Red", "NIR", "Red edge"}
    assert (dataset.NIR.attrs["wavelength_nm"], dataset.NIR.attrs["units"]) == (840, "1")
    assert dataset.NIR.dims == ("y", "x")
    assert dataset.attrs["reference_band"] == "Green"
    file, index = (path, 4) if path.exists() else (path.with_name("IMG_0001_4.tif"), 1)
    with rasterio.open(file) as source:
        np.testing.assert_array_equal(dataset.NIR.values, source.read(index))


@pytest.mark.parametrize("run", ["stack"], indirect=True)
def test_numbers_with_a_scale_and_an_offset_are_values(run: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(run, tmp_path / "out"))
    path = out / "0000SET" / "000" / "IMG_0001.tif"
    before = agalign.open_capture(path).NIR.values
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (1e-4, 1e-4, 1e-4, 2e-4, 1e-4), (0.0, 0.0, 0.0, -0.1, 0.0)
    list_stack(path.with_suffix(".json"))
    np.testing.assert_allclose(agalign.open_capture(path).NIR.values, before * 2e-4 - 0.1, rtol=1e-5)
    unscaled = agalign.open_capture(path, masked=False).NIR
    assert (unscaled.attrs["scale_factor"], unscaled.attrs["add_offset"]) == (2e-4, -0.1)


def test_a_flight_is_read_when_it_is_asked_for(run: Path) -> None:
    flight = agalign.open_flight(run)
    assert flight.sizes == {"capture": 2, "band": 5, "y": 360, "x": 480}
    assert flight.NIR.chunks is not None  # dask's: nothing was read
    assert list(flight.capture.values) == ["0000SET/000/IMG_0001", "0000SET/000/IMG_0002"]
    assert str(flight.time.values[1]).startswith("2026-06-21T10:00:02")
    assert flight.time.attrs == {"source": "camera"}
    assert flight.latitude.values[0] == pytest.approx(52.0)
    one = agalign.open_capture(run / "0000SET" / "000" / "IMG_0002.json")
    np.testing.assert_array_equal(flight.Red.isel(capture=1).values, one.Red.values)
    assert 0 < float(((flight.NIR - flight.Red) / (flight.NIR + flight.Red)).mean()) < 1
    assert flight.NIR.dtype == np.float32
    assert flight.status.dims == ("capture", "band")
    assert set(flight.status.sel(band=["Red", "NIR"]).values.ravel()) <= {"seed_only", "aligned"}
    assert "status" not in flight.NIR.attrs
    # (0, 0) is the centre of the top-left pixel in both.
    assert (float(one.x[0]), float(flight.x[0])) == (0.0, 0.0)


@pytest.mark.parametrize("run", ["stack"], indirect=True)
def test_a_capture_without_pixels_is_named(run: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(run, tmp_path / "out"))
    failed = out / "0000SET" / "000" / "IMG_0002.json"
    change(failed, output=None)
    with pytest.raises(agalign.InputError, match=r"IMG_0002\.json: its capture has no aligned pixels"):
        agalign.open_capture(failed)
    with pytest.warns(UserWarning, match="IMG_0002: left out: it has no aligned pixels"):
        assert agalign.open_flight(out).sizes["capture"] == 1


@pytest.mark.parametrize("run", ["stack"], indirect=True)
def test_times_of_a_flight_are_in_utc_or_by_the_clock_of_the_camera(run: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(run, tmp_path / "out"))
    moments = "2026-06-21T12:00:00+02:00", "2026-06-21T05:00:00-05:00"
    for path, moment in zip(sorted((out / "0000SET" / "000").glob("IMG_000?.json")), moments, strict=True):
        change(path, captured_at=moment)
    flight = agalign.open_flight(out)
    assert [str(t)[:19] for t in flight.time.values] == ["2026-06-21T10:00:00"] * 2
    change(path, captured_at="2026-06-21T10:00:00")
    assert agalign.open_flight(out).time.attrs == {"source": "camera, clock of the camera (time zone unknown)"}


def test_a_place_on_the_map_and_masked_pixels_follow(tmp_path: Path) -> None:
    place = {"crs": rasterio.CRS.from_epsg(32631), "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    write_capture(tmp_path / "in", "green", "red", nodata=0, **place)
    for path in (tmp_path / "in").iterdir():
        with rasterio.open(path, "r+") as dataset:
            dataset.write(np.zeros((40, 40), np.uint16), 1, window=rasterio.windows.Window(0, 0, 40, 40))
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=seeded())
    raw = agalign.open_capture(tmp_path / "out" / "f.json", masked=False)
    import rioxarray  # noqa: F401  (imported late: it takes a second in each process of the tests)

    assert raw.red.rio.crs.to_epsg() == 32631
    assert raw.red.dtype == np.uint16
    assert (raw.red.attrs["_FillValue"], raw.red.attrs["units"]) == (0, "count")
    assert float(raw.x[0]) == pytest.approx(5e5 + 0.05)
    masked = agalign.open_capture(tmp_path / "out" / "f.json")
    assert masked.red.dtype == np.float32
    assert float((masked.red - masked.green).min()) < 0  # integers would wrap around
    assert np.isnan(masked.red.values[:40, :40]).all()


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("scale", [(1e-4, 1e-4), (1e-4, 2e-4)])
def test_scaled_numbers_are_not_counts(scale: tuple[float, float], masked: bool, tmp_path: Path) -> None:
    """No tag states their unit. CF: `units` is that of the values after scale and offset."""
    write_capture(tmp_path / "in", "green", "red")
    for path, own in zip(sorted((tmp_path / "in").iterdir()), scale, strict=True):
        with rasterio.open(path, "r+") as dataset:
            dataset.scales = (own,)
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=seeded())
    capture = agalign.open_capture(tmp_path / "out" / "f.json", masked=masked)
    assert [band.attrs.get("units") for band in capture.values()] == [None, None]


def test_captures_on_rotated_grids_are_stacked(flight: Path, tmp_path: Path) -> None:
    agalign.align_folder(flight, tmp_path, settings=seeded(georeference=True, ground_elevation_m=0.0))
    one = agalign.open_capture(tmp_path / "0000SET" / "000" / "IMG_0001.json")
    assert one.xc.shape == (one.sizes["y"], one.sizes["x"])
    stacked = agalign.open_flight(tmp_path)
    assert (stacked.sizes["capture"], float(stacked.x[0]), float(stacked.y[0])) == (2, 0.0, 0.0)
    assert "xc" not in stacked.coords


def test_unreadable_datasets_are_named(tmp_path: Path) -> None:
    for name, width in (("a", 300), ("b", 320)):
        write_capture(tmp_path / "in", "green", "red", name=name, size_px=(width, 240))
    agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=seeded())
    sizes = r"differ in size \(b: it has 320 x 240 px, and 1 of 2 captures have 300 x 240 px\); align again with"
    for opened, path, problem in (
        (agalign.open_flight, tmp_path / "in", "give the output folder of a run"),
        (agalign.open_flight, tmp_path / "out", sizes),
        (agalign.open_capture, tmp_path / "missing.tif", r"missing\.json"),
        (agalign.open_capture, tmp_path, "is a folder; give the sidecar of a capture, or use open_flight"),
    ):
        with pytest.raises(agalign.AgalignError, match=problem):
            opened(path)
