"""The checks: each finds its issue, alone and at its limit, and issues decide the status."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

import agalign
from agalign.fit.windows import FixedWindows, centred_correlation
from agalign.pixels.structure import correlation_surfaces, structure_field, windowed_spectra
from agalign.values import geometry, issues
from agalign.values.alignment import JointResult, Prediction
from agalign.values.geometry import Points
from agalign.values.issues import Issue, sentence
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale
from agalign.values.residual import Residual
from agalign.verify import checks
from agalign.verify.checks import (
    AliasPeak,
    Layer,
    alias_peaks,
    content_issues,
    is_unchanged,
    issues_of,
    layer_issues,
    repetition_issues,
    rig_issues,
    second_layer,
    seed_fits,
)

from ..builders import grid_px, joint_result, residual_of, texture, whole
from ..conftest import textured_image, textured_pair

SIZE = (1280, 960)
JOINT = joint_result(std_px=0.07)


def measured_in(share: float, shift_px: float = 0.0) -> Residual:
    """A hundred windows; the shift along x is measured in a share of them."""
    is_measured = np.arange(100)[:, None] < 100 * share
    return residual_of(np.zeros((100, 2)), np.where(is_measured, (shift_px, 0.0), np.nan))


RESIDUAL = measured_in(1.0)


@dataclass(frozen=True)
class Checked:
    """A mapping whose error is limited in the common area, by default at its windows, and its evidence."""

    joint: JointResult | None = JOINT
    windows: Residual = RESIDUAL
    parallax: Parallax | None = None
    pixel_px: float = 1.0
    common_px: Points | None = None

    @property
    def issues(self) -> tuple[Issue, ...]:
        joint = self.joint
        mapping = PixelMapping(np.eye(3) if joint is None else joint.fixed_to_moving).with_parallax(self.parallax)
        covariance_px2 = None if joint is None else joint.covariance_px2
        error = MappingError(SIZE, covariance_px2, self.windows, parallax=self.parallax)
        common_px = self.windows.centres_px if self.common_px is None else self.common_px
        return issues_of(mapping, error, self.windows, joint, common_px, self.pixel_px)


GOOD = Checked()
FLAT = Parallax(Relief(np.zeros((SIZE[1], SIZE[0]), np.float32), np.ones((SIZE[1], SIZE[0]), np.float32)), (1.0, 0.0))
STRETCHED = np.array([[1.0, 0, 0], [0, 1, 0], [-5e-4, 0, 1]])
NAN = float("nan")


def codes(checked: Checked = GOOD, residual: Residual | None = None) -> list[str]:
    return [issue.code for issue in replace(checked, windows=residual or checked.windows).issues]


def test_a_good_result_has_no_issues() -> None:
    assert codes() == []


@pytest.mark.parametrize(
    ("joint", "measured", "expected"),
    [
        ({"retrieval": NAN}, 1.0, "retrieval"),
        ({"corner_covariance_px2": np.full((8, 8), NAN)}, 1.0, "inaccurate"),
        ({"corner_std_xy_px": ((float("inf"), 0.1),) * 4}, 1.0, "inaccurate"),
        ({"fixed_to_moving": np.diag([-1.0, 1, 1])}, 1.0, "folds"),
        ({}, 0.0, "coverage"),
        ({"retrieval": 0.1}, 0.1, "retrieval coverage"),
    ],
)
def test_values_that_are_not_finite_and_mirrored_mappings_are_issues(
    joint: dict[str, object], measured: float, expected: str
) -> None:
    issues = Checked(replace(JOINT, **joint), measured_in(measured)).issues
    assert [issue.code for issue in issues] == expected.split()
    assert all(sentence(d) for d in issues)


def test_a_part_of_the_image_that_the_relief_of_other_bands_does_not_align_is_an_issue() -> None:
    under_relief = Checked(parallax=FLAT)
    assert codes(under_relief, measured_in(0.9)) == []
    assert codes(under_relief, measured_in(0.89)) == ["unmeasured"]
    assert codes(GOOD, measured_in(0.89)) == []


def test_windows_in_one_corner_do_not_verify_a_mapping_under_a_relief_elsewhere() -> None:
    corner = residual_of(grid_px(np.arange(0, 240, 40), np.arange(0, 240, 40)), np.zeros((36, 2)))
    checked = Checked(joint_result(std_px=0.2), corner, FLAT)
    assert checked.issues == ()
    (issue,) = replace(checked, common_px=grid_px(np.arange(0, 1280, 80), np.arange(0, 960, 80))).issues
    assert (issue.code, issue.detail) == ("inaccurate", "0.5 px")
    assert issue.value > 0.5


def shifted(count_off: int, off_px: float, total: int = 100) -> Residual:
    """A row of windows, some of them misaligned at scattered positions."""
    centres = np.stack([np.linspace(0, SIZE[0] - 1, total), np.zeros(total)], axis=1)
    shifts = np.zeros((total, 2))
    shifts[: 3 * count_off : 3, 0] = off_px
    return residual_of(centres, shifts)


@pytest.mark.parametrize(
    ("within", "beyond", "code", "value", "limit"),
    [
        (measured_in(0.3), measured_in(0.29), "coverage", 0.29, 0.3),
        (shifted(0, 0.0, 5), shifted(0, 0.0, 4), "few_windows", 4, 5),
        (shifted(1, NAN, 6), shifted(1, NAN, 5), "few_windows", 4, 5),
        (shifted(10, 1.5), shifted(11, 1.5), "close_windows", 0.89, 0.9),
        (shifted(11, 1.0), shifted(11, 1.04), "close_windows", 0.89, 0.9),
        (joint_result(retrieval=0.2), joint_result(retrieval=0.19), "retrieval", 0.19, 0.2),
        (joint_result(retrieval=0.5, chance=0.1), joint_result(retrieval=0.49, chance=0.1), "retrieval", 0.49, 0.5),
        (joint_result(np.diag([2.0, 0.5, 1])), joint_result(STRETCHED), "folds", 4.62, 4.0),
    ],
)
def test_results_and_windows_pass_at_their_limits(
    within: object, beyond: object, code: str, value: float, limit: float
) -> None:
    part = "windows" if isinstance(within, Residual) else "joint"
    assert replace(GOOD, **{part: within}).issues == ()
    (issue,) = replace(GOOD, **{part: beyond}).issues
    assert (issue.code, issue.limit) == (code, limit)
    assert issue.value == pytest.approx(value, rel=0.01)
    assert f"{value:.2f}" in sentence(issue) or code != "retrieval"
    assert issue.detail == "1 px" or code != "close_windows"


@pytest.mark.parametrize(
    ("recipe", "residual", "is_accepted"),
    [
        ("windows", shifted(0, 0.0, 20), True),
        ("fast", shifted(0, 0.0, 20), False),
        ("windows", shifted(0, 0.0, 11), False),
        ("windows", shifted(0, 0.0, 12), True),
        ("windows", shifted(5, NAN, 14), False),
        ("windows", shifted(6, NAN, 30), True),
    ],
)
def test_without_descriptors_more_windows_are_required(recipe: str, residual: Residual, is_accepted: bool) -> None:
    joint = joint_result(retrieval=0.05, recipe=recipe, std_px=0.1)
    assert codes(replace(GOOD, joint=joint, windows=residual)) == ([] if is_accepted else ["retrieval"])


def test_descriptors_do_not_confirm_a_mapping_that_is_fitted_to_windows() -> None:
    """Their retrieval was measured under another mapping."""
    joint = joint_result(retrieval=0.9, recipe="windows")
    assert codes(replace(GOOD, joint=joint, windows=shifted(0, 0.0, 11))) == ["few_windows"]
    lost = joint_result(retrieval=0.1, recipe="windows")
    assert codes(replace(GOOD, joint=lost, windows=shifted(0, 0.0, 11))) == ["retrieval"]


@pytest.mark.parametrize(
    ("off_px", "std_px", "is_issue"),
    [(None, 0.2, False), (2.9, 0.2, False), (3.1, 0.2, True), (4.9, 1.0, False), (5.1, 1.0, True), (NAN, 0.2, True)],
)
def test_a_result_far_from_the_rig_is_an_issue(off_px: float | None, std_px: float, is_issue: bool) -> None:
    prediction = Prediction(np.eye(3), "bands", std_px, off_px=off_px)
    assert [issue.code for issue in rig_issues(prediction)] == ["unexpected_px"] * is_issue


def test_the_limit_is_a_pixel_of_the_file_where_the_images_are_reduced() -> None:
    within = replace(GOOD, windows=shifted(11, 0.7))
    assert codes(within) == []
    assert codes(replace(within, pixel_px=0.65)) == ["close_windows"]


def test_every_kind_of_issue_has_a_code_of_its_own() -> None:
    """The codes of two kinds must differ: sidecars have nothing else of them."""
    kinds = [kind for kind in vars(issues).values() if isinstance(kind, issues.IssueKind)]
    assert len(kinds) == len(issues.KINDS) > 20


# ---- clusters of misaligned windows


def windows(off: np.ndarray) -> Residual:
    """12 x 9 windows with a spacing of 112 px, some with a shift of 3 px."""
    centres = 112 * grid_px(np.arange(12), np.arange(9)) + 56
    shifts = np.where(off.reshape(-1, 1), [3.0, 0.0], [0.05, 0.0])
    return residual_of(centres, shifts)


def test_a_noisy_window_is_misaligned_only_beyond_its_noise() -> None:
    """A peak of 7 sigma has a noise of 0.98 px: 2 px are then no misalignment, 2.3 px are."""
    for shift_px, expected in ((2.1, []), (2.3, ["close_windows"])):
        noisy = shifted(11, shift_px)
        noisy = replace(noisy, peaks_sigma=np.full(100, 7.0))
        assert [code for code in codes(residual=noisy) if code != "inaccurate"] == expected


def test_aligned_means_an_error_of_half_a_pixel_in_nine_tenths_of_the_image() -> None:
    """The error at each of 100 points is that of the homography: 0.01 px but at some corners."""
    covariance = np.diag(np.repeat([1e-4, 1e-4, 1e-4, 1.2], 2))
    nearly_all = replace(GOOD, joint=joint_result(covariance=np.diag(np.full(8, 0.12))))
    assert codes(nearly_all) == []
    assert codes(replace(nearly_all, joint=joint_result(covariance=np.diag(np.full(8, 0.6))))) == ["inaccurate"]
    residual = residual_of(geometry.lattice(*SIZE, 10, 10), (0.0, 0.0))
    (issue,) = replace(GOOD, joint=joint_result(covariance=covariance), windows=residual).issues
    assert (issue.code, issue.limit) == ("inaccurate", pytest.approx(0.1))
    assert 0.1 < issue.value < 0.6


def test_an_area_without_common_peaks_shows_something_else_but_scattered_windows_do_not() -> None:
    torn, scattered, noisy, corner, strips = (np.zeros((9, 12), bool) for _ in range(5))
    torn[5:] = True
    scattered[::2, ::2] = True
    noisy[:] = np.random.default_rng(0).random((9, 12)) < 0.4
    corner[:3, :3] = True
    strips[:, :2] = strips[:, -2:] = True
    area = ["other_content"]
    for lost, expected in ((torn, area), (scattered, []), (noisy, []), (corner, area), (strips, area)):
        shifts = np.where(lost.reshape(-1, 1), np.nan, 0.0) * np.ones((1, 2))
        residual = residual_of(112 * grid_px(np.arange(12), np.arange(9)) + 56, shifts)
        assert [issue.code for issue in content_issues(residual, 1.0)] == expected


@pytest.mark.parametrize("share", [0.5, 0.625, 0.67, 0.7])
def test_an_area_of_another_place_is_found_in_many_windows(share: float) -> None:
    """384 windows: scattered lost ones are normal at each share, and a block of them at none."""
    lost = np.zeros((16, 24), bool)
    lost[:, : round(share * 24)] = True
    scattered = np.random.default_rng(0).permutation(lost.ravel()).reshape(lost.shape)
    for is_lost, codes in ((lost, ["other_content"]), (scattered, [])):
        shifts = np.where(is_lost.reshape(-1, 1), np.nan, 0.0) * np.ones((1, 2))
        residual = residual_of(112 * grid_px(np.arange(24), np.arange(16)) + 56, shifts)
        assert [issue.code for issue in content_issues(residual, 1.0)] == codes


@pytest.mark.slow
@pytest.mark.parametrize("displaced_px", [60, 90, 120])
def test_a_part_of_the_image_that_is_displaced_is_not_aligned(displaced_px: int) -> None:
    """As of a wall near the camera. 40 % of the windows have no common peak if it is farther than half of a window."""
    fixed, moving = textured_pair(np.eye(3), 640, 480)
    part = np.s_[:, 384:]
    moving[part] = np.roll(moving, displaced_px, axis=0)[part]
    result = agalign.align(fixed, moving)
    assert result.status != "aligned"
    assert geometry.corner_error_px(result.fixed_to_moving, np.eye(3), 640, 480) < 1.0


@pytest.mark.parametrize(("columns", "rows", "lost"), [(11, 8, 2), (6, 5, 3), (6, 4, 3), (7, 5, 3), (5, 4, 2)])
def test_an_area_of_another_place_is_found_in_few_windows(columns: int, rows: int, lost: int) -> None:
    is_lost = np.zeros((rows, columns), bool)
    is_lost[:, -lost:] = True
    shifts = np.where(is_lost.reshape(-1, 1), np.nan, 0.0) * np.ones((1, 2))
    residual = residual_of(112 * grid_px(np.arange(columns), np.arange(rows)) + 56, shifts)
    (issue,) = content_issues(residual, 1.0)
    assert issue.value == pytest.approx(lost / columns)


def test_misaligned_clusters_are_an_issue_but_scattered_and_unmeasured_windows_are_not() -> None:
    scattered, corner, third, none = (np.zeros((9, 12), bool) for _ in range(4))
    scattered[::4, ::3] = True
    scattered[0, 0] = scattered[8, 9] = False
    corner[:2, :3] = True
    third[:, 8:] = True
    unmeasured = windows(none)
    unmeasured.shifts_px[:20] = np.nan
    assert codes(residual=windows(scattered)) == codes(residual=unmeasured) == []
    assert codes(residual=windows(corner)) == ["cluster"]
    assert codes(residual=windows(third)) == ["close_windows", "cluster", "inaccurate"]
    with_gaps = shifted(0, 0.0)
    with_gaps.shifts_px[10:20:2, 0] = 2.0
    assert codes(residual=with_gaps) == []


@pytest.mark.parametrize(("total", "allowed"), [(100, 4), (125, 4), (150, 5), (200, 7)])
def test_the_windows_of_a_cluster_are_counted(total: int, allowed: int) -> None:
    """The limit is five adjacent windows or 4 % of the measured ones, whichever is larger."""
    for count in (allowed, allowed + 1):
        residual = shifted(0, 0.0, total)
        residual.shifts_px[10 : 10 + count, 0] = 2.0
        assert codes(residual=residual) == ([] if count == allowed else ["cluster"]), (total, count)


# ---- repetitive scenes


@pytest.mark.parametrize(("expected_within_px", "codes"), [(np.inf, ["repeats"]), (5.0, []), (-1.0, ["repeats"])])
def test_a_repetitive_scene_is_an_issue_unless_aliases_are_excluded(
    expected_within_px: float, codes: list[str]
) -> None:
    """The images also match with a shift of 16 px along x: every 8 px of images with half the width."""
    rng = np.random.default_rng(0)
    spectrum = np.fft.fft2(np.tile(rng.normal(size=(64, 8)), (1, 8))).astype(np.complex64)
    aliases = alias_peaks(spectrum, spectrum, PixelScale(0.5, 0.25))
    x_px, y_px = aliases[0].shift_px
    assert (abs(x_px) % 16, y_px, x_px == 0) == (0, 0, False)
    issues = list(repetition_issues(aliases, lambda shift_px: float(np.hypot(*shift_px)) <= expected_within_px, 1.0))
    assert [issue.code for issue in issues] == codes
    assert all(issue.value == pytest.approx(abs(x_px)) for issue in issues)


def test_an_expected_alias_is_an_issue_also_if_a_higher_one_is_not_expected() -> None:
    """As in rows with a lattice of plants: the next plant is far from the seed, the next row is not."""
    aliases = [AliasPeak((-32.0, 0.0), 0.93), AliasPeak((0.0, 14.0), 0.82)]
    (issue,) = repetition_issues(aliases, lambda shift_px: np.hypot(*shift_px) <= 15, 0.5)
    assert (issue.code, issue.value) == ("repeats", 28.0), "px of a file of twice the size"
    assert list(repetition_issues(aliases[:1], lambda shift_px: np.hypot(*shift_px) <= 15, 0.5)) == []
    rng = np.random.default_rng(0)
    lattice = np.tile(rng.normal(size=(16, 16)), (4, 4)) + 0.1 * np.tile(rng.normal(size=(64, 16)), (1, 4))
    spectrum = np.fft.fft2(lattice).astype(np.complex64)
    found = alias_peaks(spectrum, spectrum)
    assert {(-32.0, 0.0), (16.0, 0.0), (0.0, -16.0)} <= {peak.shift_px for peak in found}


def test_a_scene_that_repeats_across_a_third_of_the_image_is_repetitive() -> None:
    """Its peak is as much lower as the images overlap less."""
    rng = np.random.default_rng(0)
    three = np.tile(textured_image(80, 240, 1).astype(np.float32), (1, 3))
    fixed, moving = (
        windowed_spectra(
            structure_field(whole(np.float32(three + 0.02 * np.ptp(three) * rng.normal(size=three.shape))))
        )
        for _ in "fm"
    )
    assert {-80.0, 80.0} <= {peak.shift_px[0] for peak in alias_peaks(fixed, moving)}
    once = windowed_spectra(structure_field(whole(textured_image(240, 240, 1))))
    assert alias_peaks(once, once) == []


def test_noise_where_images_overlap_little_is_no_repetition() -> None:
    """As of a thermal band: the peak of the result is low, and that of a repetition would be a quarter of it."""
    rng, scene = np.random.default_rng(0), textured_image(320, 240, 1).astype(np.float32)
    fixed, moving = (
        windowed_spectra(structure_field(whole(np.float32(scene + 1.5 * scene.std() * rng.normal(size=scene.shape)))))
        for _ in "fm"
    )
    surface = correlation_surfaces(fixed, moving)
    assert 15 < surface.max() / surface.std() < 25
    assert alias_peaks(fixed, moving) == []


def test_without_a_peak_of_the_result_the_highest_one_counts_however_low(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = np.random.default_rng(0).uniform(0.0, 0.1, (40, 60)).astype(np.float32)
    surface[16:25, 26:35] = -1.0
    surface[5, 40] = 0.15
    monkeypatch.setattr(checks, "correlation_surfaces", lambda *_: np.fft.ifftshift(surface))
    (alias,) = alias_peaks(np.ones((40, 60), np.complex64), np.ones((40, 60), np.complex64))
    assert math.isinf(alias.ratio)


def layer_in(moving: np.ndarray) -> Layer | None:
    """The second layer of a moving image of SCENE."""
    windows = FixedWindows(np.ones(SCENE.shape, bool), structure_field(whole(SCENE)))
    return second_layer(centred_correlation(windows.correlated(whole(np.float32(moving)))[1]))


SCENE = textured_image(480, 360, 4).astype(np.float32)
ROWS = np.indices(SCENE.shape)[1] % 40 < 12
"""Three tenths of the image, in strips that are narrower than a window."""


@pytest.mark.parametrize("shift_px", [(2.0, 0.0), (0.0, -5.0), (-3.0, 3.0)])
def test_strips_that_are_displaced_within_the_windows_are_a_second_layer(shift_px: tuple[float, float]) -> None:
    displaced = cv2.warpAffine(SCENE, geometry.translation(*shift_px)[:2], SCENE.shape[::-1], flags=cv2.INTER_CUBIC)
    layer = layer_in(-np.where(ROWS, displaced, SCENE))
    assert 0.2 < layer.share < 0.5
    assert np.dot(layer.shift_px, shift_px) > 0.9 * np.hypot(*layer.shift_px) * np.hypot(*shift_px)
    (issue,) = layer_issues(layer, 0.5)
    assert (issue.code, issue.limit) == ("second_layer", layer.max_share)
    assert issue.detail == f"{2 * np.hypot(*layer.shift_px):.0f} px", "of a file of twice the size"


def test_noise_raises_the_limit_of_a_second_layer() -> None:
    displaced = cv2.warpAffine(SCENE, geometry.translation(0.0, -5.0)[:2], SCENE.shape[::-1], flags=cv2.INTER_CUBIC)
    layers = np.where(ROWS, displaced, SCENE)
    noise = np.random.default_rng(0).normal(0, 0.3 * SCENE.std(), SCENE.shape)
    assert layer_in(layers).share > layer_in(layers).max_share
    assert layer_in(layers + noise).max_share > layer_in(layers).max_share


def test_one_layer_is_symmetric_whatever_it_shows() -> None:
    noise = np.random.default_rng(0).normal(0, 0.5 * SCENE.std(), SCENE.shape)
    nearly = cv2.warpAffine(SCENE, geometry.translation(0.3, 0.0)[:2], SCENE.shape[::-1], flags=cv2.INTER_CUBIC)
    blurred = cv2.GaussianBlur(SCENE, (0, 0), 2.0)
    y, x = np.indices(SCENE.shape, np.float32)
    bent = cv2.remap(SCENE, x + 0.5 * np.sin(x / 50), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    for moving in (SCENE, SCENE + noise, nearly, bent, blurred, np.where(ROWS, 0, SCENE), noise, np.zeros_like(SCENE)):
        assert layer_in(moving) is None


PERIOD = 26.0
TRUTH = geometry.translation(9.0, -6.0)


def planted(shift: tuple[float, float], seed: int, sign: float = 1.0) -> np.ndarray:
    """Two images (300, 400) of plants on a grid, from different positions, with independent noise."""
    y, x = np.mgrid[:300, :400].astype(np.float64)
    across, along = (np.cos(2 * np.pi * (v - s) / PERIOD) for v, s in zip((x, y), shift, strict=True))
    plants = np.exp(3 * (across + along) - 6)
    noise = np.random.default_rng(seed).normal(size=plants.shape)
    return (sign * plants / plants.std() + 0.1 * noise).astype(np.float32)


def test_a_unique_scene_has_no_alias_peak(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "MAX_ALIAS_PEAK", 0.4)
    image = texture(400, 300)
    views = image, whole(cv2.GaussianBlur(-image.pixels, (0, 0), 0.7))
    assert alias_peaks(*(windowed_spectra(structure_field(view)) for view in views)) == []


IMAGES = planted((0, 0), 1), planted((9.0, -6.0), 2, -0.7)


def test_a_repetitive_scene_without_prior_information_is_not_aligned() -> None:
    result = agalign.align(*IMAGES, seed=geometry.compose(TRUTH, geometry.translation(PERIOD, 0.0)))
    assert result.status != "aligned"
    assert result.issues[0].code == "repeats"
    assert "px fits nearly as well" in (result.reason or "")


def test_a_seed_with_an_error_below_half_a_period_resolves_aliases() -> None:
    near = geometry.compose(TRUTH, geometry.translation(3.0, 2.0))
    result = agalign.align(*IMAGES, seed=near, seed_std_px=3.0)
    assert result.status == "aligned"
    assert geometry.corner_error_px(result.fixed_to_moving, TRUTH, 400, 300) < 1.0


# ---- seeds and unchanged inputs


@pytest.mark.parametrize(("coverage", "median_px", "fits"), [(0.3, 8.0, True), (0.29, 8.0, False), (0.3, 8.1, False)])
def test_a_seed_fits_up_to_its_limits(coverage: float, median_px: float, fits: bool) -> None:
    assert seed_fits(measured_in(coverage, median_px)) == fits


def test_one_window_of_many_does_not_confirm_a_seed() -> None:
    """A small image has no more than four."""
    for count, total, fits in ((1, 3, False), (3, 3, True), (4, 12, False), (5, 12, True)):
        shifts_px = np.where(np.arange(total)[:, None] < count, (3.0, 0.0), np.nan)
        assert seed_fits(residual_of(np.zeros((total, 2)), shifts_px)) == fits, (count, total)


@pytest.mark.parametrize("magnification", [0.5, 1.0, 3.0])
@pytest.mark.parametrize(("std_px", "limit_px"), [(0.5, 0.25), (0.03 / 2**0.5, 0.09), (0.01, 3 * 0.01 * 2**0.5)])
def test_an_input_is_unchanged_within_three_standard_errors_and_a_quarter_of_a_pixel(
    magnification: float, std_px: float, limit_px: float
) -> None:
    """Of the fixed image, whatever the scale of the moving one."""
    given = np.diag([magnification, magnification, 1.0])
    for shift_px, expected in ((0.98 * limit_px, True), (1.02 * limit_px, False)):
        mapping = geometry.compose(given, geometry.translation(shift_px, 0.0))
        assert is_unchanged(joint_result(mapping, std_px=std_px), given, SIZE) == expected
    # The limit is in px of the file: in an image reduced to a third it is a third as large.
    within = joint_result(geometry.translation(0.1, 0.1), std_px=0.07)
    assert is_unchanged(within, np.eye(3), SIZE)
    assert not is_unchanged(within, np.eye(3), SIZE, scale=1 / 3)
