import numpy as np
import pytest

from agalign import geometry
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.mapping import Mapping
from agalign.records import Band, Georeference, Raster
from agalign.seed import best_seed, geo_seed, is_trusted, overlay, warped

from .conftest import mean_error_px, textured_image, textured_pair

SHIFTED = np.array([[1.01, 0.01, 31.0], [-0.01, 1.0, -18.0], [0, 0, 1.0]])


def rasters(matrix: np.ndarray, seed: int = 0) -> tuple[Raster, Raster]:
    fixed, moving = textured_pair(matrix, seed=seed)
    valid = np.ones(fixed.shape, bool)
    return Raster(fixed, valid), Raster(moving, valid)


def test_structure_finds_a_shift_that_nothing_told() -> None:
    seed = best_seed(*rasters(SHIFTED), {"identity": np.eye(3)}, SeedSettings())
    assert seed.kind == "structure"
    assert is_trusted(seed, SeedSettings())
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 3


def test_the_true_rig_wins_over_a_wrong_one_and_is_kept_as_it_is() -> None:
    wrong = geometry.translation(-40, 25)
    seed = best_seed(*rasters(SHIFTED), {"rig": SHIFTED, "geo": wrong, "identity": np.eye(3)}, SeedSettings())
    assert seed.kind == "rig"
    np.testing.assert_array_equal(seed.fixed_to_moving, SHIFTED)


def test_an_aligned_input_keeps_its_identity() -> None:
    rig = geometry.translation(12, 3)
    seed = best_seed(*rasters(np.eye(3)), {"rig": rig, "identity": np.eye(3)}, SeedSettings())
    np.testing.assert_array_equal(seed.fixed_to_moving, np.eye(3))


@pytest.mark.parametrize("kind", ["identity", "rig"])
def test_a_forced_seed_is_used_whatever_its_score(kind: str) -> None:
    candidates = {"rig": geometry.translation(5, 5), "identity": np.eye(3)}
    seed = best_seed(*rasters(SHIFTED), candidates, SeedSettings(force=kind))
    assert seed.kind == kind
    np.testing.assert_array_equal(seed.fixed_to_moving, candidates[kind])


def test_unrelated_images_give_no_trusted_seed() -> None:
    valid = np.ones((320, 400), bool)
    pair = [Raster(textured_image(400, 320, s), valid) for s in (5, 6)]
    assert not is_trusted(best_seed(*pair, {"identity": np.eye(3)}, SeedSettings()), SeedSettings())


def band(width: int, height: int, georeference: Georeference | None = None) -> Band:
    from pathlib import Path

    return Band("b", Path("b.tif"), 1, width, height, "uint16", georeference=georeference)


def test_geo_seed_maps_the_same_ground_to_the_same_ground() -> None:
    # 10 cm pixels from corner (500, 900); and 20 cm ones from (501, 899).
    fine = Georeference(np.array([[0.1, 0, 500], [0, -0.1, 900], [0, 0, 1.0]]), "crs")
    coarse = Georeference(np.array([[0.2, 0, 501], [0, -0.2, 899], [0, 0, 1.0]]), "crs")
    seed = geo_seed(band(100, 100, fine), band(50, 50, coarse))
    assert seed is not None
    # Pixel (20, 20) of the fine one has its centre at x = 502.05: (502.05 - 501) / 0.2 - 0.5 = 4.75.
    np.testing.assert_allclose(geometry.apply(seed, [20, 20]), [4.75, 4.75])
    far = np.array([[1, 0, 499_500], [0, 1, 5_799_100], [0, 0, 1.0]])  # where UTM coordinates are
    moved = [Georeference(far @ g.transform, "crs") for g in (fine, coarse)]
    seed = geo_seed(band(100, 100, moved[0]), band(50, 50, moved[1]))
    assert seed is not None
    np.testing.assert_allclose(geometry.apply(seed, [20, 20]), [4.75, 4.75], atol=1e-6)
    other = Georeference(coarse.transform, "no crs at all")
    with pytest.raises(GeometryError, match="cannot be transformed"):
        geo_seed(band(100, 100, fine), band(50, 50, other))


def test_overlay_matches_the_outlines() -> None:
    np.testing.assert_allclose(overlay(band(100, 80), band(100, 80)), np.eye(3))
    edges = geometry.apply(overlay(band(100, 80), band(50, 40)), [[-0.5, -0.5], [99.5, 79.5]])
    np.testing.assert_allclose(edges, [[-0.5, -0.5], [49.5, 39.5]])


def test_warped_shows_the_moving_image_on_the_fixed_grid() -> None:
    fixed, moving = rasters(SHIFTED)
    there = warped(moving, Mapping(SHIFTED), fixed.size_px)
    inside = there.valid & fixed.valid
    assert np.corrcoef(fixed.pixels[inside], there.pixels[inside])[0, 1] < -0.9
    half = warped(moving, Mapping(SHIFTED), (200, 160), (0.5, 0.5))
    assert half.size_px == (200, 160)


def test_the_flights_mapping_is_enough_where_it_leaves_no_doubt() -> None:
    near = geometry.compose(SHIFTED, geometry.translation(0.3, 0.1))
    seed = best_seed(*rasters(SHIFTED), {"model": near, "identity": np.eye(3)}, SeedSettings())
    assert seed.kind in ("model", "structure")
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 1
    lost = best_seed(*rasters(SHIFTED), {"model": geometry.translation(300, 0), "rig": SHIFTED}, SeedSettings())
    assert mean_error_px(lost.fixed_to_moving, SHIFTED, 400, 320) < 1
