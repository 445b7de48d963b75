"""The scores of benchmarks/relief.py are right for mappings, rasters and masks that are known."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from peers import dis_flow
from relief import Score, Sidecar, mapping_of, occlusion_scores, range_errors, residuals
from synthetic_flights.depth import BandTruth, Truth

from agalign.pixels.raster import without_warnings
from agalign.values import geometry

pytestmark = pytest.mark.full

WIDTH, HEIGHT = 96, 64
HERE = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(np.float64)


def known(**masks: np.ndarray) -> BandTruth:
    plain = {"hidden": np.zeros((HEIGHT, WIDTH), bool), "inside": np.ones((HEIGHT, WIDTH), bool)}
    plain["moved"] = plain["hidden"]
    return BandTruth((HERE + np.array((3, -2))).astype(np.float32), **(plain | masks))


def sidecar(folder: Path, crop: tuple[int, int, int, int] = (0, 0, WIDTH, HEIGHT)) -> Sidecar:
    content = {"reference": {"width": WIDTH, "height": HEIGHT}, "output": {"crop": crop}}
    return Sidecar(folder / "IMG_0001.json", content)


def figures(mapping: np.ndarray, *args: object) -> tuple[float, ...]:
    return tuple(residuals(mapping, *args).values())  # type: ignore[arg-type]


def test_a_grid_is_interpolated(tmp_path: Path) -> None:
    here = geometry.lattice(WIDTH, HEIGHT, 17, 13)
    bent = here + np.stack([here[:, 1] ** 2, here[:, 0] * here[:, 1]], axis=1) / 500
    grid = {"reference_px": here.tolist(), "moving_px": bent.tolist()}
    mapping = mapping_of(sidecar(tmp_path), {"grid": grid})
    assert mapping is not None
    expected = HERE + np.stack([HERE[..., 1] ** 2, HERE[..., 0] * HERE[..., 1]], axis=-1) / 500
    np.testing.assert_allclose(mapping, expected, atol=1e-6)
    assert mapping_of(sidecar(tmp_path), {"grid": None}) is None


def test_a_relief_displaces_the_written_pixels(tmp_path: Path) -> None:
    nodes = geometry.lattice(WIDTH, HEIGHT, 17, 13)
    plane = HERE + HERE**2 / 500
    relief = {
        "file": "IMG_0001.relief.tif",
        "reference_px": nodes.tolist(),
        "plane_px": (nodes + nodes**2 / 500).tolist(),
        "slope": (np.array((0.8, -0.5)) + nodes / 1000).tolist(),
    }
    # A step that no grid of the sidecar could show.
    parallax = np.where(HERE[4:, 8:, 0] < 40, -2.0, 5.0).astype(np.float32)
    write(tmp_path / "IMG_0001.relief.tif", parallax[None], ["parallax"])
    one = sidecar(tmp_path, (8, 4, WIDTH - 8, HEIGHT - 4))
    mapping = mapping_of(one, {"grid": {"reference_px": [], "moving_px": []}, "relief": relief})
    assert mapping is not None
    expected = plane[4:, 8:] + parallax[..., None] * (np.array((0.8, -0.5)) + HERE[4:, 8:] / 1000)
    np.testing.assert_allclose(mapping[4:, 8:], expected, atol=1e-5)
    assert np.isnan(mapping[:4]).all()
    assert np.isnan(mapping[:, :8]).all()
    # A relief without a raster, as where nothing was written, leaves the grid.
    grid = {"reference_px": nodes.tolist(), "moving_px": nodes.tolist()}
    np.testing.assert_allclose(mapping_of(one, {"grid": grid, "relief": relief | {"file": None}}), HERE, atol=1e-6)


def test_residuals_are_of_what_is_visible_and_still() -> None:
    left, top = HERE[..., 0] < 48, HERE[..., 1] < 8
    truth = known(hidden=left, moved=top)
    mapping = truth.moving_px + np.where(left | top, 100.0, 0.25)[..., None] * (0.6, 0.8)
    assert figures(mapping, truth) == pytest.approx((0.25, 0.25, 0.0), abs=1e-4)
    partly = truth.moving_px + np.where(HERE[..., 0] < 60, 2.0, 0.25)[..., None] * (0.6, 0.8)
    assert figures(partly, truth) == pytest.approx((0.25, 2.0, 0.25), abs=1e-4)
    written = slice(4, 60), slice(50, 90)
    cropped = np.full_like(partly, np.nan)
    cropped[written] = partly[written]
    assert figures(cropped, truth, written) == pytest.approx((0.25, 2.0, 0.25), abs=1e-4)
    assert not residuals(None, truth)
    assert not residuals(mapping, known(hidden=np.ones((HEIGHT, WIDTH), bool)))
    assert residuals(np.full_like(mapping, np.nan), truth)["p90_px"] == np.inf


def test_wrong_is_aligned_and_off_or_of_another_scene() -> None:
    def wrong(status: str, p90_px: float) -> bool:
        return Score("agalign", "flat", True, 0, status=status, p90_px=p90_px).wrong

    assert [wrong("aligned", p90) for p90 in (0.2, 1.0, 1.1, np.inf, np.nan)] == [False, False, True, True, True]
    assert not wrong("predicted", 5.0)
    assert not wrong("failed", np.nan)


def write(path: Path, bands: np.ndarray, names: Sequence[str] = ()) -> None:
    profile = {"driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
    nodata = np.nan if bands.dtype == np.float32 else 0
    with without_warnings(), rasterio.open(path, "w", dtype=bands.dtype, nodata=nodata, **profile) as dataset:
        dataset.write(bands)
        for index, name in enumerate(names, start=1):
            dataset.set_band_description(index, name)


def test_range_is_compared_on_the_written_pixels(tmp_path: Path) -> None:
    range_m = (1 + HERE[..., 0] / 100).astype(np.float32)
    relief = np.stack([range_m, range_m, 1.02 * range_m])[:, 4:, 8:].astype(np.float32)
    relief[:, :15] = np.nan
    one = sidecar(tmp_path, (8, 4, WIDTH - 8, HEIGHT - 4))
    truth = Truth("flat", range_m, {})
    assert np.isnan(range_errors(one, truth)).all()
    write(tmp_path / "IMG_0001.relief.tif", relief[:1], ["parallax"])
    assert np.isnan(range_errors(one, truth)).all(), "without --relief-map"
    write(tmp_path / "IMG_0001.relief.tif", relief, ["parallax", "confidence", "range"])
    assert range_errors(one, truth) == pytest.approx((0.02, 0.75), abs=1e-4)


def test_occlusions_are_pixels_without_data_to_one_px(tmp_path: Path) -> None:
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[10:30, 40:50] = True
    inside = HERE[..., 0] < 80
    stack = np.full((2, HEIGHT, WIDTH), 7, np.uint16)
    stack[1, 10:30, 41:47] = 0  # the right columns are missed, but for the one next to the mask
    stack[1, 40:50, 20:32] = 0  # half of the masked pixels are wrong
    stack[1, :, 80:] = 0  # outside the band's image
    write(tmp_path / "IMG_0001.tif", stack)
    band = {"place": {"file": "IMG_0001.tif", "band_index": 2}}
    result = occlusion_scores(sidecar(tmp_path), band, known(hidden=hidden, inside=inside))
    assert result == pytest.approx({"precision": 0.5, "recall": 0.8})
    assert not occlusion_scores(sidecar(tmp_path), {"place": None}, known())


def test_the_dense_flow_finds_a_shift_on_top_of_its_start() -> None:
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.normal(size=(240, 320)).astype(np.float32), (0, 0), 2.5)
    reference, moving = ground[20:220, 20:300], ground[18:218, 23:303]
    here = np.stack(np.meshgrid(np.arange(280), np.arange(200)), axis=-1).astype(np.float64)
    start = np.array((-2.0, 0.9))
    # The content at (x, y) of the reference is at (x - 3, y + 2) of the moving image; the start is 1.5 px off.
    mapping = dis_flow(reference, moving, here + start)
    error = np.linalg.norm(mapping - here - (-3, 2), axis=-1)[40:-40, 40:-40]
    assert np.median(error) < 0.15
