"""Scenes with depth are rendered where their truth has them, and are read as captures of a RedEdge."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_flights.depth import CLOSE_RANGE, Scene, Truth, truth_of, view, write_capture
from synthetic_flights.materials import make_textures
from synthetic_flights.patches import Eye, Patch, boxes_of, nearest
from synthetic_flights.relief import FOOLING, GEOMETRIES, fooling, make_scene

from agalign.cameras import rig_seed
from agalign.cameras.discover import discover
from agalign.pixels.structure import structure_field
from agalign.synthetic.flight import recorded
from agalign.synthetic.rig import CameraSpec, Pose, to_plane
from agalign.values import geometry
from agalign.values.image import Raster
from agalign.verify.residuals import FixedWindows

SIZE = 320, 240
STRAIGHT = replace(
    CLOSE_RANGE,
    bands=tuple(
        replace(b, rig_degrees=(0.0, 0.0, 0.0), distortion=(0.0,) * 5, centre_offset_px=(0.0, 0.0))
        for b in CLOSE_RANGE.bands
    ),
)
"""Its bands differ in their places and spectra alone."""
GREEN, NIR = (next(b for b in STRAIGHT.bands if b.name == name) for name in ("Green", "NIR"))
FOCAL_PX = GREEN.lens(*SIZE).fx_px


@pytest.fixture(scope="module")
def plants() -> Scene:
    return make_scene("plants", 3, width_px=SIZE[0])


def only(camera: CameraSpec, *names: str) -> CameraSpec:
    """The camera with Green, its reference, and some of its other bands."""
    kept = [camera.bands[camera.reference], *(b for b in camera.bands if b.name in names)]
    return replace(camera, bands=tuple(kept), reference=0)


def truth_in(scene: Scene, band: str) -> Truth:
    return truth_of(scene, SIZE, only(CLOSE_RANGE, band))


def residual_px(scene: Scene, truth: Truth, band: str) -> np.ndarray:
    """Shifts (n, 2) of windows without occlusion between the reference and a band resampled by its true mapping."""
    rng = np.random.default_rng(0)
    bands = only(CLOSE_RANGE, band).bands
    images = {b.name: recorded(view(scene, b, SIZE), b, rng).astype(np.float32) for b in bands}
    fixed = Raster(images["Green"], np.ones(SIZE[::-1], bool), None)
    known = truth.bands[band]
    there = cv2.remap(images[band], known.moving_px, None, cv2.INTER_LANCZOS4)
    windows = FixedWindows(fixed.valid, structure_field(fixed), 40, 20)
    shifts = windows.residuals(Raster(there, known.scored, None), min_valid=0.98).shifts_px
    return np.asarray(shifts[np.isfinite(shifts[:, 0])])


@pytest.mark.parametrize(
    ("kind", "band", "close"), [("plants", "NIR", True), ("boxes", "Blue", True), ("terraces", "NIR", False)]
)
def test_images_agree_with_the_truth(kind: str, band: str, close: bool) -> None:
    scene = make_scene(kind, 3, close=close, width_px=SIZE[0])
    shifts = residual_px(scene, truth_in(scene, band), band)
    assert len(shifts) > 30
    assert np.median(np.hypot(*shifts.T)) < 0.07
    assert np.abs(np.median(shifts, axis=0)).max() < 0.015


def test_disparity_is_focal_length_times_baseline_over_range(plants: Scene) -> None:
    truth = truth_of(plants, SIZE, STRAIGHT)
    here = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1)
    for band in STRAIGHT.bands:
        if band.name in truth.bands:
            # Lenses move one way, and what they see the other.
            expected = -FOCAL_PX * np.array(band.baseline_m) / truth.range_m[..., None]
            known = truth.bands[band.name]
            error = (known.moving_px - here - expected)[known.inside]
            assert np.abs(error).max() < 1e-3
    assert np.ptp(truth.range_m) > 0.2 * truth.range_m.max()


def two_layers(near_m: float, far_m: float, half_m: float) -> Scene:
    """A square above a floor, seen from straight above with rows to the east."""
    textures = make_textures(np.random.default_rng(0), 0.002, SIZE[0])
    floor = Patch((0, 0, 0), (5, 0, 0), (0, 5, 0), "soil")
    square = Patch((0, 0, near_m - far_m), (half_m, 0, 0), (0, half_m, 0), "leaf")
    return Scene("two layers", (floor, square), textures, Pose(far_m, 0, 0, 0, 0, 0))


def test_what_a_nearer_square_hides() -> None:
    near_m, far_m, half_m = 0.5, 1.5, 0.05
    truth = truth_of(two_layers(near_m, far_m, half_m), SIZE, STRAIGHT)
    half_px = FOCAL_PX * half_m / near_m
    x, y = (np.arange(n) - (n - 1) / 2 for n in SIZE)
    in_square = (np.abs(x)[None, :] < half_px) & (np.abs(y)[:, None] < half_px)
    np.testing.assert_allclose(truth.range_m, np.where(in_square, near_m, far_m), rtol=1e-6)
    for band in STRAIGHT.bands:
        if band.name in truth.bands:
            # The square's shadow from the band's lens, on the floor as the reference sees it.
            shift_x, shift_y = -FOCAL_PX * np.array(band.baseline_m) * (1 / near_m - 1 / far_m)
            shadow = (np.abs(x - shift_x)[None, :] < half_px) & (np.abs(y - shift_y)[:, None] < half_px)
            hidden = truth.bands[band.name].hidden
            np.testing.assert_array_equal(hidden, shadow & ~in_square)
            assert hidden.sum() > 200
            assert not (truth.bands[band.name].visible & hidden).any()


def test_edges_are_rendered_to_a_fraction_of_a_pixel() -> None:
    """The area of a bright square is that of its projection. It is turned: edges along the pixel axes are seen by
    samples 1/4 px apart.
    """
    scene = two_layers(1.0, 1.5, 0.1)
    lit = replace(
        scene,
        pose=replace(scene.pose, yaw_deg=20.0),
        patches=tuple(replace(p, contrast=0.0, shade=s) for p, s in zip(scene.patches, (0.0, 1.0), strict=True)),
    )
    image = view(lit, GREEN, SIZE)
    side_px = np.sqrt(image.sum() / image[SIZE[1] // 2, SIZE[0] // 2])
    assert side_px == pytest.approx(2 * FOCAL_PX * 0.1, abs=0.03)


def test_leaves_and_ellipses_have_their_shapes() -> None:
    eye = Eye(GREEN, Pose(1.0, 0, 0, 0, 0, 0), SIZE)
    for shape, area in (("rectangle", 4.0), ("ellipse", np.pi), ("leaf", 8 / 3)):
        patch = Patch((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), "leaf", shape)  # type: ignore[arg-type]
        depth, index = nearest([patch], eye, *eye.rays(), boxes_of([patch], eye))
        assert (index == 0).sum() == pytest.approx(area * (0.1 * FOCAL_PX) ** 2, rel=0.02)
        assert np.isfinite(depth).sum() == (index == 0).sum()


def test_files_are_a_capture_of_a_rededge(tmp_path: Path, plants: Scene) -> None:
    size = 160, 120
    truth = write_capture(tmp_path, plants, size_px=size)
    (capture,) = discover(tmp_path).captures
    assert (capture.camera.make, capture.camera.model) == ("MicaSense", "RedEdge-M")
    assert capture.reference.name == "Green"
    assert {b.name for b in capture.moving} == set(truth.bands) == {"Blue", "Red", "NIR", "Red edge"}
    reference = CLOSE_RANGE.bands[CLOSE_RANGE.reference]
    for band in capture.moving:
        spec = next(b for b in CLOSE_RANGE.bands if b.name == band.name)
        expected = geometry.invert(to_plane(reference, spec, size))
        assert geometry.corner_error_px(rig_seed(capture.reference, band), expected, *size) < 0.01


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_depth_of_the_kinds(kind: str) -> None:
    close, far = (truth_in(make_scene(kind, 5, close=c, width_px=SIZE[0]), "NIR") for c in (True, False))
    assert 0.5 < close.range_m.min() < close.range_m.max() < 2.3
    assert 10 < far.range_m.min() < far.range_m.max() < 25
    occluded = [t.bands["NIR"].hidden.mean() for t in (close, far)]
    if kind == "flat":
        assert occluded == [0, 0]
        assert np.ptp(close.range_m) < 0.1 * close.range_m.max()
    else:
        assert occluded[0] > 0.0002
        assert np.ptp(close.range_m) > 0.15 * close.range_m.max()


# ---- made to fool


def test_wind_moves_some_plants_and_the_truth_follows() -> None:
    scene = make_scene("wind", 3, width_px=SIZE[0])
    truth, still = (truth_in(s, "NIR") for s in (scene, replace(scene, moved_m={})))
    known, before = truth.bands["NIR"], still.bands["NIR"]
    off = np.linalg.norm(known.moving_px - before.moving_px, axis=-1)
    assert 0.01 < known.moved.mean() < 0.5
    assert off[known.moved & known.inside].min() > 0.5
    assert off[~known.moved].max() == 0
    assert not (known.scored & known.moved).any()
    assert np.median(np.hypot(*residual_px(scene, truth, "NIR").T)) < 0.07


def test_a_hand_hides_one_band() -> None:
    scene = make_scene("hand", 1, width_px=SIZE[0])
    truth = truth_of(scene, SIZE)
    (name,) = scene.hands
    hidden = {n: t.hidden.mean() for n, t in truth.bands.items()}
    assert hidden.pop(name) > 0.1 > 2 * max(hidden.values())
    spec = next(b for b in CLOSE_RANGE.bands if b.name == name)
    changed = np.abs(view(scene, spec, SIZE) - view(replace(scene, hands={}), spec, SIZE)) > 0.02
    # Pixels of the band that change, at the places where the reference's pixels are in it.
    there = cv2.remap(changed.astype(np.float32), truth.bands[name].moving_px, None, cv2.INTER_NEAREST) > 0
    assert not (there & truth.bands[name].visible).any()


def test_a_band_of_another_scene_shows_nothing_of_this_one() -> None:
    scene = make_scene("other scene", 2, width_px=SIZE[0])
    (name,) = scene.others
    known = truth_of(scene, SIZE).bands
    assert not known[name].visible.any()
    assert all(t.visible.any() for n, t in known.items() if n != name)


def test_a_band_of_another_time_is_exposed_from_elsewhere() -> None:
    scene = make_scene("other time", 4, width_px=SIZE[0])
    (name,) = scene.poses
    truth, still = (truth_in(s, name) for s in (scene, replace(scene, poses={})))
    usual = still.bands[name]
    both = truth.bands[name].visible & usual.visible
    assert np.median(np.linalg.norm(truth.bands[name].moving_px - usual.moving_px, axis=-1)[both]) > 3
    assert np.median(np.hypot(*residual_px(scene, truth, name).T)) < 0.12


def test_reflections_stay_where_the_lens_is() -> None:
    """Two lenses see the highlights of one surface at different places of it."""
    scene = make_scene("flat", 3, width_px=SIZE[0])
    glossy = replace(scene, patches=tuple(replace(p, gloss=2.0, contrast=0.0) for p in scene.patches))
    known = truth_of(glossy, SIZE, only(STRAIGHT, "NIR")).bands["NIR"]
    matte = replace(scene, patches=tuple(replace(p, contrast=0.0) for p in scene.patches))
    here, there = (
        view(glossy, b, SIZE) - view(matte, b, SIZE) for b in (GREEN, replace(NIR, soil=GREEN.soil, crop=GREEN.crop))
    )
    there = cv2.remap(there, known.moving_px, None, cv2.INTER_LINEAR)
    assert here.max() > 0.1 * GREEN.soil
    difference = np.abs(here - there)[known.visible].mean() / here[known.visible].mean()
    assert difference > 0.15


def test_pots_repeat() -> None:
    """All pots are equal: a shift by one of them finds the range again."""
    scene = make_scene("pots", 0, width_px=SIZE[0])
    upright = replace(scene, pose=replace(scene.pose, roll_deg=0.0, pitch_deg=0.0))
    tops = [p for p in upright.patches if p.material == "box" and p.shade == 1.0]
    step = np.subtract(tops[1].centre_m, tops[0].centre_m)
    assert all(p.texture_m == tops[0].texture_m for p in tops)
    pixels = np.rint(np.linalg.norm(step) * FOCAL_PX / upright.pose.altitude_m)
    assert 15 < pixels < 60


def test_fooling_scenes_take_all_kinds_in_turn() -> None:
    plan = [fooling(n) for n in range(100)]
    assert {kind for kind, _ in plan} == set(FOOLING)
    assert {(kind, True) for kind in FOOLING} | {(kind, False) for kind in FOOLING} == set(plan)


def test_an_unknown_kind() -> None:
    with pytest.raises(ValueError, match="unknown kind 'trees'; choose from flat"):
        make_scene("trees", 0)
