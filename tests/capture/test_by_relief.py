"""One relief for all bands of a capture, on rendered scenes with exact truth, without any learning."""

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from synthetic_flights.depth import CLOSE_RANGE, Scene, Truth, truth_of, view
from synthetic_flights.relief import make_scene

from agalign.batch.capture_task import quiet
from agalign.capture import align_bands
from agalign.capture import by_relief as relief_module
from agalign.capture.align_bands import CaptureEstimation
from agalign.capture.band_pair import BandPair
from agalign.capture.by_relief import (
    UnderRelief,
    _decreases_shifts,
    _Estimate,
    _is_relief_accepted,
    _std_px,
    _with_field_on_relief,
    by_relief,
)
from agalign.capture.by_rig import _parallax_by_rig, rig_predictions
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand
from agalign.capture.common_parallax import MIN_PARALLAX_PX, common_parallax_px, consistent_bands
from agalign.capture.decision import decide
from agalign.capture.reference import Reference
from agalign.capture.warped_pair import WarpedPair
from agalign.config import JointSettings, ReliefSettings, Settings
from agalign.fit.adjustment import WindowShifts
from agalign.fit.displacement_field import DisplacementEstimator, DisplacementResult
from agalign.flight.rig import Rig
from agalign.synthetic.cameras import BandSpec, CameraSpec
from agalign.synthetic.flight import recorded
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Capture
from agalign.values.choices import FamilyChoice, ReliefUse
from agalign.values.geometry import Matrix, PairScales
from agalign.values.image import Raster
from agalign.values.issues import (
    CLOSE_WINDOWS,
    CLUSTER,
    NO_CONTRAST,
    OTHER_CONTENT,
    REPEATS,
    RETRIEVAL,
    Issue,
    IssueKind,
)
from agalign.values.lens_shapes import lens_shapes
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale
from agalign.values.residual import Residual, lengths_in_common_px

from ..builders import grid_px, in_full_run, joint_result, residual_of, whole
from ..conftest import Shared, textured_image

CAMERA = replace(
    CLOSE_RANGE, bands=tuple(b for b in CLOSE_RANGE.bands if b.name in ("Green", "Blue", "Red", "NIR")), reference=1
)
REFERENCE = CAMERA.bands[CAMERA.reference]
MOVING = tuple(b for b in CAMERA.bands if b is not REFERENCE)


@dataclass(frozen=True)
class Rendered:
    """A scene as the bands show it."""

    size_px: tuple[int, int]
    truth: Truth
    images: Mapping[str, np.ndarray]
    moving: Sequence[BandSpec] = MOVING

    @classmethod
    def of(cls, scene: Scene, size_px: tuple[int, int], camera: CameraSpec = CAMERA) -> "Rendered":
        rng = np.random.default_rng(0)
        images = {b.name: recorded(view(scene, b, size_px), b, rng).astype(np.float32) for b in camera.bands}
        moving = tuple(b for b in camera.bands if b.name != REFERENCE.name)
        return cls(size_px, truth_of(scene, size_px, camera), images, moving)

    @property
    def pixels(self) -> np.ndarray:
        return np.stack(np.meshgrid(*(np.arange(n) for n in self.size_px)), axis=-1).astype(float)

    def plane_of_raw_pixels(self, name: str) -> Matrix:
        """The homography of the dominant plane between raw pixels."""
        known = self.truth.bands[name]
        some = np.argwhere(known.scored)[::101]
        matrix, _ = cv2.findHomography(some[:, ::-1].astype(float), known.moving_px[some[:, 0], some[:, 1]], cv2.RANSAC)
        return np.asarray(matrix)

    def raster(self, band: BandSpec, images: Mapping[str, np.ndarray]) -> Raster:
        return whole(images[band.name], band.lens(*self.size_px))

    def plane(self, band: BandSpec) -> Matrix:
        """The homography of the dominant plane, as the joint optimisation estimates it."""
        known = self.truth.bands[band.name]
        some = np.argwhere(known.scored)[::101]
        here, there = some[:, ::-1].astype(float), known.moving_px[some[:, 0], some[:, 1]].astype(float)
        lenses = (b.lens(*self.size_px) for b in (REFERENCE, band))
        undistorted = (lens.undistort(each, points) for each, points in zip(lenses, (here, there), strict=True))
        matrix, _ = cv2.findHomography(*undistorted, cv2.RANSAC, 1.0)
        return np.asarray(matrix)

    def refined(self, instead: Mapping[str, np.ndarray] | None = None) -> list[RefinedBand]:
        """All moving bands, some with other images `instead`."""
        images = {**self.images, **(instead or {})}
        reference = Reference(self.raster(REFERENCE, images))
        result = []
        for band in self.moving:
            layout = -band.baseline_m[0], -band.baseline_m[1]
            matrix = self.plane(band)
            pair = BandPair(band.name, reference, self.raster(band, images), {"rig": matrix}, layout=layout)
            result.append(RefinedBand.of(pair, seed_of(pair), joint_result(matrix)))
        return result

    def correlation(self, mapping: PixelMapping) -> float:
        """Return the correlation of range and parallax, which is negative: positive parallax is nearer."""
        parallax_px = mapping.parallax.relief(self.pixels)
        return float(np.corrcoef(parallax_px.ravel(), self.truth.range_m.ravel())[0, 1])

    def error_px(self, band: str, mapping: PixelMapping) -> np.ndarray:
        """Return (n,) errors of all pixels that are visible in the band."""
        known = self.truth.bands[band]
        return np.asarray(np.linalg.norm(mapping(self.pixels) - known.moving_px, axis=-1)[known.visible])


def seed_of(pair: BandPair) -> Seed:
    return Seed("rig", pair.seed_matrices["rig"], 30.0, 30.0, 5.0)


def aligned_by_relief(
    bands: Sequence[RefinedBand], use: ReliefUse, *, is_observation: bool = False
) -> tuple[dict[str, Alignment], set[str]]:
    """The alignments of the bands that follow the relief of a capture, and the bands with parallax along a line."""
    reliefs, along_a_line = by_relief(bands, use, is_observation=is_observation)
    names = {name for relief in reliefs for name in relief}
    result = decide(unaligned(bands), reliefs)
    return {name: alignment for name, alignment in result.items() if name in names}, along_a_line


def unaligned(bands: Sequence[RefinedBand]) -> list[BandCandidates]:
    """The bands without other candidates than those under a relief."""
    return [BandCandidates(band.pair, seed_of(band.pair), Issue(RETRIEVAL, 0.0, 0.2)) for band in bands]


def with_pair(band: RefinedBand, **facts: object) -> RefinedBand:
    """The band with other facts of its pair."""
    return replace(band, warped=replace(band.warped, pair=replace(band.pair, **facts)))


def without_layout(candidates: Sequence[RefinedBand]) -> list[RefinedBand]:
    return [with_pair(c, layout=None) for c in candidates]


def shows_relief(candidates: Sequence[RefinedBand]) -> bool:
    parallax_px, on_a_line = common_parallax_px(candidates)
    return parallax_px >= MIN_PARALLAX_PX and not on_a_line


@pytest.fixture(scope="module")
def four_lenses(shared: Shared) -> Rendered:
    size_px = 640, 480

    def render(folder: Path) -> None:
        rendered = Rendered.of(make_scene("boxes", 8, width_px=size_px[0]), size_px, CLOSE_RANGE)
        (folder / "rendered.pickle").write_bytes(pickle.dumps(rendered))

    rendered: Rendered = pickle.loads((shared("four_lenses", render) / "rendered.pickle").read_bytes())
    return rendered


@pytest.fixture(scope="module")
def boxes(four_lenses: Rendered) -> Rendered:
    """As the bands of `CAMERA` show them."""
    known = {b.name: four_lenses.truth.bands[b.name] for b in MOVING}
    return replace(four_lenses, truth=replace(four_lenses.truth, bands=known), moving=MOVING)


@pytest.fixture(scope="module")
def flat() -> Rendered:
    size_px = 448, 336
    return Rendered.of(make_scene("flat", 1, width_px=size_px[0]), size_px)


@pytest.fixture(scope="module")
def candidates(boxes: Rendered) -> list[RefinedBand]:
    return boxes.refined()


@pytest.fixture(scope="module")
def aligned(candidates: Sequence[RefinedBand]) -> dict[str, Alignment]:
    return aligned_by_relief(candidates, "auto")[0]


def test_all_bands_are_aligned_by_one_relief(boxes: Rendered, aligned: Mapping[str, Alignment]) -> None:
    assert set(aligned) == {b.name for b in MOVING}
    assert len({id(a.mapping.parallax.relief) for a in aligned.values()}) == 1
    for band, alignment in aligned.items():
        assert (alignment.status, alignment.issues) == ("aligned", ())
        complete = alignment.mapping
        errors, plane = (boxes.error_px(band, m) for m in (complete, complete.without_parallax))
        assert np.median(errors) < 0.2
        assert np.percentile(errors, 90) < 0.6
        assert np.percentile(plane, 90) > 3
        assert 0 < alignment.error.baseline_std < 0.05
        # Without a rig, lens shapes are fitted: their errors are part of the covariance, not added to it.
        assert (alignment.error.covariance_px2.shape, alignment.error.lens_std_px) == ((12, 12), None)
        # The reported residual is measured with the relief from the other bands.
        assert alignment.residual.median_px < 0.25
    assert boxes.correlation(aligned["NIR"].mapping) < -0.9


@pytest.mark.parametrize(("is_lens_known", "unknowns"), [(False, 12), (True, 8)])
def test_lens_shapes_are_fitted_unless_the_rig_contains_them(
    is_lens_known: bool, unknowns: int, candidates: Sequence[RefinedBand]
) -> None:
    """A rig may contain the bands without their lenses, where windows miss a part of the image in all captures."""
    of_rig = [with_pair(band, seed_std_px={"model": 1.0}, is_lens_known=is_lens_known) for band in candidates]
    aligned, _ = aligned_by_relief(of_rig, "auto")
    assert {a.error.covariance_px2.shape for a in aligned.values()} == {(unknowns, unknowns)}


def test_reliefs_from_different_bands_give_a_standard_error(boxes: Rendered, aligned: Mapping[str, Alignment]) -> None:
    one, other = (Relief(np.full((40, 60), z, np.float32), np.ones((40, 60), np.float32)) for z in (1.0, 3.0))
    of_four = np.sqrt(3 * 0.75)
    np.testing.assert_allclose(_std_px([one, one, one, other], np.inf), of_four, rtol=0.036)
    # Where the bands disagree by more than the windows, it approaches the error of these.
    np.testing.assert_allclose(_std_px([one, one, one, other], 2.0), of_four / np.hypot(1, of_four / 2), rtol=0.036)
    far = replace(other, parallax_px=100 * other.parallax_px)
    np.testing.assert_allclose(_std_px([one, far], 2.0), 2.0, rtol=0.001)
    # The medians of errors that are equal and normally distributed are equal, whatever the number of reliefs.
    rng, claimed = np.random.default_rng(0), []
    for count in (2, 3, 4):
        noise = rng.normal(0, 0.3 * np.sqrt(count), (count, 200, 300)).astype(np.float32)
        without_one = [Relief((noise.sum(axis=0) - n) / (count - 1), np.ones_like(n)) for n in noise]
        claimed.append(float(np.median(_std_px(without_one, np.inf))))
    assert max(claimed) < 1.05 * min(claimed)
    assert min(claimed) > 0.8 * 0.3
    speck = one.parallax_px.copy()  # single pixels do not count
    speck[10:14, 20:24] += 50
    assert _std_px([one, replace(one, parallax_px=speck)], np.inf).max() < 0.02
    known = aligned["NIR"]
    parallax, points = known.mapping.parallax, geometry.lattice(*known.size_px, 40, 30)
    of_relief_px = replace(parallax.relief, parallax_px=parallax.relief.std_px)(points)
    np.testing.assert_allclose(parallax.variance_px2(points), (of_relief_px * np.hypot(*parallax.baseline)) ** 2)
    certain = replace(parallax, relief=replace(parallax.relief, std_px=None))
    flat = replace(known.error, parallax=certain)
    # The shifts of held-out windows, under a relief from other bands, contain its error.
    squares = [error.error_px(points) ** 2 for error in (known.error, flat)]
    assert (squares[0] >= squares[1]).all()
    assert (squares[0] >= parallax.variance_px2(points)).all()
    assert np.median(parallax.variance_px2(points)) < 0.3**2


def test_occluded_pixels_are_detected(boxes: Rendered, aligned: Mapping[str, Alignment]) -> None:
    """To a pixel."""
    in_all = np.logical_and.reduce([t.inside for t in boxes.truth.bands.values()])
    hidden = in_all & [aligned[b.name].mapping.parallax.hidden for b in MOVING]
    known = in_all & [boxes.truth.bands[b.name].hidden for b in MOVING]
    near_hidden, near_known = (maximum_filter(masks, (1, 3, 3)) for masks in (hidden, known))
    assert known.sum() > 5000
    assert (hidden & near_known).sum() > 0.7 * hidden.sum()
    assert (known & near_hidden).sum() > 0.7 * known.sum()


@pytest.mark.full
def test_parallax_along_a_line_needs_a_layout() -> None:
    """Edges of shadows and leaves move along a line too; with a layout it is that of the lenses."""
    x_m, size_px = {"Green": 0.0, "Blue": -0.03, "Red": 0.02, "NIR": -0.015}, (448, 336)
    camera = replace(CAMERA, bands=tuple(replace(b, baseline_m=(x_m[b.name], 0.0)) for b in CAMERA.bands))
    on_a_line = Rendered.of(make_scene("boxes", 8, width_px=448), size_px, camera).refined()
    names = {b.name for b in MOVING}
    assert set(aligned_by_relief(on_a_line, "auto")[0]) == names
    without = without_layout(on_a_line)
    assert aligned_by_relief(without, "auto") == ({}, names)
    # No displacement field follows them either.
    for alignment in verified_together(without, Settings()).values():
        assert set(alignment.held_out_p95_px) <= {"homography"}


def test_bands_along_a_line_do_not_follow_the_relief_of_other_bands(
    candidates: Sequence[RefinedBand], monkeypatch: pytest.MonkeyPatch
) -> None:
    *on_a_line, other = candidates[:3]
    with_relief, offered = [other, other], list[list[RefinedBand]]()
    monkeypatch.setattr(relief_module, "parallax_groups", lambda _: [with_relief, on_a_line])
    monkeypatch.setattr(relief_module, "common_parallax_px", lambda group: (2.0, group is on_a_line))
    monkeypatch.setattr(relief_module, "_of_group", lambda _, others: offered.append(others))
    assert by_relief(candidates, "auto") == ([], {band.pair.name for band in on_a_line})
    assert offered == [[band for band in candidates if band not in on_a_line]]


def verified_together(bands: Sequence[RefinedBand], settings: Settings) -> dict[str, Alignment]:
    estimation = CaptureEstimation(settings, None, quiet)
    add(estimation, bands)
    return estimation.decided()


def add(estimation: CaptureEstimation, bands: Sequence[RefinedBand]) -> None:
    """Add the results of bands to those of a capture."""
    estimation.bands |= {b.pair.name: BandCandidates(b.pair, seed_of(b.pair)) for b in bands}
    estimation.add({b.pair.name: b.joint for b in bands})


@pytest.mark.full
@pytest.mark.parametrize(("family", "is_allowed"), [("auto", True), ("translation", False), ("affine", False)])
@pytest.mark.parametrize("use", ["auto", in_full_run("always")])
def test_neither_relief_nor_field_replaces_another_model_family(
    candidates: Sequence[RefinedBand], family: FamilyChoice, use: ReliefUse, is_allowed: bool
) -> None:
    settings = Settings(joint=JointSettings(model_family=family), relief=ReliefSettings(use=use))
    for alignment in verified_together(candidates, settings).values():
        assert (alignment.geometry != "homography") == is_allowed
        assert (len(alignment.held_out_p95_px) > 1) == is_allowed


def flat_relief_of(*bands: RefinedBand) -> UnderRelief:
    """The candidates of some bands under a relief without parallax."""
    relief, result = Relief(np.zeros((4, 4), np.float32), np.ones((4, 4), np.float32)), dict[str, Candidate]()
    for band in bands:
        under = band.warped.with_mapping(band.warped.mapping.with_parallax(Parallax(relief, (1, 0))))
        result[band.pair.name] = Candidate.of(under, band.joint)
    return result


@pytest.mark.parametrize("is_together", [True, False])
def test_bands_that_are_aligned_together_or_one_after_another_have_one_geometry(
    flat: Rendered, monkeypatch: pytest.MonkeyPatch, is_together: bool
) -> None:
    """A band that is learned from scratch after the relief of the others, for example."""
    bands = {band.pair.name: band for band in flat.refined()}
    found = [flat_relief_of(bands["Blue"])]
    monkeypatch.setattr(align_bands, "by_relief", lambda *_, **__: ([found.pop()] if found else [], set()))
    estimation = CaptureEstimation(Settings(), None, quiet)
    for some in (["Blue", "Red", "NIR"],) if is_together else (["Blue"], ["Red", "NIR"]):
        add(estimation, [bands[name] for name in some])
    result = estimation.decided()
    expected = {"Blue": "aligned", "Red": "predicted", "NIR": "predicted"}
    assert {name: a.status for name, a in result.items()} == expected
    assert result["NIR"].prediction.source == "windows"


def test_a_band_under_an_earlier_relief_alone_is_not_at_its_seed(
    flat: Rendered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two bands are learned from scratch after the relief of a third one, and a relief without it delivers more."""
    bands = {band.pair.name: band for band in flat.refined()}
    of_blue = flat_relief_of(bands["Blue"])
    blue = of_blue["Blue"]
    uncertain = {"Blue": replace(blue, error=replace(blue.error, rig_std_px=9.0))}
    found = [flat_relief_of(bands["Red"], bands["NIR"]), uncertain]
    monkeypatch.setattr(align_bands, "by_relief", lambda *_, **__: ([found.pop()], set()))
    estimation = CaptureEstimation(Settings(), None, quiet)
    for some in (["Blue"], ["Red", "NIR"]):
        add(estimation, [bands[name] for name in some])
    result = estimation.decided()
    assert {name: a.status for name, a in result.items()} == {"Blue": "predicted", "Red": "aligned", "NIR": "aligned"}
    assert result["Blue"].std_px < 0.5


@pytest.mark.full
def test_the_relief_is_estimated_once_if_nothing_is_learned(
    candidates: Sequence[RefinedBand], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It costs more than all other steps."""
    calls: list[int] = []
    of = _Estimate.of.__func__

    def counted(cls: type[_Estimate], group: Sequence[RefinedBand]) -> _Estimate | None:
        calls.append(len(group))
        result: _Estimate | None = of(cls, group)
        return result

    joints = {band.pair.name: band.joint for band in candidates}
    seeds = {band.pair.name: seed_of(band.pair) for band in candidates}
    monkeypatch.setattr(_Estimate, "of", classmethod(counted))
    monkeypatch.setattr(align_bands, "find_seed", lambda pair, *_: seeds[pair.name])
    monkeypatch.setattr(CaptureEstimation, "_optimised", lambda _, seeds, *__: {n: joints[n] for n in seeds})
    model = SimpleNamespace(net=None, rig=None, side=lambda _: 0)
    result = CaptureEstimation(Settings(), model, quiet).align(
        [band.pair for band in candidates], Capture("a", Path(), (), 0)
    )
    assert {a.geometry for a in result.values()} <= {"relief", "relief and field"}
    assert {a.status for a in result.values()} == {"aligned"}
    assert calls == [len(candidates)]


@pytest.mark.full
def test_bands_with_and_without_a_lens_model_have_one_relief(four_lenses: Rendered) -> None:
    """Two bands of each kind: either kind determines a relief, and one of these is that of all bands."""
    bands = []
    for band in four_lenses.refined():
        if band.pair.name in ("Blue", "Red edge"):
            bands.append(band)
            continue
        pair = replace(band.pair, moving_image=replace(band.pair.moving_image, lens=None))
        bands.append(RefinedBand.of(pair, seed_of(pair), joint_result(four_lenses.plane_of_raw_pixels(pair.name))))
    estimation = CaptureEstimation(Settings(), None, quiet)
    add(estimation, bands)
    assert len(estimation.reliefs) == 2
    result = estimation.decided()
    reliefs = {id(a.mapping.parallax.relief) for a in result.values() if a.mapping.parallax is not None}
    assert len(reliefs) == 1
    assert all(a.status != "aligned" or a.mapping.parallax is not None for a in result.values())


@pytest.mark.parametrize("has_result", [True, in_full_run(False)])
@pytest.mark.parametrize(("noise", "status"), [(0.1, "aligned"), in_full_run(0.2, "predicted")])
def test_a_noisy_band_follows_the_relief_of_the_others(
    four_lenses: Rendered, noise: float, status: str, has_result: bool
) -> None:
    """With a result of the joint optimisation or only a seed; its claim is half to three times its error."""
    scene, name = four_lenses, "Red edge"
    image = scene.images[name]
    noisy = image + np.random.default_rng(3).normal(0, noise * float(image.mean()), image.shape)
    candidates = scene.refined(instead={name: noisy.clip(1, 65000).astype(np.float32)})
    if not has_result:
        lost = Issue(NO_CONTRAST)
        candidates = [c if c.pair.name != name else RefinedBand.of(c.pair, seed_of(c.pair), lost) for c in candidates]
    alignment = aligned_by_relief(candidates, "auto")[0][name]
    assert (alignment.status, alignment.mapping.parallax is None) == (status, False)
    errors, plane = (scene.error_px(name, m) for m in (alignment.mapping, alignment.mapping.without_parallax))
    assert np.percentile(errors, 90) < 1.2
    assert np.percentile(plane, 90) > 2
    if status == "predicted":
        rms_px = np.sqrt(np.mean(errors**2))
        assert 0.5 * np.percentile(errors, 68) < alignment.prediction.std_px < 3 * rms_px


@pytest.mark.full
@pytest.mark.parametrize("name", ["Blue", in_full_run("NIR")])
def test_a_band_that_shows_nothing_in_a_part_claims_the_error_there(four_lenses: Rendered, name: str) -> None:
    image = four_lenses.images[name].copy()
    image[:, int(0.4 * image.shape[1]) :] = 60_000
    candidates = four_lenses.refined({name: image})
    lost = [
        RefinedBand.of(c.pair, seed_of(c.pair), Issue(NO_CONTRAST)) if c.pair.name == name else c for c in candidates
    ]
    prediction, mapping = (getattr(aligned_by_relief(lost, "auto")[0][name], of) for of in ("prediction", "mapping"))
    p68_px = np.percentile(four_lenses.error_px(name, mapping), 68)
    assert 0.5 * p68_px < prediction.std_px < 4 * p68_px


@pytest.mark.full
def test_a_blurred_band_leaves_the_relief_to_the_sharp_ones_and_follows_it(four_lenses: Rendered) -> None:
    blurred = cv2.GaussianBlur(four_lenses.images["Blue"], (0, 0), 3)
    candidates = four_lenses.refined({"Blue": blurred})
    assert [c.pair.name for c in candidates if c.pair.is_blurred] == ["Blue"]
    result = aligned_by_relief(candidates, "auto")[0]
    assert {name for name, a in result.items() if a.status == "aligned"} >= {"Red", "NIR", "Red edge"}
    for name, alignment in result.items():
        assert np.percentile(four_lenses.error_px(name, alignment.mapping), 90) < 1
    assert result["Blue"].mapping.parallax is not None


@pytest.mark.parametrize(("kind", "is_predicted"), [(CLOSE_WINDOWS, True), (RETRIEVAL, False)])
def test_a_relief_does_not_verify_a_band_that_it_is_estimated_from(
    candidates: Sequence[RefinedBand],
    aligned: Mapping[str, Alignment],
    monkeypatch: pytest.MonkeyPatch,
    kind: IssueKind,
    is_predicted: bool,
) -> None:
    """A band that does not pass with the relief of the others is predicted by it, with the error of those windows,
    if the images confirm it elsewhere.
    """
    found = Candidate.issues.func

    def with_nir_failed(candidate: Candidate) -> tuple[Issue, ...]:
        return (Issue(kind),) if candidate.pair.name == "NIR" else found(candidate)

    monkeypatch.setattr(Candidate, "issues", property(with_nir_failed))
    result = aligned_by_relief(candidates, "auto")[0]
    if not is_predicted:
        assert "NIR" not in result
        return
    assert {name: a.status for name, a in result.items()} == dict.fromkeys(aligned, "aligned") | {"NIR": "predicted"}
    np.testing.assert_array_equal(result["NIR"].residual.shifts_px, aligned["NIR"].residual.shifts_px)


@pytest.mark.parametrize(("uncertain_share", "status"), [in_full_run(0.05, "aligned"), (0.3, "predicted")])
def test_no_band_is_aligned_whose_relief_is_uncertain_in_more_than_a_tenth_of_the_image(
    candidates: Sequence[RefinedBand], monkeypatch: pytest.MonkeyPatch, uncertain_share: float, status: str
) -> None:
    """Its windows pass, and the quality raster would flag these pixels."""

    def uncertain(reliefs: Sequence[Relief], _: float) -> np.ndarray:
        std_px = np.zeros_like(reliefs[0].parallax_px)
        std_px[:, : round(uncertain_share * std_px.shape[1])] = 10.0
        return std_px

    monkeypatch.setattr("agalign.capture.by_relief._std_px", uncertain)
    result = aligned_by_relief(candidates, "auto")[0]
    assert {a.status for a in result.values()} == {status}
    for alignment in result.values():
        points = geometry.lattice(*alignment.size_px, 40, 30)
        share = (alignment.error_px(points) > 1).mean()
        assert share == pytest.approx(uncertain_share, abs=0.05)
        if status == "predicted":
            assert "inaccurate" in {issue.kind.code for issue in alignment.issues}
            assert alignment.prediction.std_px > 1


@pytest.mark.parametrize("magnification", [1.0, 2.0])
def test_a_lost_band_is_predicted_with_the_relief(
    boxes: Rendered, candidates: Sequence[RefinedBand], aligned: Mapping[str, Alignment], magnification: float
) -> None:
    """The rig knows planes and baselines, the relief is that of the other bands. The file of the lost band has more
    pixels.
    """
    norm = np.linalg.norm([b.baseline_m for b in MOVING])
    mean = {name: a.fixed_to_moving for name, a in aligned.items()}
    mean["Blue"] = geometry.compose(np.diag([magnification, magnification, 1.0]), mean["Blue"])
    baselines = {b.name: (-b.baseline_m[0] / norm, -b.baseline_m[1] / norm) for b in MOVING}
    none, from_bands_px = (dict.fromkeys(mean, float(value)) for value in (0.0, 0.05))
    rig = Rig(boxes.size_px, mean, baselines, none, none, ("distance",), (), from_bands_px)
    reduced = PairScales(moving=PixelScale(1 / magnification, 1 / magnification))
    candidates = [with_pair(c, scales=reduced) if c.pair.name == "Blue" else c for c in candidates]
    pairs, bands = [c.pair for c in candidates], unaligned(candidates)
    without_blue = {
        name: Candidate(pair, a.mapping, a.error, a.residual, a.joint)
        for (name, a), pair in zip(aligned.items(), pairs, strict=True)
        if name != "Blue"
    }
    reliefs = [without_blue]
    known = decide(bands, reliefs)
    predictions = rig_predictions(pairs, known, rig, Capture("a", Path(), (), 0))
    result = decide(bands, reliefs, predictions)
    # The other bands are verified by the rig as before.
    assert {name: a.status for name, a in result.items()} == {"Blue": "predicted", "Red": "aligned", "NIR": "aligned"}
    assert result["Blue"].geometry == "relief"
    np.testing.assert_allclose(
        predictions["Blue"].mapping.parallax.baseline, aligned["Blue"].mapping.parallax.baseline, atol=0.05
    )
    assert result["Blue"].error.baseline_std == predictions["Blue"].baseline_std > 0


def test_the_error_of_a_baseline_by_one_other_band_is_known_to_a_factor_only(
    boxes: Rendered, candidates: Sequence[RefinedBand]
) -> None:
    """One band has one degree of freedom: the mean square is tripled."""
    names, relief = [c.pair.name for c in candidates], Relief(np.full((8, 8), 2.0, np.float32), np.ones((8, 8)))
    nothing, (own, other, *_) = dict.fromkeys(names, 0.0), [c.pair for c in candidates]
    baselines = {**dict.fromkeys(names, (0.0, 0.0)), other.name: (0.8, 0.0), own.name: (0.0, 0.6)}
    rig = Rig(boxes.size_px, dict.fromkeys(names, np.eye(3)), baselines, nothing, nothing, ("distance",), (), nothing)
    off = 0.1  # across the baseline by the rig
    parallax, std = _parallax_by_rig(own, [(other, Parallax(relief, (0.8, off)))], rig)
    assert parallax.baseline == pytest.approx((0.0, 0.6))
    assert std == pytest.approx(np.sqrt(3 * off**2 * (2 + (0.6 / 0.8) ** 2)))


@pytest.mark.full
def test_the_relief_follows_planes_that_its_windows_move() -> None:
    """The first planes of this scene are several steps of the refinement off: large shifts are measured in steps."""
    size_px = 448, 336
    scene = Rendered.of(make_scene("boxes", 9, width_px=size_px[0]), size_px, CLOSE_RANGE)
    result = aligned_by_relief(scene.refined(), "auto")[0]
    assert {name: a.status for name, a in result.items()} == dict.fromkeys((b.name for b in scene.moving), "aligned")
    assert max(np.percentile(scene.error_px(name, a.mapping), 90) for name, a in result.items()) < 0.8


@pytest.mark.full
def test_the_sign_is_found_without_a_layout(boxes: Rendered, candidates: Sequence[RefinedBand]) -> None:
    """The sign follows from occlusions. The reference plane may differ from the one with a layout."""
    result = aligned_by_relief(without_layout(candidates), "auto")[0]
    assert len(result) == len(MOVING)
    assert boxes.correlation(result["NIR"].mapping) < -0.5


@pytest.mark.parametrize("order", ["ABCD", "CABD", "CDAB"])
def test_bands_with_few_windows_leave_the_parallax_to_the_others(candidates: Sequence[RefinedBand], order: str) -> None:
    """In any order. Two bands have few windows, so leaving out one of them is not enough for a model."""
    rng = np.random.default_rng(1)
    points = grid_px(np.arange(24, 620, 32), np.arange(24, 460, 32))
    parallax_px = np.where(rng.random(len(points)) < 0.3, 8.0, 0.0)[:, None]
    baselines = {"A": (1.0, 0.0), "B": (0.1, 0.8), "C": (0.8, 0.7), "D": (-0.5, 0.5)}
    known = {b: parallax_px * np.array(t) + rng.normal(0, 0.05, points.shape) for b, t in baselines.items()}
    for band in "CD":
        known[band][rng.permutation(len(points))[15:]] = np.nan
    shifts_px = np.stack([known[b] for b in order], axis=1)
    windows = WindowShifts(points, points, shifts_px, np.isfinite(shifts_px[..., 0]).astype(float))
    group = [with_pair(candidates[0], layout=baselines[b]) for b in order]
    kept, _ = consistent_bands(windows, group)
    assert {order[k] for k in kept} == {"A", "B"}


def test_an_observation_of_the_rig_needs_only_windows(four_lenses: Rendered) -> None:
    """It has the planes and baselines of the lenses; a band with other content is not part of it."""
    foreign_nir = {"NIR": foreign(four_lenses.images["NIR"], "unrelated", seed=3)}
    for images, names in (({}, {"Blue", "Red", "NIR", "Red edge"}), (foreign_nir, {"Blue", "Red", "Red edge"})):
        observed = aligned_by_relief(four_lenses.refined(images), "auto", is_observation=True)[0]
        assert {name for name, a in observed.items() if a.status == "aligned"} == names
        for name, alignment in observed.items():
            # The parallax of a pixel is that of the nearest window, on slopes too.
            assert np.median(four_lenses.error_px(name, alignment.mapping)) < 0.6
            assert alignment.joint.corner_std_px < 0.5


def test_an_observation_of_the_rig_is_no_alias(four_lenses: Rendered, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither if parallax causes other issues, which do not matter."""
    monkeypatch.setattr("agalign.capture.candidate.issues_of", lambda *_: (Issue(CLUSTER, 0.5, 0.1),))
    for found, is_observed in ((Issue(REPEATS, 12.0), False), (Issue(OTHER_CONTENT, 0.1, 0.0), True)):
        monkeypatch.setattr(WarpedPair, "issues", (found,))
        assert bool(aligned_by_relief(four_lenses.refined({}), "auto", is_observation=True)[0]) is is_observed


def test_a_field_on_a_relief_is_verified_by_windows_that_it_is_not_fitted_to(
    candidates: Sequence[RefinedBand], monkeypatch: pytest.MonkeyPatch
) -> None:
    under = by_relief(candidates, "auto")[0][0]["Blue"]
    assert under.issues == ()
    field = DisplacementField(48.0, np.zeros((20, 20, 2)))
    for shift_px, is_used in ((0.1, True), (3.0, False)):
        held_out = residual_of(under.residual.centres_px, np.array([shift_px, 0.0]))
        found = DisplacementResult(field, under.residual, held_out)
        monkeypatch.setattr(DisplacementEstimator, "refine", lambda *_, found=found: found)
        assert (_with_field_on_relief(under) is not under) == is_used


def test_use(candidates: Sequence[RefinedBand]) -> None:
    assert aligned_by_relief(candidates, "never") == ({}, set())
    # One moving band cannot be verified with others; a coarse one has another reference.
    assert aligned_by_relief(candidates[:1], "always") == ({}, set())
    coarse = [with_pair(c, is_coarse=True) for c in candidates[1:]]
    assert aligned_by_relief([candidates[0], *coarse], "always") == ({}, set())


@pytest.mark.parametrize("has_layout", [True, False])
@pytest.mark.parametrize("noise_px", [0.0, 2.0])
def test_neither_a_flat_scene_nor_noise_of_the_reference_is_relief(
    flat: Rendered, noise_px: float, has_layout: bool
) -> None:
    """Displacements of the reference are equal in all bands, so the relief of each band predicts the others."""
    noise = np.random.default_rng(3).normal(0, noise_px, (6, 8))
    x, y = np.moveaxis(flat.pixels.astype(np.float32), -1, 0)
    x += cv2.resize(noise, flat.size_px, interpolation=cv2.INTER_CUBIC).astype(np.float32)
    image = cv2.remap(flat.images[REFERENCE.name], x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    candidates = flat.refined({REFERENCE.name: image})
    candidates = candidates if has_layout else without_layout(candidates)
    assert not shows_relief(candidates)
    # A forced relief is not better than the homographies and therefore rejected.
    assert aligned_by_relief(candidates, "always") == ({}, set())


@pytest.mark.parametrize(("height_px", "shown"), [(0.25, False), (1.0, True)])
def test_parallax_below_the_noise_is_not_relief(flat: Rendered, height_px: float, shown: bool) -> None:
    """Even if it is consistent between the bands."""
    result = []
    for candidate, band in zip(flat.refined(), MOVING, strict=True):
        windows = candidate.pair.reference.windows
        at = windows.centres_px
        z = np.where(np.arange(len(at)) % 3 == 0, height_px, 0.0)
        residual = residual_of(at, z[:, None] * np.array(band.baseline_m) / 0.0367)
        result.append(replace(candidate, warped=replace(candidate.warped, windows=windows, residual=residual)))
    assert shows_relief(result) == shown


@pytest.mark.parametrize(
    ("is_lens_known", "height_px", "shown"), [(False, 0, False), (True, 0, True), (False, 2, True)]
)
def test_unknown_distortion_of_lenses_is_not_relief(is_lens_known: bool, height_px: float, shown: bool) -> None:
    """All bands show the distortion of the reference's lens. Where a rig contains it, what bands share is parallax."""
    size_px = 1280, 960
    image = whole(textured_image(*size_px))
    reference = Reference(image)
    at_px = reference.windows.centres_px
    shapes_px = np.array([[0.2, -0.5, 2.2, 0.5], [0.1, -0.7, -1.8, -2.7], [-1.1, -0.2, -1.0, 2.1]])
    baselines = np.array([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7]])
    bands = []
    for number, (of_band_px, baseline) in enumerate(zip(shapes_px, baselines, strict=True)):
        pair = BandPair(str(number), reference, image, {"rig": np.eye(3)}, is_lens_known=is_lens_known)
        z = np.where(np.arange(len(at_px)) % 3 == 0, height_px, 0.0)
        residual = residual_of(at_px, lens_shapes(at_px, size_px) @ of_band_px + z[:, None] * baseline)
        warped = WarpedPair(pair, pair.mapping(np.eye(3)), image, reference.windows, residual)
        bands.append(RefinedBand(joint_result(np.eye(3)), warped))
    assert shows_relief(bands) == shown


@pytest.mark.parametrize(
    ("relief_px", "plane_px", "is_chosen"),
    [
        ((0.13, 0.33), (0.08, 6.30), True),  # Most windows are on the plane and some far from it.
        ((0.08, 0.25), (0.04, 0.12), False),  # a flat scene
        ((0.30, 0.40), (0.10, 0.50), False),
        ((0.10, 0.60), (0.30, 0.50), False),
    ],
)
def test_a_relief_may_not_be_worse_than_its_plane(
    relief_px: tuple[float, float], plane_px: tuple[float, float], is_chosen: bool
) -> None:
    """Half of the bands decide; a band that no relief explains counts as one that it does not fit."""
    plane, relief = (windows_with(*px) for px in (plane_px, relief_px))
    bands = [SimpleNamespace(name=name, by_homography=plane) for name in ("Blue", "Red", "NIR")]
    aligned = SimpleNamespace(issues=(), residual=relief, pair=SimpleNamespace(file_pixel_size_px=1.0))
    predicted = SimpleNamespace(**vars(aligned) | {"issues": (Issue(RETRIEVAL),)})
    assert _is_relief_accepted(bands[:1], {"Blue": aligned}) == is_chosen
    assert _is_relief_accepted(bands, {"Blue": aligned, "Red": aligned}) == is_chosen
    assert not _is_relief_accepted(bands, {"Blue": aligned})
    # A prediction counts only where homographies align no band.
    assert _is_relief_accepted(bands, dict.fromkeys(("Blue", "Red"), predicted)) == (is_chosen and plane.p95_px > 1)
    larger = SimpleNamespace(file_pixel_size_px=10.0)  # pixels
    on_larger_pixels = SimpleNamespace(**vars(predicted) | {"pair": larger})  # homographies align these
    assert not _is_relief_accepted(bands, dict.fromkeys(("Blue", "Red"), on_larger_pixels))


def windows_with(median_px: float, p95_px: float) -> Residual:
    """270 windows, a tenth of which have the larger shift."""
    shifts_px = np.where(np.arange(270)[:, None] % 10 == 0, (p95_px, 0.0), (median_px, 0.0))
    return residual_of(grid_px(np.arange(18.0), np.arange(15.0)), shifts_px)


def test_windows_that_a_relief_occludes_do_not_count_for_it() -> None:
    """A tenth of the windows, with the largest shifts, is occluded under the relief; another tenth gets worse."""
    centres_px, number = grid_px(np.arange(18.0), np.arange(15.0)), np.arange(270)[:, None] % 10
    shifts_px = 0.5 * np.random.default_rng(0).normal(size=(270, 2))
    plane = residual_of(centres_px, np.where(number == 0, 3.0, shifts_px))
    relief = residual_of(centres_px, np.where(number == 1, 2.0, 0.1 * shifts_px)).where(number[:, 0] != 0)
    assert relief.p95_px < plane.p95_px
    assert not _decreases_shifts(plane, relief)
    assert _decreases_shifts(plane, relief.where(number[relief.cells @ [1, 18], 0] != 1))


@pytest.mark.parametrize("seed", range(10))
def test_a_relief_that_only_moves_wrong_peaks_is_not_chosen(seed: int) -> None:
    """In noisy images a tenth of the windows have wrong peaks, whose p95 decreases by chance."""
    rng = np.random.default_rng(seed)

    def noisy(scale_px: float) -> Residual:
        wrong_px = scale_px * rng.normal(size=(270, 2))
        shifts_px = np.where(rng.random((270, 1)) < 0.1, wrong_px, 0.2 * rng.normal(size=(270, 2)))
        return residual_of(grid_px(np.arange(18.0), np.arange(15.0)), shifts_px)

    plane, relief = noisy(6.0), noisy(4.0)
    assert not _decreases_shifts(plane, relief)


def test_shifts_are_compared_in_the_windows_that_both_residuals_have_measured() -> None:
    plane = windows_with(1.0, 5.0)
    measured = plane.cells[:, 0] > 2
    relief = plane.with_shifts(np.where(measured[:, None], plane.shifts_px / 2, np.nan))
    shuffled = relief.where(np.random.default_rng(0).permutation(len(relief.cells))[:200])
    before, after = lengths_in_common_px(plane, shuffled)
    assert len(before) == np.isfinite(shuffled.shifts_px[:, 0]).sum() < 200
    np.testing.assert_allclose(after, before / 2)


# ---- what fits noise cannot pass


def foreign(image: np.ndarray, kind: str, seed: int) -> np.ndarray:
    """Replace a band's image. `scrambled`: its parts are displaced independently, which is not parallax."""
    rng, result = np.random.default_rng(seed), image.copy()
    height, width = image.shape
    if kind == "noise":
        return rng.uniform(500, 4000, image.shape).astype(np.float32)
    if kind == "unrelated":
        return np.asarray(2000 + 500 * textured_image(width, height, seed), np.float32)
    for y in range(0, height, 64):
        for x in range(0, width, 64):
            piece = slice(y, y + 64), slice(x, x + 64)
            result[piece] = np.roll(image, tuple(rng.integers(-6, 7, 2)), (0, 1))[piece]
    return result


@pytest.mark.parametrize("kind", ["unrelated", in_full_run("scrambled"), in_full_run("noise")])
def test_the_others_are_aligned_without_a_foreign_band(
    boxes: Rendered, aligned: Mapping[str, Alignment], kind: str
) -> None:
    nir = foreign(boxes.images["NIR"], kind, 3)
    result = aligned_by_relief(boxes.refined({"NIR": nir}), "auto")[0]
    assert set(result) == {"Blue", "Red"}
    for name in result:
        errors, intact = (boxes.error_px(name, a[name].mapping) for a in (result, aligned))
        assert np.median(errors) < np.median(intact) + 0.03
        # Two bands instead of three determine depth edges less accurately.
        assert np.percentile(errors, 90) < np.percentile(intact, 90) + 0.2


@pytest.mark.full
def test_a_band_of_another_time_is_predicted_under_the_relief_of_the_others(boxes: Rendered) -> None:
    """Its pixels moved smoothly by 1 px, which no common parallax and no lens explains."""
    x, y = np.moveaxis(boxes.pixels.astype(np.float32), -1, 0)
    positions = x + np.sin(2 * np.pi * y / 300), y + np.cos(2 * np.pi * x / 300)
    nir = cv2.remap(boxes.images["NIR"], *positions, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    result = aligned_by_relief(boxes.refined({"NIR": nir}), "auto")[0]
    assert {name: a.status for name, a in result.items()} == {"Blue": "aligned", "Red": "aligned", "NIR": "predicted"}
    assert result["NIR"].mapping.parallax is not None
    # The RMS of the motion is 1 px; at depth edges the windows show more.
    assert 0.5 < result["NIR"].prediction.std_px < 2.5
    # The relief is that of the other bands: its noise is not larger than without this band.
    assert all(np.median(boxes.error_px(name, result[name].mapping)) < 0.12 for name in ("Blue", "Red"))


@pytest.mark.parametrize("kind", ["unrelated", in_full_run("scrambled"), in_full_run("noise")])
def test_unrelated_bands_are_not_aligned(boxes: Rendered, kind: str) -> None:
    images = {b.name: foreign(boxes.images[b.name], kind, n) for n, b in enumerate(MOVING)}
    assert aligned_by_relief(boxes.refined(images), "always")[0] == {}
