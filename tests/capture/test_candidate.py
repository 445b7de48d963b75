"""Candidates by descriptors: a homography, and a displacement field where windows require and confirm it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agalign.capture import align_bands
from agalign.capture import candidate as module
from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand, mapping_error
from agalign.capture.warped_pair import WarpedPair
from agalign.fit.displacement_field import DisplacementResult
from agalign.fit.held_out import chessboard
from agalign.flight.model import FlightModel
from agalign.method.descriptor import Descriptor
from agalign.method.joint import Results
from agalign.method.state import ImageGroup
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Seed
from agalign.values.choices import ReliefUse
from agalign.values.geometry import Matrix
from agalign.values.issues import INACCURATE, REPEATS, RETRIEVAL, SECOND_LAYER, Issue, IssueKind
from agalign.values.mapping import DisplacementField

from ..builders import (
    decided,
    displaced_views,
    estimation_of,
    joint_result,
    pair_of,
    residual_of,
    texture,
    two_views,
    whole,
)

TRUTH = geometry.translation(6, -4)
SEED = Seed("rig", geometry.translation(5, -3), 30.0, 30.0, 5.0, trusted=True)
CENTRED = replace(SEED, fixed_to_moving=np.eye(3))
RIG = {"rig": SEED.fixed_to_moving}
GOOD = joint_result(TRUTH)


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*two_views(TRUTH), RIG)


def aligned(
    pair: BandPair, joint: JointResult, use: ReliefUse, seed: Seed = SEED, by_fold: Sequence[Matrix] = ()
) -> Alignment:
    """The alignment of a band by the result of the joint optimisation."""
    return decided(pair, seed, replace(RefinedBand.of(pair, seed, joint), by_fold=by_fold).candidates(use))


def test_pixels_are_checked_only_where_the_other_checks_pass(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    """These checks are costly."""
    monkeypatch.setattr(WarpedPair, "issues", (Issue(REPEATS, 16.0),))
    warped_pair = WarpedPair.of(pair, pair.mapping(TRUTH))
    unretrieved = module.Candidate.of(warped_pair, replace(GOOD, retrieval=0.0))
    assert [issue.kind for issue in unretrieved.issues] == [RETRIEVAL]
    assert [issue.kind for issue in module.Candidate.of(warped_pair, GOOD).issues] == [REPEATS]


def test_a_further_issue_never_improves_a_status(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repetitive scene prevents a prediction, also where another check fails first."""
    warped_pair = WarpedPair.of(pair, pair.mapping(TRUTH))
    inaccurate = replace(GOOD, corner_std_xy_px=((3.0, 3.0),) * 4)
    for found, may_predict in (((), True), ((Issue(REPEATS, 16.0),), False)):
        monkeypatch.setattr(WarpedPair, "issues", found)
        candidate = module.Candidate.of(warped_pair, inaccurate)
        assert [issue.kind for issue in candidate.issues] == [INACCURATE]
        assert candidate.may_predict is may_predict


def test_the_lens_field_of_the_rig_does_not_continue_by_chance(pair: BandPair) -> None:
    lens = DisplacementField.sampled(lambda points: 0.01 * points, 48, pair.fixed.size_px)
    with_rig = replace(pair, field=lens)
    for one, spread_px in ((with_rig, 0.0), (pair, 1.0)):
        mapping = replace(pair.mapping(TRUTH), field=lens)
        error = mapping_error(one, mapping, np.eye(8), WarpedPair.of(pair, mapping).residual)
        assert error.field_std_px == pytest.approx(spread_px, abs=0.5)
        assert (error.field_std_px == 0) == (spread_px == 0)


def test_each_colour_is_verified_by_the_estimate_from_the_other(pair: BandPair) -> None:
    warped_pair = WarpedPair.of(pair, pair.mapping(TRUTH))
    by_black, by_white = geometry.translation(6.1, -4), geometry.translation(6, -4.2)
    crossed, before = warped_pair.cross_validated((by_white, by_black)).residual, warped_pair.residual
    expected_px = np.where(chessboard(before).numbers[:, None] == 0, (0, 0.2), (-0.1, 0))
    np.testing.assert_allclose(crossed.shifts_px - before.shifts_px, expected_px, atol=1e-6)
    assert aligned(pair, GOOD, "never", by_fold=(by_white, by_black)).residual.median_px > 0.08


@pytest.mark.parametrize("kind", ["noise", "structure"])
def test_an_unrelated_image_is_not_aligned_by_a_seed_or_a_field(kind: str) -> None:
    noise = np.random.default_rng(3).normal(size=(320, 400)).astype(np.float32)
    pair = pair_of(texture(), whole(noise) if kind == "noise" else texture(seed=9), RIG)
    failed = aligned(pair, joint_result(retrieval=0.01), "always")
    assert failed.status == "failed"
    assert failed.reason.endswith("but the seed does not fit either")
    results = aligned(pair, joint_result(SEED.fixed_to_moving), "always")
    assert results.status not in ("aligned", "predicted")
    assert results.geometry == "homography"


def test_verification_is_repeated_with_a_displacement_field(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A field that leaves the windows misaligned must not be accepted."""
    wild = np.zeros((11, 14, 2))
    wild[..., 0] = 3.0
    centres_px = pair.windows.centres_px
    before, held_out = (residual_of(centres_px, (shift_px, 0.0)) for shift_px in (1.0, 0.5))
    result = DisplacementResult(DisplacementField(32.0, wild), before, held_out)
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_, **__: result)
    results = aligned(pair, GOOD, "always")
    assert (results.status, results.geometry) == ("aligned", "homography")
    assert results.held_out_p95_px == {"homography": 1.0, "field": 0.5}
    assert results.residual.median_px < 0.1
    monkeypatch.setattr(module, "issues_of", lambda *_: ())
    assert aligned(pair, GOOD, "always").geometry == "field"


def test_a_field_that_its_held_out_windows_reject_does_not_replace_a_verified_homography(
    pair: BandPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The windows of the homography say nothing about it."""
    windows = WarpedPair.of(pair, pair.mapping(TRUTH)).residual
    rejected = windows.with_shifts(windows.shifts_px + 1.5)
    result = DisplacementResult(DisplacementField(32.0, np.full((11, 14, 2), 0.2)), windows, rejected)
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_: result)
    results = aligned(pair, GOOD, "always")
    assert (results.status, results.geometry) == ("aligned", "homography")
    np.testing.assert_array_equal(results.fixed_to_moving, TRUTH)


def displaced_pair(height_px: float, wavelength_px: float | None = None) -> BandPair:
    """A pair with a smooth bump in the centre or waves everywhere, which no homography represents."""

    def displacement(points: np.ndarray) -> np.ndarray:
        bump = np.exp(-(((points - (320, 240)) / 110) ** 2).sum(-1))
        form = bump if wavelength_px is None else np.prod(np.sin(2 * np.pi * points / wavelength_px), axis=-1)
        return height_px * form[..., None] * np.array([1.0, -0.6])

    return pair_of(*displaced_views(displacement), {"rig": np.eye(3)})


def test_a_band_that_descriptors_do_not_align_where_the_tags_contradict_is_tried_at_the_tags(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    far = replace(CENTRED, kind="structure", fixed_to_moving=geometry.translation(90.0, 0.0))
    band = BandCandidates(replace(displaced_pair(0.0), seed_std_px={"rig": 5.0}), far)
    tried: list[float] = []

    def refined(net: Descriptor, group: ImageGroup, *_: object) -> Results:
        tried.append(group.moving[0].fixed_to_moving[0, 2])
        return {"moving": Issue(RETRIEVAL, 0.0, 0.2)}

    monkeypatch.setattr(align_bands, "refine_with", refined)
    monkeypatch.setattr(align_bands, "corrected", lambda *_: None)
    model = FlightModel(None, None, ("reference", "moving"), {}, "")
    replace(estimation_of(band), model=model)._refine()
    assert tried == [90.0, 0.0]


@pytest.mark.parametrize("later", [Issue(RETRIEVAL, 0.0, 0.2), joint_result(retrieval=0.05)])
def test_a_later_optimisation_that_retrieves_nothing_does_not_replace_an_earlier_one(
    later: JointResult | Issue,
) -> None:
    """The band still takes part in the estimation of the others."""
    estimation = estimation_of(BandCandidates(displaced_pair(0.0), CENTRED))
    for result in (joint_result(), later):
        estimation.add({"moving": result})
    (band,) = estimation.refined
    assert band.joint.retrieval == joint_result().retrieval
    assert estimation.bands["moving"].issue is None  # the later one does not explain the earlier result
    assert len(estimation.bands["moving"].candidates) == 2
    estimation.add({"moving": joint_result(retrieval=0.7)})
    assert estimation.refined[0].joint.retrieval == 0.7


@pytest.mark.parametrize(
    ("displaced", "use", "status", "geometry"),
    [
        ((4.0,), "auto", "aligned", "field"),
        ((4.0,), "always", "aligned", "field"),
        ((4.0,), "never", "predicted", "homography"),
        # Shorter waves are not predicted without the windows that overlap one of verification.
        ((2.5, 300.0), "auto", "aligned", "field"),
    ],
)
def test_a_field_is_fitted_where_a_part_of_the_image_is_misaligned(
    displaced: tuple[float, ...], use: ReliefUse, status: str, geometry: str
) -> None:
    results = aligned(displaced_pair(*displaced), joint_result(), use, CENTRED)
    assert (results.status, results.geometry) == (status, geometry)
    if status == "aligned":  # the residual is that of held-out windows
        assert results.residual.median_px < (0.1 if displaced == (4.0,) else 0.4)


@pytest.mark.parametrize(("is_lens_known", "tried"), [(True, False), (False, True)])
def test_a_field_is_tried_where_no_rig_contains_the_lenses_and_rejected_without_need(
    is_lens_known: bool, tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rig may contain the band without its lenses, where windows miss a part of the image in all captures."""
    pair = replace(displaced_pair(0.0), seed_std_px={"model": 1.0}, is_lens_known=is_lens_known)
    estimator, fields = pair.reference.displacement_field, list[DisplacementField | None]()
    refine = estimator.refine

    def recorded(*arguments: Any) -> DisplacementResult:
        result = refine(*arguments)
        fields.append(result.field)
        return result

    monkeypatch.setattr(estimator, "refine", recorded)
    plain = aligned(pair, joint_result(), "auto", CENTRED)
    assert (plain.status, plain.geometry, fields) == ("aligned", "homography", [None] * tried)


@pytest.mark.parametrize(("kind", "is_tried"), [(SECOND_LAYER, True), (REPEATS, False)])
def test_with_a_rig_a_field_is_tried_only_where_parallax_may_cause_what_the_pixels_show(
    kind: IssueKind, is_tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(WarpedPair, "issues", (Issue(kind, 20.0),))
    tried: list[Candidate] = []
    monkeypatch.setattr(module, "_with_field", lambda plane, *_, **__: tried.append(plane) or iter([plane]))
    pair = replace(pair_of(*two_views(TRUTH), {"model": TRUTH}, model=1.0), is_lens_known=True)
    aligned(pair, GOOD, "auto")
    assert bool(tried) is is_tried


def test_issues_that_a_field_cannot_remove_are_reported() -> None:
    """A third of the image 15 px off."""
    fixed, moving = two_views(TRUTH)
    moving.pixels[:, 270:] = np.roll(moving.pixels, 15, axis=0)[:, 270:]
    results = aligned(pair_of(fixed, moving, RIG), GOOD, "auto")
    assert results.status != "aligned"
    assert {"close_windows", "cluster"} & {d.code for d in results.issues}
    assert "of the windows" in results.reason


def test_a_field_is_verified_in_held_out_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field may fit any shifts of its own windows."""
    pair = displaced_pair(2.5)
    good = pair.reference.displacement_field.refine(pair.moving_image, pair.mapping(np.eye(3)))
    accepted = aligned(pair, joint_result(), "always", CENTRED)
    assert accepted.status == "aligned"
    np.testing.assert_array_equal(accepted.residual.shifts_px, good.held_out.shifts_px)
    misaligned = good.held_out.with_shifts(good.held_out.shifts_px + 1.5)
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_: replace(good, held_out=misaligned))
    refused = aligned(pair, joint_result(), "always", CENTRED)
    assert (refused.status, refused.geometry) == ("predicted", "homography")
    assert refused.prediction.std_px < good.held_out.median_px + 1.5
