"""`decide` on candidates that are made by hand: which mapping a band gets, its status and its standard error."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from agalign.capture import decision
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.by_relief import UnderRelief
from agalign.capture.by_rig import RigPrediction
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand, mapping_error
from agalign.capture.decision import decide
from agalign.capture.reference import Reference
from agalign.values import geometry
from agalign.values.alignment import BY_WINDOWS, Alignment, Prediction, Seed
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.issues import (
    CLOSE_WINDOWS,
    FEW_KEYPOINTS,
    OTHER_CONTENT,
    RETRIEVAL,
    SECOND_LAYER,
    SEED_ASKED_FOR,
    SEED_DOES_NOT_FIT,
    Issue,
)
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.residual import Residual
from agalign.verify.checks import Layer
from agalign.verify.coverage import pixels_in_frame

from ..builders import decided, joint_result, pair_of, residual_of, rms, two_views

SIZE = 400, 320
TRUTH = geometry.translation(6, -4)
SEED = Seed("rig", geometry.translation(5, -3), 30.0, 30.0, 5.0, trusted=True)
FAR = replace(SEED, fixed_to_moving=geometry.translation(150, 0))
RIG = {"rig": SEED.fixed_to_moving}
LOST = Issue(RETRIEVAL, 0.1, 0.2)
IN_PART = Issue(CLOSE_WINDOWS, 0.8, 0.9, "1 px")


@cache
def pair(name: str = "NIR") -> BandPair:
    """A pair with the same reference, whatever its name."""
    return replace(_pair(), name=name)


@cache
def _pair() -> BandPair:
    return pair_of(*two_views(TRUTH, *SIZE), RIG)


def windows(shift_px: float = 0.0) -> Residual:
    return residual_of(geometry.lattice(*SIZE, 12, 9), (shift_px, 0.0))


def candidate(
    name: str = "NIR",
    *,
    matrix: Matrix = TRUTH,
    std_px: float = 0.05,
    shift_px: float = 0.0,
    relief: Relief | None = None,
    **facts: object,
) -> Candidate:
    """A mapping with this standard error at the corners, and with windows that all have this shift."""
    parallax = None if relief is None else Parallax(relief, (1.0, 0.0))
    mapping, joint = pair().mapping(matrix).with_parallax(parallax), joint_result(matrix, std_px=std_px)
    error = mapping_error(pair(name), mapping, joint.covariance_px2, windows(shift_px))
    return replace(Candidate(pair(name), mapping, error, windows(shift_px), joint), **facts)


def in_part(std_px: float = 0.05, issue: Issue = IN_PART, **facts: object) -> Candidate:
    """A mapping that the images confirm in a part of the image."""
    return candidate(std_px=std_px, given_issues=(issue,), **facts)


def unconfirmed(**facts: object) -> Candidate:
    """A mapping that held-out descriptors do not confirm."""
    return candidate(joint=joint_result(retrieval=0.1), **facts)


def rig_prediction(
    matrix: Matrix = TRUTH, std_px: float = 0.3, rotated: Matrix | None = None, of: BandPair | None = None
) -> RigPrediction:
    """A prediction by the rig, and what landmarks find of an image that is rotated relative to it."""
    prediction = Prediction(matrix, "bands", std_px)
    result = RigPrediction(of or pair(), prediction)
    vars(result)["rotated"] = rotated  # else found in the images
    return result


def against(of_rig: RigPrediction, *candidates: Candidate) -> Alignment:
    """The alignment of a band with these candidates, and with a prediction by the rig."""
    return decide([BandCandidates(pair(), SEED, None, list(candidates))], (), {"NIR": of_rig})["NIR"]


def rms_error_px(alignment: Alignment, moving_size_px: tuple[int, int] = SIZE) -> float:
    inside = pixels_in_frame(alignment.mapping, SIZE, moving_size_px)
    return float(np.sqrt(np.square(alignment.error_map_px[inside]).mean()))


# ---- without a relief and a rig


@dataclass(frozen=True)
class Case:
    candidates: Iterable[Candidate]
    status: str
    matrix: Matrix
    issues: tuple[str, ...] = ()
    seed: Seed = SEED
    issue: Issue | None = None


NEAR, AWAY = geometry.translation(6.1, -4), geometry.translation(6.2, -4)
CASES = {
    "aligned": lambda: Case([candidate()], "aligned", TRUTH),
    "the last that passes": lambda: Case([candidate(), candidate(matrix=NEAR), unconfirmed()], "aligned", NEAR),
    "the more certain prediction": lambda: Case(
        [in_part(0.4), in_part(0.2, matrix=NEAR), in_part(0.3, matrix=AWAY)], "predicted", NEAR, ("close_windows",)
    ),
    "by windows that are off": lambda: Case(
        [candidate(shift_px=1.5)], "predicted", TRUTH, ("close_windows", "cluster", "inaccurate")
    ),
    "one that passes before a prediction": lambda: Case([candidate(), in_part(0.001, matrix=NEAR)], "aligned", TRUTH),
    "no prediction of an unknown error": lambda: Case(
        [in_part(np.inf)], "seed_only", SEED.fixed_to_moving, ("close_windows",)
    ),
    "the seed": lambda: Case([unconfirmed()], "seed_only", SEED.fixed_to_moving, ("retrieval",)),
    "the seed without a result": lambda: Case([], "seed_only", SEED.fixed_to_moving, ("retrieval",), issue=LOST),
    "the seed without any candidate": lambda: Case([], "seed_only", SEED.fixed_to_moving, ("other_geometry",)),
    "an untrusted seed": lambda: Case(
        [unconfirmed()], "failed", SEED.fixed_to_moving, ("retrieval",), replace(SEED, trusted=False)
    ),
    "a seed that does not fit": lambda: Case(
        [unconfirmed()], "failed", FAR.fixed_to_moving, ("retrieval", "seed_does_not_fit"), FAR
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_first_row_of_the_table_that_applies(name: str) -> None:
    case = CASES[name]()
    result = decided(pair(), case.seed, case.candidates, case.issue)
    assert (result.status, tuple(issue.code for issue in result.issues)) == (case.status, case.issues)
    np.testing.assert_array_equal(result.fixed_to_moving, case.matrix)
    assert (result.error is not None) == (case.status in ("aligned", "predicted"))
    if result.prediction is not None:
        assert result.prediction.source == "windows"
        assert result.prediction.std_px == pytest.approx(rms_error_px(result), abs=6e-5)
    if result.error is None:
        assert np.isinf(rms_error_px(result))
        assert np.isinf(result.error_map_px).all()


@pytest.mark.parametrize(
    ("issues", "is_predicted", "is_seed_usable", "status"),
    [
        ((), True, True, "aligned"),
        ((LOST,), True, True, "predicted"),
        ((LOST,), False, True, "seed_only"),
        ((LOST,), False, False, "failed"),
    ],
)
def test_the_status_is_that_of_the_first_row_that_applies(
    issues: tuple[Issue, ...], is_predicted: bool, is_seed_usable: bool, status: str
) -> None:
    prediction = Prediction(TRUTH, "windows", 0.1) if is_predicted else None
    result = decided(pair(), SEED, (), LOST)
    assert replace(result, issues=issues, prediction=prediction, is_seed_usable=is_seed_usable).status == status


def test_a_trusted_seed_that_does_not_fit_the_windows_is_not_usable() -> None:
    assert decided(pair(), SEED, (), LOST).status == "seed_only"
    result = decided(pair(), FAR, (), LOST)
    assert (result.status, result.issues) == ("failed", (LOST, Issue(SEED_DOES_NOT_FIT)))
    assert "rig seed is used unchanged, but the seed does not fit either" in result.reason
    untrusted = decided(pair(), replace(SEED, trusted=False), (), LOST)
    assert (untrusted.status, untrusted.issues) == ("failed", (LOST,))


def test_a_seed_that_contradicts_the_tags_is_replaced_by_their_mapping() -> None:
    """An image of another capture fits at its own position, far from that of its band."""
    far, asked_for = replace(FAR, kind="match"), Issue(SEED_ASKED_FOR)
    tagged = replace(pair(), seed_std_px={"rig": 5.0})
    result = decided(tagged, far, (), LOST)
    assert (result.status, result.seed.kind) == ("seed_only", "rig")
    np.testing.assert_array_equal(result.fixed_to_moving, RIG["rig"])
    assert decided(pair(), far, (), LOST).seed == far
    assert decided(tagged, far, (), asked_for).seed == far
    assert decided(pair(), replace(SEED, trusted=False), (), asked_for).status == "seed_only"


def test_the_seed_of_a_result_is_the_one_that_it_was_estimated_from() -> None:
    """Descriptors start at the seed that was found, also where the tags contradict it."""
    tagged = replace(pair(), seed_std_px={"rig": 1.0})
    by_windows = replace(candidate(), joint=replace(joint_result(TRUTH), recipe=BY_WINDOWS))
    for chosen, seed in ((candidate(), FAR), (by_windows, SEED)):
        result = decided(tagged, FAR, [chosen])
        assert (result.status, result.seed.fixed_to_moving.tolist()) == ("aligned", seed.fixed_to_moving.tolist())
    under = replace(candidate(relief=flat_relief()), joint=by_windows.joint)
    refined = RefinedBand.of(tagged, SEED, joint_result(TRUTH))
    result = decide([BandCandidates(tagged, FAR, refined=refined)], [{"NIR": under}])["NIR"]
    assert (result.geometry, result.seed.fixed_to_moving.tolist()) == ("relief", FAR.fixed_to_moving.tolist())


def test_of_tags_with_the_same_standard_error_the_preferred_one_replaces_a_seed() -> None:
    tags: SeedMatrices = {"rig": RIG["rig"], "centre": np.eye(3)}
    tagged = replace(pair(), seed_matrices=tags, seed_std_px={"rig": 5.0, "centre": 5.0})
    assert decided(tagged, replace(FAR, kind="match"), (), LOST).seed.kind == "rig"
    certain = replace(tagged, seed_std_px={"rig": 5.0, "centre": 4.0})
    assert decided(certain, replace(FAR, kind="match"), (), LOST).seed.kind == "centre"


def test_the_p95_of_an_estimate_that_is_not_chosen_is_not_recorded() -> None:
    first = candidate(shift_px=1.5, held_out_p95_px={"homography": 2.0, "field": 1.8})
    chosen = candidate(held_out_p95_px={"homography": 0.4})
    assert decided(pair(), SEED, [first, chosen]).held_out_p95_px == {"homography": 0.4}
    assert against(rig_prediction(), first).held_out_p95_px == {}
    untried = unconfirmed(held_out_p95_px={"homography": 2.0})
    assert decided(pair(), SEED, [untried, unconfirmed()]).held_out_p95_px == {}


def test_a_band_without_a_seed_has_failed() -> None:
    no_seed = Issue(FEW_KEYPOINTS, 3, 16)
    (result,) = decide([BandCandidates(pair(), no_seed)]).values()
    assert (result.status, result.issues, result.seed.kind) == ("failed", (no_seed,), "rig")


def test_a_result_with_issues_is_replaced_by_the_seed() -> None:
    result = decided(pair(), SEED, [unconfirmed()])
    assert (result.status, result.issues[0].code, result.joint.retrieval) == ("seed_only", "retrieval", 0.1)
    assert result.residual.median_px == pytest.approx(np.hypot(1, 1), abs=0.05)
    missing = decided(pair(), SEED, (), Issue(FEW_KEYPOINTS, 3, 16))
    assert missing.status == "seed_only"
    assert missing.reason == "only 3 keypoints are in the area that both bands show; the rig seed is used unchanged"


# ---- reliefs


def flat_relief() -> Relief:
    ones = np.ones(SIZE[::-1], np.float32)
    return Relief(ones, ones, std_px=0.2 * ones)


@dataclass
class Together:
    """Three bands of one reference, with the status that each has without a relief."""

    bands: dict[str, BandCandidates] = field(
        default_factory=lambda: {n: BandCandidates(pair(n), SEED, None, [candidate(n)]) for n in ("Blue", "Red", "NIR")}
    )

    def decided(self, *reliefs: UnderRelief) -> dict[str, Alignment]:
        return decide(list(self.bands.values()), reliefs)


def relief_of(*names: str, predicted: Mapping[str, float] | None = None) -> UnderRelief:
    """One relief under which some bands are aligned, and others predicted with a standard error."""
    relief = flat_relief()
    found = {n: candidate(n, relief=relief) for n in names}
    return found | {
        n: candidate(n, relief=relief, std_px=s, given_issues=(IN_PART,)) for n, s in (predicted or {}).items()
    }


def test_all_bands_have_the_same_relief() -> None:
    result = Together().decided(relief_of("Blue", "Red", "NIR"))
    assert {a.status for a in result.values()} == {"aligned"}
    assert {a.geometry for a in result.values()} == {"relief"}
    assert len({id(a.mapping.parallax.relief) for a in result.values()}) == 1


def test_a_homography_beside_a_relief_is_predicted_with_its_own_error() -> None:
    """Its geometry differs from that of the others, although it passes all checks. A thermal band has its own grid."""
    together = Together()
    thermal = replace(pair("LWIR"), reference=Reference(pair().reference.image))
    together.bands["LWIR"] = BandCandidates(thermal, SEED, None, [candidate("LWIR", pair=thermal)])
    result = together.decided(relief_of("Blue", "Red"))
    expected = {"Blue": "aligned", "Red": "aligned", "NIR": "predicted", "LWIR": "aligned"}
    assert {name: a.status for name, a in result.items()} == expected
    nir = result["NIR"]
    assert ([i.code for i in nir.issues], nir.geometry) == (["other_geometry"], "homography")
    assert nir.prediction.source == "windows"
    assert nir.prediction.std_px == pytest.approx(rms_error_px(nir), abs=6e-5)


def test_a_band_under_the_relief_is_predicted_with_the_error_of_the_relief() -> None:
    """Even if a homography alone would be aligned."""
    result = Together().decided(relief_of("Blue", "Red", predicted={"NIR": 0.05}))["NIR"]
    assert (result.status, result.geometry) == ("predicted", "relief")
    assert [i.code for i in result.issues] == ["other_geometry", "close_windows"]
    assert 0.2 < result.prediction.std_px == pytest.approx(rms_error_px(result), abs=6e-5)


@pytest.mark.parametrize(
    ("first", "second", "delivered_std_px", "chosen"),
    [
        (("Blue",), ("Blue", "Red"), 0.0, 1),
        (("Blue", "Red"), ("Blue",), 0.0, 0),
        # Without accepted predictions the bands beside a relief are not delivered; with them, all are, and more are
        # aligned under the second relief.
        (("Blue",), ("Blue", "Red"), 1.0, 1),
        (("Blue",), ("Red",), 0.0, 0),
    ],
)
def test_of_two_reliefs_the_one_that_delivers_more_bands_is_that_of_all(
    first: tuple[str, ...],
    second: tuple[str, ...],
    delivered_std_px: float,
    chosen: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(decision, "DELIVERED_STD_PX", delivered_std_px)
    reliefs = [relief_of(*names) for names in (first, second)]
    result = Together().decided(*reliefs)
    used = {id(a.mapping.parallax.relief) for a in result.values() if a.mapping.parallax is not None}
    assert used == {id(c.mapping.parallax.relief) for c in reliefs[chosen].values()}


def test_predictions_by_the_rig_which_have_the_relief_of_the_images_do_not_change_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(decision, "DELIVERED_STD_PX", 0.05)
    bands, reliefs = list(Together().bands.values()), [relief_of("Blue"), relief_of("Blue", "Red")]
    predictions = {name: rig_prediction(std_px=0.01, of=pair(name)) for name in ("Red", "NIR")}
    by_images, result = decide(bands, reliefs), decide(bands, reliefs, predictions)
    assert result["NIR"].prediction.source == "bands"
    for name in ("Blue", "Red"):
        assert result[name].mapping.parallax is by_images[name].mapping.parallax
        assert result[name].status == "aligned"


# ---- the rig of the flight


def test_an_alignment_that_agrees_with_the_rig_is_compared_with_it() -> None:
    result = against(rig_prediction(NEAR), candidate())
    assert (result.status, result.geometry, result.prediction.source) == ("aligned", "homography", "bands")
    assert result.prediction.off_px == pytest.approx(0.1)
    np.testing.assert_array_equal(result.fixed_to_moving, TRUTH)


AT_RIG = geometry.translation(5.8, -4)
"""Where the rig predicts the band, close to its true mapping."""


@pytest.mark.parametrize(
    ("own", "source", "codes"),
    [
        (
            lambda: [candidate(matrix=geometry.translation(31, -4))],
            "bands",
            ["unexpected_px"],
        ),  # one period of the scene off
        (lambda: [in_part(0.5)], "bands", ["close_windows"]),  # the rig is more certain
        (lambda: [in_part(0.01)], "windows", ["close_windows"]),  # the images are
        (
            lambda: [in_part(0.01, matrix=geometry.translation(9.5, -4))],
            "bands",
            ["unexpected_px", "close_windows"],
        ),  # but they contradict it
        (lambda: [in_part(1.0, matrix=geometry.translation(9.5, -4))], "bands", ["close_windows"]),  # uncertainly
        (
            lambda: [in_part(0.01, Issue(OTHER_CONTENT, 0.2))],
            "bands",
            ["other_content"],
        ),  # windows of the other scene count
        (lambda: [unconfirmed()], "bands", ["retrieval"]),
    ],
    ids=["contradiction", "rig more certain", "own more certain", "far", "near by its error", "other scene", "failed"],
)
def test_the_rig_replaces_what_contradicts_it_and_what_is_less_certain(
    own: Callable[[], list[Candidate]], source: str, codes: list[str]
) -> None:
    result = against(rig_prediction(AT_RIG), *own())
    assert (result.status, result.prediction.source, [i.code for i in result.issues]) == ("predicted", source, codes)
    np.testing.assert_array_equal(result.fixed_to_moving, AT_RIG if source == "bands" else TRUTH)
    assert result.prediction.std_px == pytest.approx(rms_error_px(result), abs=6e-5)
    if source == "bands":
        assert result.error.residual is None
    if codes[0] == "unexpected_px":  # which of the two is right is unknown
        off_px = 25.2 if len(codes) == 1 else 3.7
        assert result.issues[0].value == result.prediction.off_px == pytest.approx(off_px)
        assert result.prediction.std_px == pytest.approx(np.hypot(0.3, off_px), abs=1e-3)
    elif source == "bands":
        assert result.prediction.std_px == 0.3


def test_another_scene_is_found_also_in_an_inaccurate_result() -> None:
    """Its windows contribute to the mapping, however certain this seems."""
    facts = {"common_px": geometry.lattice(*SIZE, 12, 9), "second_layer": None}
    seen = SimpleNamespace(issues=(Issue(OTHER_CONTENT, 0.2),), **facts)
    for images, source in ((None, "windows"), (seen, "bands")):
        result = against(rig_prediction(AT_RIG, std_px=5.0), candidate(std_px=1.0, images=images))
        assert (result.prediction.source, result.issues[0].code) == (source, "inaccurate")
    assert result.issues[1].code == "other_content"
    relief = candidate(std_px=1.0, images=seen, relief=flat_relief())
    under = decide([BandCandidates(pair(), SEED, None, [candidate()])], [{"NIR": relief}])["NIR"]
    assert [i.code for i in under.issues] == ["other_geometry", "inaccurate", "other_content"]


def test_a_second_layer_is_at_least_the_error_of_a_prediction() -> None:
    """Of rows of vines, 0.25 of the image, that are 4 px off."""
    facts = {"common_px": geometry.lattice(*SIZE, 12, 9), "second_layer": Layer((4.0, 0.0), 0.25, 0.07)}
    seen = SimpleNamespace(issues=(Issue(SECOND_LAYER, 0.25, 0.07, "4 px"),), **facts)
    for std_px in (0.1, 5.0):
        own = candidate(std_px=std_px, images=seen)
        (result,) = decide([BandCandidates(pair(), SEED, None, [own])]).values()
        assert result.status == "predicted"
        assert result.std_px == pytest.approx(max(own.std_px, 0.25**0.5 * 4.0), abs=0.01)


def test_a_certain_prediction_by_windows_stays_within_the_error_of_an_uncertain_rig() -> None:
    """Whether it contradicts the rig depends on the standard error of the rig, as for aligned results."""
    far = geometry.compose(AT_RIG, geometry.translation(9.0, 0.0))
    for std_px, source in ((5.0, "windows"), (0.3, "bands")):
        assert against(rig_prediction(far, std_px=std_px), in_part(0.01)).prediction.source == source


def test_the_relief_of_a_scene_is_part_of_the_error_and_not_of_the_comparison() -> None:
    """A plane that is compared with the rig is not displaced by the relief that it does not follow."""
    certain = rig_prediction(geometry.translation(10, -4), std_px=0.1)
    of_rig = replace(certain, relief_std_px=2.0)
    vars(of_rig)["rotated"] = None
    result = against(of_rig, candidate())
    assert (result.status, result.issues[0].code) == ("predicted", "unexpected_px")
    assert result.issues[0].limit == 3.0
    off_px = result.prediction.off_px
    assert result.prediction.std_px == pytest.approx(np.sqrt(0.1**2 + 2.0**2 + off_px**2), abs=1e-3)


def test_a_rotated_image_has_failed_and_the_rig_does_not_replace_it() -> None:
    """Not even the seed, which is trusted and fits, may be used."""
    turned = geometry.compose(TRUTH, np.array([[0.98, -0.17, 30], [0.17, 0.98, -30], [0, 0, 1.0]]))
    of_rig = rig_prediction(rotated=turned)
    result = against(of_rig, unconfirmed())
    assert (result.status, [i.code for i in result.issues]) == ("failed", ["unexpected_px", "retrieval"])
    assert result.issues[0].value == pytest.approx(of_rig.distance_px(turned))
    assert (result.prediction, result.residual, result.error) == (None, None, None)
    np.testing.assert_array_equal(result.fixed_to_moving, SEED.fixed_to_moving)
    # What the images confirm, and the rig too, is not compared with landmarks.
    assert against(of_rig, candidate()).status == "aligned"


def test_the_standard_error_is_in_pixels_of_the_band() -> None:
    """Pixels of a thermal band are ten times as large as those of the reference."""
    matrix = np.diag([0.1, 0.1, 1.0])
    fixed = pair().reference.image
    thermal = pair_of(fixed, Raster(fixed.pixels[:32, :40], fixed.valid[:32, :40]), {"identity": matrix})
    of_rig = {"moving": rig_prediction(matrix, 0.4, of=thermal)}
    lost = BandCandidates(thermal, replace(SEED, fixed_to_moving=matrix), LOST)
    result = decide([lost], (), of_rig)["moving"]
    assert (result.status, result.prediction.std_px) == ("predicted", pytest.approx(0.4))
    assert rms_error_px(result, (40, 32)) == pytest.approx(4.0)


def test_the_mapping_of_a_prediction_is_that_of_the_files() -> None:
    result = against(rig_prediction(AT_RIG), in_part(0.01))
    points = geometry.lattice(*SIZE, 5, 4)
    assert rms(PixelMapping(result.prediction.fixed_to_moving)(points) - result.map(points)) < 1e-9
