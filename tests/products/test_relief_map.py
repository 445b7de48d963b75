"""What is written of a capture with a relief: the rasters, the sidecar and the dataset, from the true geometry."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray
from scipy.interpolate import RectBivariateSpline
from synthetic_flights.depth import CLOSE_RANGE, Truth, write_capture
from synthetic_flights.relief import make_scene

import agalign
from agalign.batch import capture as batch
from agalign.cameras import pix4d, rig_seed
from agalign.cameras.discover import discover
from agalign.cameras.metadata import Tags
from agalign.config import Settings, WriteSettings
from agalign.products.raster_file import _with_occluded
from agalign.products.relief_map import relief_layers
from agalign.products.sidecar import Sidecar
from agalign.products.sidecar_file import read_sidecar
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, Residual, Seed
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale
from agalign.values.relief import Parallax, Relief

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SIZE = 240, 180
PIXELS = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).astype(float)


def alignments_of(capture: Capture, truth: Truth) -> dict[str, Alignment]:
    """The true homography of the plane at the median range, and the true parallax above it."""
    reference = capture.reference
    assert reference.lens is not None
    matrix = np.array(
        [[reference.lens.fx_px, 0, reference.lens.cx_px], [0, reference.lens.fy_px, reference.lens.cy_px], [0, 0, 1]]
    )
    places = {b.name: np.array([*b.baseline_m, 0.0]) for b in CLOSE_RANGE.bands}
    unit = max(np.linalg.norm((matrix @ p)[:2]) for p in places.values())
    plane_m = float(np.median(truth.range_m))
    z = unit * (1 / truth.range_m - 1 / plane_m)
    relief = Relief(z.astype(np.float32), np.full(z.shape, 0.8, np.float32))
    result = {}
    for band in capture.moving:
        moved = -(matrix @ places[band.name])[:2]
        plane = geometry.compose(rig_seed(reference, band), geometry.translation(*(moved / plane_m)))
        x, y = (moved / unit).tolist()
        parallax = Parallax(relief, (x, y), truth.bands[band.name].hidden)
        residual = Residual.of(np.array([[50.0, 50.0]]), np.array([[0.1, 0.0]]), np.array([20.0]))
        seed = Seed("rig", plane, 30.0, 30.0, 5.0)
        mapping = PixelMapping(plane, reference.lens, band.lens, parallax=parallax)
        result[band.name] = Alignment(mapping, reference.size_px, "aligned", (), seed, residual=residual)
    return result


class Run:
    """A capture, its true alignments, and what is written with any settings."""

    def __init__(self, folder: Path) -> None:
        self.truth = write_capture(folder / "in", make_scene("boxes", 8, width_px=SIZE[0]), size_px=SIZE)
        (self.capture,) = discover(folder / "in").captures
        self.alignments = alignments_of(self.capture, self.truth)

    def write(self, out: Path, patch: pytest.MonkeyPatch, **settings: object) -> Sidecar:
        patch.setattr(batch, "align_capture_bands", lambda *_: self.alignments)
        chosen = Settings(write=WriteSettings.model_validate({"crop": "none", **settings}))
        outcome = batch.process_capture(self.capture, out, chosen)
        assert outcome.shortcomings == ()
        assert read_sidecar(outcome.path) == outcome.sidecar
        return outcome.sidecar


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("relief"))


@pytest.fixture(scope="module")
def written(run: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Sidecar]:
    """With all layers."""
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        sidecar = run.write(out, patch, relief_map=True, stac=True)
    return out / run.capture.folder, sidecar


def read(path: Path) -> dict[str, np.ndarray]:
    with rasterio.open(path) as source:
        assert np.isnan(source.nodata)
        assert set(source.dtypes) == {"float32"}
        return dict(zip(source.descriptions, source.read(), strict=True))


def test_these_alignments_are_the_truth(run: Run) -> None:
    for band in run.capture.moving:
        alignment, known = run.alignments[band.name], run.truth.bands[band.name]
        assert np.abs(alignment.map(PIXELS) - known.moving_px)[known.visible].max() < 0.1


def test_the_raster_of_the_relief(run: Run, written: tuple[Path, Sidecar]) -> None:
    folder, sidecar = written
    path = folder / f"{sidecar.capture}.relief.tif"
    with rasterio.open(path) as source:
        assert source.descriptions == ("parallax", "confidence", "range")
        assert source.units == ("px", "1", "m")
    layers = read(path)
    relief = run.alignments["NIR"].mapping.parallax.relief  # type: ignore[union-attr]
    np.testing.assert_allclose(layers["parallax"], relief.parallax_px, atol=0.0051)
    np.testing.assert_allclose(layers["confidence"], 0.8, atol=1e-6)
    assert np.median(np.abs(layers["range"] / run.truth.range_m - 1)) < 0.003
    assert np.abs(layers["range"] / run.truth.range_m - 1).max() < 0.02
    product = next(p for p in sidecar.products if p.kind == "relief")
    assert (product.file, product.bytes) == (path.name, path.stat().st_size)


def test_without_a_request_it_has_the_parallax_alone(
    run: Run, written: tuple[Path, Sidecar], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sidecar's mapping needs it."""
    sidecar = run.write(tmp_path, monkeypatch)
    layers = read(tmp_path / run.capture.folder / f"{sidecar.capture}.relief.tif")
    assert set(layers) == {"parallax"}
    np.testing.assert_array_equal(layers["parallax"], read(written[0] / f"{sidecar.capture}.relief.tif")["parallax"])


def test_the_grid_of_the_stack_is_that_of_the_relief(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = run.write(tmp_path, monkeypatch, crop="common", undistort=True, relief_map=True)
    assert sidecar.output is not None
    x0, y0, width, height = sidecar.output.crop
    layers = read(tmp_path / run.capture.folder / f"{sidecar.capture}.relief.tif")
    assert layers["range"].shape == (height, width)
    assert (width, height) != SIZE
    assert sidecar.output.nodata is not None
    x, y = np.meshgrid(np.arange(x0, x0 + width), np.arange(y0, y0 + height))
    raw = lens.distort(run.capture.reference.lens, np.stack([x, y], axis=-1).astype(float))
    relief = run.alignments["NIR"].mapping.parallax.relief  # type: ignore[union-attr]
    np.testing.assert_allclose(layers["parallax"], relief(raw), atol=0.0051)


def test_layers_on_a_finer_grid_that_starts_elsewhere(run: Run) -> None:
    grid = OutputGrid(20, 14, 60, 50, PixelScale(2.0, 2.0))
    relief = run.alignments["NIR"].mapping.parallax.relief  # type: ignore[union-attr]
    layers = relief_layers(run.capture, run.alignments, relief, grid)
    x, y = np.meshgrid(np.arange(20, 80), np.arange(14, 64))
    at = (np.stack([x, y], axis=-1) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(layers["parallax"], relief(at), atol=0.0051)
    # Pixels 20 to 80 of the finer grid are 10 to 40 of the file.
    assert np.median(layers["range"]) == pytest.approx(np.median(run.truth.range_m[7:32, 10:40]), rel=0.005)


def test_where_places_of_lenses_are_unknown_there_is_no_range(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = replace(run.capture, bands=tuple(replace(b, lens_offset_m=None) for b in run.capture.bands))
    monkeypatch.setattr(run, "capture", unknown)
    sidecar = run.write(tmp_path, monkeypatch, relief_map=True)
    layers = read(tmp_path / run.capture.folder / f"{sidecar.capture}.relief.tif")
    assert np.isnan(layers["range"]).all()
    assert np.isfinite(layers["parallax"]).all()


def test_without_a_relief_nothing_is_written(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flat: Mapping[str, Alignment] = {n: replace(a, mapping=a.mapping.of_the_plane) for n, a in run.alignments.items()}
    monkeypatch.setattr(run, "alignments", flat)
    sidecar = run.write(tmp_path, monkeypatch, relief_map=True)
    assert not list(tmp_path.rglob("*.relief.tif"))
    assert all(b.relief is None for b in sidecar.bands)
    assert "parallax" not in agalign.open_capture(tmp_path / run.capture.folder / f"{sidecar.capture}.json")


# ---- the sidecar


def spline(nodes: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Cubic splines through values (n, 2) at the nodes (n, 2) of a lattice, as the sidecar's documentation asks for."""
    x, y = np.unique(nodes[:, 0]), np.unique(nodes[:, 1])
    splines = [RectBivariateSpline(y, x, v.reshape(len(y), len(x))) for v in values.T]
    return lambda points: np.stack([s.ev(points[..., 1], points[..., 0]) for s in splines], axis=-1)


def test_a_reader_can_rebuild_the_mapping(run: Run, written: tuple[Path, Sidecar]) -> None:
    """plane_px(x) + z slope(x), with the written parallax."""
    folder, sidecar = written
    for band in run.capture.moving:
        part = next(b for b in sidecar.bands if b.band == band.name).relief
        assert part is not None
        assert part.file == f"{sidecar.capture}.relief.tif"
        z = read(folder / part.file)["parallax"][..., None]
        nodes = np.array(part.reference_px)
        plane, slope = (spline(nodes, np.array(v))(PIXELS) for v in (part.plane_px, part.slope))
        alignment = run.alignments[band.name]
        expected = alignment.map(PIXELS)
        assert np.abs(plane + z * slope - expected).max() < 0.1
        assert alignment.mapping.parallax is not None
        assert alignment.mapping.parallax.hidden is not None
        assert part.baseline == pytest.approx(alignment.mapping.parallax.baseline)
        assert part.occluded == pytest.approx(alignment.mapping.parallax.hidden.mean(), abs=1e-4)
    assert next(b for b in sidecar.bands if b.status == "reference").relief is None


# ---- occluded pixels


def test_occluded_pixels_are_nodata_in_their_band(run: Run, written: tuple[Path, Sidecar]) -> None:
    folder, sidecar = written
    assert sidecar.output is not None
    assert sidecar.output.nodata is not None
    with rasterio.open(folder / f"{sidecar.capture}.tif") as stack:
        for index, name in enumerate(stack.descriptions, start=1):
            missing = stack.read_masks(index) == 0
            if name == run.capture.reference.name:
                assert not missing.any()
                continue
            known = run.truth.bands[name]
            assert missing[known.hidden].all()
            inner = known.inside & ~known.hidden
            assert (missing & inner).sum() < 0.02 * inner.sum()
            assert (known.hidden & known.inside).sum() > 30


def test_occluded_pixels_are_filled_on_request(
    run: Run, written: tuple[Path, Sidecar], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sidecar = run.write(tmp_path, monkeypatch, fill_occluded=True)
    name = f"{sidecar.capture}.tif"
    with rasterio.open(written[0] / name) as plain, rasterio.open(tmp_path / run.capture.folder / name) as filled:
        for index, band in enumerate(plain.descriptions, start=1):
            before, after = plain.read(index), filled.read(index)
            known = plain.read_masks(index) > 0
            np.testing.assert_array_equal(after[known], before[known])
            if band == run.capture.reference.name:
                continue
            hidden = run.truth.bands[band].hidden & run.truth.bands[band].inside
            assert (filled.read_masks(index) > 0)[hidden].all()
            low, high = before[known].min(), before[known].max()
            assert ((after[hidden] >= low) & (after[hidden] <= high)).all()
            # Pixels beyond the band's image stay without a value.
            beyond = ~run.truth.bands[band].inside & ~run.truth.bands[band].hidden
            assert not filled.read_masks(index)[beyond].all()


def test_filled_pixels_are_between_their_neighbours() -> None:
    pixels = np.full((20, 30), 100, np.uint16)
    pixels[:, 15:] = 200
    valid, hidden = np.ones(pixels.shape, bool), np.zeros(pixels.shape, bool)
    hidden[:, 13:17] = True
    valid[hidden] = False
    valid[:3, :3] = False
    filled, known = _with_occluded(np.where(valid, pixels, 0).astype(np.uint16), valid, hidden)
    assert filled.dtype == np.uint16
    assert known[hidden].all()
    assert not known[:3, :3].any()
    assert ((filled[hidden] >= 100) & (filled[hidden] <= 200)).all()
    assert filled[10, 13] < 150 < filled[10, 16]
    np.testing.assert_array_equal(filled[valid], pixels[valid])
    none = np.zeros_like(valid)
    assert _with_occluded(pixels, none, hidden) == (pixels, none)


# ---- the dataset


def test_a_dataset_has_the_layers(run: Run, written: tuple[Path, Sidecar]) -> None:
    folder, sidecar = written
    dataset = agalign.open_capture(folder / f"{sidecar.capture}.json")
    assert isinstance(dataset, xarray.Dataset)
    assert set(dataset.data_vars) == {b.name for b in run.capture.bands} | {"parallax", "confidence", "range"}
    layers = read(folder / f"{sidecar.capture}.relief.tif")
    for name, unit in (("parallax", "px"), ("confidence", "1"), ("range", "m")):
        np.testing.assert_array_equal(dataset[name].values, layers[name])
        assert (dataset[name].attrs["units"], dataset[name].attrs["long_name"]) == (unit, name)
        assert dataset[name].chunks is not None
    assert dataset.NIR.shape == dataset.parallax.shape


def test_a_dataset_of_the_parallax_alone(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = run.write(tmp_path, monkeypatch)
    dataset = agalign.open_capture(tmp_path / run.capture.folder / f"{sidecar.capture}.json")
    assert {"confidence", "range"}.isdisjoint(dataset.data_vars)
    assert dataset.parallax.attrs["units"] == "px"
    assert dataset.parallax.shape == SIZE[::-1]


# ---- the places of lenses in tags


@pytest.mark.parametrize(("text", "place_m"), [
    ("0.03, -0.021, 0.0", (0.03, -0.021)), ("-15.0, 10.5, 0.2", (-0.015, 0.0105)), ("0, 0, 0", (0.0, 0.0)),
    ("1, 2", None),
])  # fmt: skip
def test_places_are_in_metres_or_millimetres(text: str, place_m: tuple[float, float] | None) -> None:
    class OneTag(Tags):
        def __init__(self) -> None: ...

        def numbers(self, *_: object) -> tuple[float, ...]:
            return tuple(float(v) for v in text.split(","))

    assert pix4d.lens_offset_m(OneTag()) == (None if place_m is None else pytest.approx(place_m))


def test_a_captures_lenses_are_where_the_camera_has_them(run: Run) -> None:
    for band in run.capture.bands:
        spec = next(b for b in CLOSE_RANGE.bands if b.name == band.name)
        assert band.lens_offset_m == pytest.approx(spec.baseline_m)
