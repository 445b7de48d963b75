from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from agalign.cameras.tag_seeds import geo_seed
from agalign.capture import seeding
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.seeding import best_seed, corrected, find_rotated, find_seed, with_reduced_reference
from agalign.capture.warped_pair import WarpedPair
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.fit.windows import FixedWindows
from agalign.pixels.landmarks import LANDMARK_INPUTS, landmarks, matched_homography
from agalign.values import geometry
from agalign.values.alignment import Seed
from agalign.values.capture import Band, Georeference
from agalign.values.choices import SeedKind
from agalign.values.image import Raster
from agalign.values.issues import NO_SUCH_SEED, Issue
from agalign.values.mapping import PixelMapping

from ..builders import pair_of, residual_of, texture, two_views
from ..conftest import mean_error_px

SHIFTED = np.array([[1.01, 0.01, 31.0], [-0.01, 1.0, -18.0], [0, 0, 1.0]])


def best(images: Sequence[Raster], candidates: SeedMatrices, force: SeedKind | None = None) -> Seed:
    return best_seed(pair_of(*images, candidates), candidates, force)


def test_structure_finds_an_unknown_shift() -> None:
    seed = best(two_views(SHIFTED), {"identity": np.eye(3)})
    assert seed.kind == "structure"
    assert seed.trusted
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 3


def test_the_true_rig_is_preferred_to_a_wrong_one_and_unchanged() -> None:
    wrong = geometry.translation(-40, 25)
    seed = best(two_views(SHIFTED), {"rig": SHIFTED, "geo": wrong, "identity": np.eye(3)})
    assert seed.kind == "rig"
    np.testing.assert_array_equal(seed.fixed_to_moving, SHIFTED)
    aligned = best(two_views(np.eye(3)), {"rig": geometry.translation(12, 3), "identity": np.eye(3)})
    np.testing.assert_array_equal(aligned.fixed_to_moving, np.eye(3))


@pytest.mark.parametrize("kind", ["identity", "rig"])
def test_a_forced_seed_is_used_whatever_its_score(kind: SeedKind) -> None:
    candidates = {"rig": geometry.translation(5, 5), "identity": np.eye(3)}
    seed = best(two_views(SHIFTED), candidates, kind)
    assert seed.kind == kind
    np.testing.assert_array_equal(seed.fixed_to_moving, candidates[kind])


@pytest.mark.parametrize("kind", ["rig", "geo", "user"])
def test_a_forced_seed_that_a_pair_lacks_is_an_issue(kind: SeedKind) -> None:
    pair = pair_of(*two_views(SHIFTED), {"identity": np.eye(3)})
    assert find_seed(pair, SeedSettings(force=kind)) == Issue(NO_SUCH_SEED, detail=kind)
    assert find_seed(pair, SeedSettings(force="structure")).kind == "structure"


def test_windows_correct_the_scale_of_a_seed() -> None:
    """A seed by tags without the scale of the band is wrong by several px at the corners."""
    truth = geometry.compose(geometry.translation(6.0, -4.0), np.diag([1.012, 1.012, 1.0]))
    pair = pair_of(*two_views(truth, 800, 640))
    seed = Seed("rig", geometry.translation(6.0, -4.0), 50.0, trusted=True)
    again = corrected(pair, seed)
    assert again is not None
    assert again.kind == "rig"
    assert geometry.corner_error_px(seed.fixed_to_moving, truth, 800, 640) > 5
    assert geometry.corner_error_px(again.fixed_to_moving, truth, 800, 640) < 0.5
    unrelated = pair_of(texture(seed=5), texture(seed=6))
    assert corrected(unrelated, seed) is None


def test_unrelated_images_have_no_trusted_seed_and_no_common_landmarks() -> None:
    one, other = texture(seed=5), texture(seed=6)
    assert not best((one, other), {"identity": np.eye(3)}).trusted
    for view in LANDMARK_INPUTS:
        assert matched_homography(landmarks(one, view), landmarks(other, view), (400, 320)) is None


def geo_seed_of(fine: Georeference, coarse: Georeference) -> np.ndarray | None:
    """The seed of images of 100 x 100 and 50 x 50 px."""
    fixed, moving = (
        Band("b", Path("b.tif"), 1, side, side, "uint16", georeference=on_ground)
        for side, on_ground in ((100, fine), (50, coarse))
    )
    return geo_seed(fixed, moving)


def test_geo_seed_maps_the_same_ground_to_the_same_ground() -> None:
    # 10 cm pixels from corner (500, 900); and 20 cm ones from (501, 899).
    fine = Georeference(np.array([[0.1, 0, 500], [0, -0.1, 900], [0, 0, 1.0]]), "crs")
    coarse = Georeference(np.array([[0.2, 0, 501], [0, -0.2, 899], [0, 0, 1.0]]), "crs")
    seed = geo_seed_of(fine, coarse)
    # Pixel (20, 20) of the fine one has its centre at x = 502.05: (502.05 - 501) / 0.2 - 0.5 = 4.75.
    np.testing.assert_allclose(geometry.apply(seed, [20, 20]), [4.75, 4.75])
    far = np.array([[1, 0, 499_500], [0, 1, 5_799_100], [0, 0, 1.0]])  # where UTM coordinates are
    seed = geo_seed_of(*(Georeference(far @ g.transform, "crs") for g in (fine, coarse)))
    np.testing.assert_allclose(geometry.apply(seed, [20, 20]), [4.75, 4.75], atol=1e-6)
    other = Georeference(coarse.transform, "no crs at all")
    with pytest.raises(GeometryError, match="cannot be transformed"):
        geo_seed_of(fine, other)


def test_a_trusted_mapping_of_the_flight_suffices() -> None:
    near = geometry.compose(SHIFTED, geometry.translation(0.3, 0.1))
    seed = best(two_views(SHIFTED), {"model": near, "identity": np.eye(3)})
    assert seed.kind in ("model", "structure")
    assert mean_error_px(seed.fixed_to_moving, SHIFTED, 400, 320) < 1
    failed = best(two_views(SHIFTED), {"model": geometry.translation(300, 0), "rig": SHIFTED})
    assert mean_error_px(failed.fixed_to_moving, SHIFTED, 400, 320) < 1


def rotated(image: Raster, degrees: float, scale: float = 1.0) -> tuple[Raster, np.ndarray]:
    """Rotate and scale an image on a larger canvas; return it and the mapping of its pixels."""
    width, height = image.size_px
    cos, sin = np.cos(np.radians(degrees)) * scale, np.sin(np.radians(degrees)) * scale
    size = round(width * abs(cos) + height * abs(sin)), round(width * abs(sin) + height * abs(cos))
    matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    matrix[:2, 2] = (np.array(size) - 1) / 2 - matrix[:2, :2] @ ((np.array([width, height]) - 1) / 2)
    valid = cv2.warpAffine(np.full((height, width), 255, np.uint8), matrix[:2], size) == 255
    return Raster(cv2.warpAffine(image.pixels, matrix[:2], size, flags=cv2.INTER_CUBIC), valid), matrix


@pytest.mark.parametrize(("degrees", "scale"), [(45, 1.0), (10, 0.6), (-90, 1.5)])
def test_landmarks_align_rotated_and_scaled_images(degrees: float, scale: float) -> None:
    fixed, moving = two_views(SHIFTED)
    image, to_rotated = rotated(moving, degrees, scale)
    overlay = geometry.overlay(fixed.size_px, image.size_px)
    seed = find_seed(pair_of(fixed, image, {"identity": overlay}), SeedSettings())
    assert (seed.kind, seed.trusted) == ("match", True)
    assert mean_error_px(seed.fixed_to_moving, geometry.compose(to_rotated, SHIFTED), 400, 320) < 2 * scale


def test_a_wrong_rotation_in_the_tags_is_detected() -> None:
    """The image centre agrees with the tags and the correlation peak, the corners do not."""
    fixed, moving = two_views(np.eye(3), 640, 480)
    image, truth = rotated(moving, 3.0)
    middle = np.array([(639 / 2, 479 / 2)])
    ((dx, dy),) = geometry.apply(truth, middle) - middle
    tags: SeedMatrices = {"rig": geometry.translation(dx, dy)}
    pair = pair_of(fixed, image, tags, rig=8.0)
    first = best_seed(pair, tags)
    assert first.trusted, "by the peak alone it looks right"
    assert pair.is_expected(first.fixed_to_moving)
    result = find_seed(pair, SeedSettings())
    assert result.kind == "match"
    assert mean_error_px(result.fixed_to_moving, truth, 640, 480) < 2


@pytest.mark.slow
def test_a_rotation_is_distinguished_from_a_shift() -> None:
    fixed, moving = two_views(np.eye(3), 640, 480)
    image, truth = rotated(moving, 4.0)
    pair = pair_of(fixed, image)

    def found_rotated(mapping: np.ndarray) -> np.ndarray | None:
        return find_rotated(WarpedPair.of(pair, pair.mapping(mapping)))

    assert mean_error_px(found_rotated(np.eye(3)), truth, 640, 480) < 2
    assert found_rotated(truth) is None, "the given mapping is right"
    shifted = geometry.compose(truth, geometry.translation(60, 25))
    assert found_rotated(shifted) is None, "a shift may be an alias"


@pytest.mark.parametrize(
    ("kind", "std_px", "settings"), [("user", {"user": 3.0}, SeedSettings()), ("model", {}, SeedSettings(force="geo"))]
)
def test_neither_the_user_s_seed_nor_that_of_a_forced_kind_is_replaced_by_landmarks(
    kind: SeedKind, std_px: dict[str, float], settings: SeedSettings
) -> None:
    """The mapping of a model without a rig is that of the captures that it was learned from, with the forced kind."""
    fixed, moving = two_views(np.eye(3))
    image, to_rotated = rotated(moving, 10)
    seed = find_seed(pair_of(fixed, image, {kind: geometry.translation(5, 5)}, **std_px), settings)
    assert seed.kind in (kind, "structure")
    assert mean_error_px(seed.fixed_to_moving, to_rotated, 400, 320) > 5


@pytest.mark.parametrize(
    ("degrees", "std_px", "is_near"), [(3.0, None, True), (8.0, None, True), (8.0, 20.0, True), (8.0, 10.0, False)]
)
def test_a_seed_of_the_user_that_the_windows_do_not_confirm_is_corrected_or_matched(
    degrees: float, std_px: float | None, is_near: bool
) -> None:
    """Within its standard error, if that is known: 8 degrees are 45 px at the corners."""
    fixed, moving = two_views(np.eye(3), 640, 480)
    (cos, sin), centre_px = (np.cos(np.radians(degrees)), np.sin(np.radians(degrees))), (319.5, 239.5)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    about_centre = geometry.translation(*centre_px) @ turn @ geometry.translation(*np.negative(centre_px))
    std = {} if std_px is None else {"user": std_px}
    seed = find_seed(pair_of(fixed, moving, {"user": about_centre}, **std), SeedSettings())
    assert (mean_error_px(seed.fixed_to_moving, np.eye(3), 640, 480) < 3) is is_near


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_a_match_with_a_lower_peak_does_not_replace_a_seed_that_the_tags_and_windows_confirm(
    is_confirmed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a quarter turn of a square grid of equal plants."""
    image = texture()
    pair = pair_of(image, image, {"rig": np.eye(3)}, **({"rig": 5.0} if is_confirmed else {}))
    turned = geometry.compose(geometry.translation(40.0, 310.0), np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    monkeypatch.setattr(seeding, "_matches", lambda _: iter([turned]))
    seed = Seed("structure", np.eye(3), 33.0, 33.0, 25.0)

    def measured(pair: BandPair, mapping: PixelMapping, windows: FixedWindows | None = None) -> WarpedPair:
        windows = pair.windows if windows is None else windows
        shift_px = 0.4 if mapping.fixed_to_moving is seed.fixed_to_moving else 0.2
        return WarpedPair(pair, mapping, image, windows, residual_of(windows.centres_px, np.array([shift_px, 0.0])))

    monkeypatch.setattr(WarpedPair, "of", measured)
    given = WarpedPair.of(pair, pair.mapping(seed.fixed_to_moving))
    chosen = seeding._best_match(given, seed, is_confirmed=is_confirmed)
    assert (chosen is seed) == is_confirmed


def test_an_inaccurate_match_is_corrected_by_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, moving = two_views(SHIFTED)
    image, to_rotated = rotated(moving, 45)
    truth = geometry.compose(to_rotated, SHIFTED)
    off = geometry.compose(truth, geometry.moving_corners([3.0, -2.0, -2.0, 2.0, 3.0, 2.0, -2.0, -3.0], 400, 320))
    monkeypatch.setattr("agalign.capture.seeding._matches", lambda _: iter([off]))
    seed = find_seed(pair_of(fixed, image), SeedSettings())
    assert mean_error_px(off, truth, 400, 320) > 1.0
    assert mean_error_px(seed.fixed_to_moving, truth, 400, 320) < 0.5


def test_a_reference_is_reduced_with_the_seed_and_its_standard_error() -> None:
    start = geometry.compose(geometry.overlay((640, 480), (80, 60)), geometry.translation(9.0, -7.0))
    pair = pair_of(texture(640, 480), texture(80, 60), {"user": start}, user=16.0)
    reduced = with_reduced_reference(pair, SeedSettings())
    assert (reduced.fixed.size_px, reduced.is_coarse, reduced.seed_std_px) == ((160, 120), True, {"user": 4.0})
    np.testing.assert_allclose(reduced.scales.between_files(reduced.seed_matrices["user"]), start, atol=1e-9)
    same_pixels = pair_of(texture(640, 480), texture(80, 60), {"user": np.eye(3)})
    assert with_reduced_reference(same_pixels, SeedSettings()) is same_pixels
