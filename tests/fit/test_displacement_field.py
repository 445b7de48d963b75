from dataclasses import replace

import numpy as np
import pytest

from agalign.fit import displacement_field
from agalign.fit.displacement_field import DisplacementEstimator, _are_decreased, common_field, fitted_field
from agalign.fit.held_out import every_nth, held_out, one_by_one
from agalign.fit.windows import Shifts
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.residual import Residual

from ..builders import displaced_views, grid_px, residual_of, rms, texture, whole

SIZE = 640, 480
CENTRES = grid_px(np.arange(32, 640, 32), np.arange(32, 480, 32))


def bump(points: np.ndarray, height: float = 1.5) -> np.ndarray:
    """A smooth displacement with its maximum at (300, 220)."""
    fall = np.exp(-(((points - (300, 220)) / 90) ** 2).sum(-1))
    return height * fall[..., None] * np.array([1.0, -0.6])


def test_a_smooth_field_is_fitted_despite_noise_and_wrong_peaks() -> None:
    rng = np.random.default_rng(0)
    shifts = bump(CENTRES) + 0.08 * rng.normal(size=CENTRES.shape)
    wrong = rng.random(len(CENTRES)) < 0.05
    shifts[wrong] += rng.uniform(-20, 20, (wrong.sum(), 2))
    field = fitted_field(Shifts.of(residual_of(CENTRES, shifts)), 1.0, 48, SIZE)
    assert rms(field(CENTRES) - bump(CENTRES)) < 0.09


def test_the_field_vanishes_far_from_all_measurements() -> None:
    near = CENTRES[CENTRES[:, 0] < 200]
    field = fitted_field(Shifts.of(residual_of(near, (2.0, 0.0))), 1.0, 48, (6400, 480))
    assert field(np.array([[100.0, 240.0]]))[0, 0] == pytest.approx(2.0, abs=0.05)
    assert abs(field(np.array([[6000.0, 240.0]]))[0]).max() < 0.2


def test_the_given_field_continues_where_no_window_is() -> None:
    """Half of the image has no texture; the lenses displace by 1.5 px there too, which no window shows."""
    lenses = DisplacementField.sampled(lambda points: np.full_like(points, 1.5), 48, SIZE)
    fixed, moving = displaced_views(lambda points: bump(points, 0.8) + np.where(points[..., :1] > -1e9, 1.5, 0))
    known = fixed.valid & (np.arange(SIZE[0]) < 340)
    estimator = DisplacementEstimator(known, structure_field(replace(fixed, valid=known)))
    found = estimator.refine(moving, PixelMapping(np.eye(3), field=lenses)).field
    np.testing.assert_allclose(found(np.array([[600.0, 100.0], [600.0, 400.0]])), 1.5, atol=0.1)
    near = np.array([[300.0, 220.0]])
    np.testing.assert_allclose(found(near), bump(near, 0.8) + 1.5, atol=0.2)


def test_a_field_that_folds_the_image_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, moving = displaced_views(bump)
    estimator, mapping = DisplacementEstimator(fixed.valid, structure_field(fixed)), PixelMapping(np.eye(3))
    assert estimator.refine(moving, mapping).field is not None
    steep = np.zeros((21, 28, 2))
    steep[:, 10, 0] = -60
    monkeypatch.setattr(displacement_field, "fitted_field", lambda *_: DisplacementField(24.0, steep))
    assert estimator.refine(moving, mapping).field is None


def test_the_p95_before_and_after_a_field_are_over_the_same_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those near the bump lack a prediction, as by too few neighbours."""
    fixed, moving = displaced_views(bump)
    estimator = DisplacementEstimator(fixed.valid, structure_field(fixed))
    assert estimator.refine(moving, PixelMapping(np.eye(3))).before.p95_px > 0.9

    zero = DisplacementField(24.0, np.zeros((21, 28, 2)))

    def far_from_bump(held_out_px: np.ndarray, _shifts: Shifts) -> DisplacementField | None:
        return None if (np.linalg.norm(held_out_px - (300, 220), axis=1) < 200).any() else zero

    monkeypatch.setattr(estimator, "_field_apart_from", far_from_bump)
    monkeypatch.setattr(displacement_field, "every_nth", lambda residual, _: one_by_one(residual))
    assert estimator.refine(moving, PixelMapping(np.eye(3))).before.p95_px < 0.3


def test_without_windows_there_is_no_p95() -> None:
    fixed, moving = displaced_views(bump)
    estimator = DisplacementEstimator(fixed.valid, structure_field(fixed))
    assert estimator.refine(whole(np.zeros_like(moving.pixels)), PixelMapping(np.eye(3))) is None


def of_captures(count: int, height: float, seed: int) -> list[Residual]:
    """Windows of several captures with a common bump and independent noise."""
    rng = np.random.default_rng(seed)
    shifts = [bump(CENTRES, height) + 0.1 * rng.normal(size=CENTRES.shape) for _ in range(count)]
    return [residual_of(CENTRES, s) for s in shifts]


def test_the_common_field_of_captures_is_that_of_the_lenses() -> None:
    field = common_field(of_captures(6, 0.4, 1), SIZE)
    at = geometry.lattice(*SIZE, 17, 13)
    assert rms(field(at) - bump(at, 0.4)) < 0.5 * rms(bump(at, 0.4))
    assert common_field(of_captures(6, 0.0, 1), SIZE) is None
    assert common_field(of_captures(2, 0.4, 1), SIZE) is None
    # Displacements that differ between captures are not caused by the lenses.
    own = [of_captures(1, height, seed)[0] for seed, height in enumerate((0.4, -0.4, 0.4, -0.4))]
    assert common_field(own, SIZE) is None


def test_smoothness_is_relative_to_the_number_of_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Smoothness is per capture: fits without a fold must not be smoother than the final one."""
    fits: list[tuple[int, float]] = []

    def recorded(shifts: Shifts, smoothness: float, *rest: object) -> DisplacementField:
        fits.append((len(shifts.weights) // len(CENTRES), smoothness))
        return fitted_field(shifts, smoothness, *rest)

    monkeypatch.setattr(displacement_field, "fitted_field", recorded)
    assert common_field(of_captures(5, 0.4, 1), SIZE) is not None
    assert {count for count, _ in fits} == {3, 4, 5}
    assert {smoothness / count for count, smoothness in fits} <= {1.0, 4.0, 16.0, 64.0}


def test_a_field_without_held_out_windows_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single textured patch has windows to fit, and none at a distance from them."""
    monkeypatch.setattr(DisplacementEstimator, "_field_apart_from", lambda *_: None)
    image = texture(*SIZE)
    result = DisplacementEstimator(image.valid, structure_field(image)).refine(image, PixelMapping(np.eye(3)))
    assert (result.field, result.held_out.p95_px) == (None, np.inf)


def test_a_field_that_clearly_increases_p95_is_rejected() -> None:
    before_px, most_px = np.r_[np.full(90, 0.4), np.full(10, 1.59)], np.full(90, 0.1)
    for after_p95_px, is_decreased in ((1.62, True), (1.69, False)):
        assert _are_decreased(before_px, np.r_[most_px, np.full(10, after_p95_px)]) == is_decreased
    assert not _are_decreased(before_px, before_px)


# ---- what fits noise cannot pass


@pytest.mark.parametrize("chance", range(3))
def test_a_field_fitted_to_noise_does_not_predict_held_out_windows(chance: int) -> None:
    """Random shifts: a field fits them, but does not predict others."""
    rng = np.random.default_rng(chance)
    shifts = rng.uniform(-4, 4, CENTRES.shape)
    image = texture(*SIZE)
    estimator = DisplacementEstimator(image.valid, structure_field(image))
    residual = residual_of(CENTRES, shifts)
    measured = Shifts.of(residual)
    field = fitted_field(measured, 0.001, 24, SIZE)
    explained, given = (np.linalg.norm(v, axis=1) for v in (shifts - field(CENTRES), shifts))
    assert np.median(explained) < 0.8 * np.median(given)
    folds, start = every_nth(residual, 4), PixelMapping(np.eye(3))
    of_folds = (CENTRES[folds.numbers == fold] for fold in range(folds.count))
    by_fold = [replace(start, field=estimator._field_apart_from(of_fold, measured)) for of_fold in of_folds]
    assert held_out(residual, start, folds, by_fold).median_px > 0.95 * np.median(given)


def test_a_field_has_the_prior_of_its_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows with low peaks, of blurred images, determine less of a field than those with high ones."""
    fixed, moving = displaced_views(lambda points: bump(points, 0.4))
    estimator = DisplacementEstimator(fixed.valid, structure_field(fixed))
    sharp = estimator.refine(moving, PixelMapping(np.eye(3))).field
    monkeypatch.setattr(displacement_field, "_NOISE_PX", 0.002)
    smooth = estimator.refine(moving, PixelMapping(np.eye(3))).field
    curvature = [np.abs(np.diff(f.displacements_px, n=2, axis=0)).mean() for f in (sharp, smooth)]
    assert curvature[1] < 0.5 * curvature[0]
