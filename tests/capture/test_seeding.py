import cv2
import numpy as np
import pytest

from agalign.capture.band_pair import BandPair, Candidates
from agalign.capture.seeding import best_seed, find_rotated, find_seed
from agalign.capture.tag_seeds import geo_seed
from agalign.capture.verification import WarpedPair
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.pixels.landmarks import LANDMARK_INPUTS, landmarks, matched_homography
from agalign.values import geometry
from agalign.values.alignment import Seed
from agalign.values.capture import Band, Georeference
from agalign.values.choices import SeedKind
from agalign.values.image import Raster

from ..conftest import mean_error_px, textured_image, textured_pair

SHIFTED = np.array([[1.01, 0.01, 31.0], [-0.01, 1.0, -18.0], [0, 0, 1.0]])


def rasters(matrix: np.ndarray, seed: int = 0) -> tuple[Raster, Raster]:
    fixed, moving = textured_pair(matrix, seed=seed)
    valid = np.ones(fixed.shape, bool)
    return Raster(fixed, valid), Raster(moving, valid)


def best(images: tuple[Raster, Raster], candidates: Candidates, force: SeedKind | None = None) -> Seed:
    return best_seed(BandPair.of_images("moving", *images, candidates), candidates, force)


def test_structure_finds_an_unknown_shift() -> None:
    seed = best(rasters(SHIFTED), {"identity": np.eye(3)})
    assert seed.kind == "structure"
    assert seed.trusted
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 3


def test_the_true_rig_is_preferred_to_a_wrong_one_and_unchanged() -> None:
    wrong = geometry.translation(-40, 25)
    seed = best(rasters(SHIFTED), {"rig": SHIFTED, "geo": wrong, "identity": np.eye(3)})
    assert seed.kind == "rig"
    np.testing.assert_array_equal(seed.fixed_to_moving, SHIFTED)


def test_an_aligned_input_keeps_its_identity() -> None:
    rig = geometry.translation(12, 3)
    seed = best(rasters(np.eye(3)), {"rig": rig, "identity": np.eye(3)})
    np.testing.assert_array_equal(seed.fixed_to_moving, np.eye(3))


@pytest.mark.parametrize("kind", ["identity", "rig"])
def test_a_forced_seed_is_used_whatever_its_score(kind: SeedKind) -> None:
    candidates = {"rig": geometry.translation(5, 5), "identity": np.eye(3)}
    seed = best(rasters(SHIFTED), candidates, kind)
    assert seed.kind == kind
    np.testing.assert_array_equal(seed.fixed_to_moving, candidates[kind])


def test_unrelated_images_give_no_trusted_seed() -> None:
    valid = np.ones((320, 400), bool)
    one, other = (Raster(textured_image(400, 320, s), valid) for s in (5, 6))
    assert not best((one, other), {"identity": np.eye(3)}).trusted


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


def test_a_trusted_mapping_of_the_flight_suffices() -> None:
    near = geometry.compose(SHIFTED, geometry.translation(0.3, 0.1))
    seed = best(rasters(SHIFTED), {"model": near, "identity": np.eye(3)})
    assert seed.kind in ("model", "structure")
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 1
    failed = best(rasters(SHIFTED), {"model": geometry.translation(300, 0), "rig": SHIFTED})
    assert mean_error_px(failed.fixed_to_moving, SHIFTED, 400, 320) < 1


def rotated(image: np.ndarray, degrees: float, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotate and scale an image on a larger canvas; return it, its mask, and the mapping of its pixels."""
    height, width = image.shape
    cos, sin = np.cos(np.radians(degrees)) * scale, np.sin(np.radians(degrees)) * scale
    size = round(width * abs(cos) + height * abs(sin)), round(width * abs(sin) + height * abs(cos))
    matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    matrix[:2, 2] = (np.array(size) - 1) / 2 - matrix[:2, :2] @ ((np.array([width, height]) - 1) / 2)
    valid = cv2.warpAffine(np.full(image.shape, 255, np.uint8), matrix[:2], size) == 255
    return cv2.warpAffine(image, matrix[:2], size, flags=cv2.INTER_CUBIC), valid, matrix


@pytest.mark.parametrize(("degrees", "scale"), [(3, 1.0), (45, 1.0), (180, 1.0), (10, 0.6), (-90, 1.5)])
def test_landmarks_align_rotated_and_scaled_images(degrees: float, scale: float) -> None:
    fixed, moving = textured_pair(SHIFTED)
    image, valid, to_rotated = rotated(moving, degrees, scale)
    images = Raster(fixed, np.ones(fixed.shape, bool)), Raster(image, valid)
    overlay = geometry.overlay(images[0].size_px, images[1].size_px)
    seed = find_seed(BandPair.of_images("moving", *images, {"identity": overlay}), SeedSettings())
    assert (seed.kind, seed.trusted) == ("match", True)
    assert mean_error_px(seed.fixed_to_moving, geometry.compose(to_rotated, SHIFTED), 400, 320) < 2 * scale


def rotated_pair(degrees: float, candidates: Candidates, candidate_std_px: dict[str, float] | None = None) -> BandPair:
    fixed, moving = textured_pair(np.eye(3), 640, 480)
    image, valid, _ = rotated(moving, degrees, 1.0)
    images = Raster(fixed, np.ones(fixed.shape, bool)), Raster(image, valid)
    return BandPair.of_images("moving", *images, candidates, candidate_std_px or {})


def test_a_wrong_rotation_in_the_tags_is_detected() -> None:
    """The image centre agrees with the tags and the correlation peak, the corners do not."""
    _, _, truth = rotated(np.zeros((480, 640), np.float32), 3.0, 1.0)
    middle = np.array([(639 / 2, 479 / 2)])
    ((dx, dy),) = geometry.apply(truth, middle) - middle
    tags: Candidates = {"rig": geometry.translation(dx, dy)}
    pair = rotated_pair(3.0, tags, {"rig": 8.0})
    first = best_seed(pair, tags)
    assert first.trusted, "by the peak alone it looks right"
    assert pair.is_expected(first.fixed_to_moving)
    result = find_seed(pair, SeedSettings())
    assert result.kind == "match"
    assert mean_error_px(result.fixed_to_moving, truth, 640, 480) < 2


@pytest.mark.slow
def test_a_rotation_is_distinguished_from_a_shift() -> None:
    _, _, truth = rotated(np.zeros((480, 640), np.float32), 4.0, 1.0)
    pair = rotated_pair(4.0, {"identity": np.eye(3)})

    def found_rotated(mapping: np.ndarray) -> np.ndarray | None:
        return find_rotated(pair, mapping, WarpedPair.of(pair, pair.mapping(mapping)).residual)

    result = found_rotated(np.eye(3))
    assert result is not None
    assert mean_error_px(result, truth, 640, 480) < 2
    assert found_rotated(truth) is None, "the given mapping is right"
    shifted = geometry.compose(truth, geometry.translation(60, 25))
    assert found_rotated(shifted) is None, "a shift may be an alias"


def test_the_user_s_seed_is_not_replaced_by_landmarks() -> None:
    fixed, moving = textured_pair(np.eye(3))
    image, valid, to_rotated = rotated(moving, 10, 1.0)
    images = Raster(fixed, np.ones(fixed.shape, bool)), Raster(image, valid)
    elsewhere = geometry.translation(5, 5)
    pair = BandPair.of_images("moving", *images, {"user": elsewhere}, {"user": 3.0})
    seed = find_seed(pair, SeedSettings())
    assert seed.kind in ("user", "structure")
    assert mean_error_px(seed.fixed_to_moving, to_rotated, 400, 320) > 5


def test_unrelated_images_have_no_landmarks_in_common() -> None:
    valid = np.ones((320, 400), bool)
    one, other = (Raster(textured_image(400, 320, s), valid) for s in (5, 6))
    for view in LANDMARK_INPUTS:
        assert matched_homography(landmarks(one, view), landmarks(other, view), (400, 320)) is None


def test_an_inaccurate_match_is_corrected_by_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, moving = textured_pair(SHIFTED)
    image, valid, to_rotated = rotated(moving, 45, 1.0)
    truth = geometry.compose(to_rotated, SHIFTED)
    off = geometry.compose(truth, geometry.moving_corners([3.0, -2.0, -2.0, 2.0, 3.0, 2.0, -2.0, -3.0], 400, 320))
    monkeypatch.setattr("agalign.capture.seeding._matches", lambda *_, **__: iter([off]))
    images = Raster(fixed, np.ones(fixed.shape, bool)), Raster(image, valid)
    seed = find_seed(BandPair.of_images("moving", *images, {"identity": np.eye(3)}), SeedSettings())
    assert mean_error_px(off, truth, 400, 320) > 1.0
    assert mean_error_px(seed.fixed_to_moving, truth, 400, 320) < 0.5
