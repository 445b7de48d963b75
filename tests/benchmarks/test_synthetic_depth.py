"""Scenes with depth are rendered where their truth has them, and are read as captures of a RedEdge."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic_flights.depth import CLOSE_RANGE, Scene, Truth, truth_of, view
from synthetic_flights.materials import make_textures
from synthetic_flights.patches import Patch
from synthetic_flights.relief import make_scene

from agalign.fit.windows import FixedWindows
from agalign.pixels.structure import structure_field
from agalign.synthetic.cameras import CameraSpec, Pose
from agalign.synthetic.flight import recorded
from agalign.values.image import Raster

pytestmark = pytest.mark.full

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


def test_pixels_behind_a_nearer_square_are_occluded() -> None:
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
