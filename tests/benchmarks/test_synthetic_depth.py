"""Scenes with depth are rendered where their truth has them, and are read as captures of a RedEdge."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic_flights.depth import CLOSE_RANGE, Scene, Truth, truth_of, view
from synthetic_flights.patches import Patch, make_textures
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
    windows.min_valid = 0.98
    shifts = windows.residuals(Raster(there, known.scored, None)).shifts_px
    return np.asarray(shifts[np.isfinite(shifts[:, 0])])


@pytest.mark.parametrize(
    ("kind", "band", "close"), [("plants", "NIR", True), ("boxes", "Blue", True), ("terraces", "NIR", False)]
)
def test_images_agree_with_the_truth(kind: str, band: str, close: bool) -> None:
    scene = make_scene(kind, 3, close=close, width_px=SIZE[0])
    shifts = residual_px(scene, truth_in(scene, band), band)
    assert len(shifts) > 20
    assert np.median(np.hypot(*shifts.T)) < 0.07
    assert np.abs(np.median(shifts, axis=0)).max() < 0.015


def test_parallax_and_occlusion_of_a_square_above_a_floor() -> None:
    """Seen from straight above with rows to the east."""
    near_m, far_m, half_m = 0.5, 1.5, 0.05
    floor = Patch((0, 0, 0), (5, 0, 0), (0, 5, 0), "soil")
    square = Patch((0, 0, near_m - far_m), (half_m, 0, 0), (0, half_m, 0), "leaf")
    textures = make_textures(np.random.default_rng(0), 0.002, SIZE[0])
    truth = truth_of(Scene((floor, square), textures, Pose(far_m, 0, 0, 0, 0, 0)), SIZE, STRAIGHT)
    focal_px = STRAIGHT.bands[0].lens(*SIZE).fx_px
    half_px = focal_px * half_m / near_m
    x, y = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SIZE))
    in_square = (np.abs(x) < half_px) & (np.abs(y) < half_px)
    np.testing.assert_allclose(truth.range_m, np.where(in_square, near_m, far_m), rtol=1e-6)
    here = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1)
    for band in (b for b in STRAIGHT.bands if b.name in truth.bands):
        known = truth.bands[band.name]
        # Lenses move one way, and what they see the other.
        parallax_px = -focal_px * np.array(band.baseline_m) / truth.range_m[..., None]
        assert np.abs(known.moving_px - here - parallax_px)[known.inside].max() < 1e-3
        # The square's shadow from the band's lens, on the floor as the reference sees it.
        shift_x, shift_y = -focal_px * np.array(band.baseline_m) * (1 / near_m - 1 / far_m)
        shadow = (np.abs(x - shift_x) < half_px) & (np.abs(y - shift_y) < half_px)
        np.testing.assert_array_equal(known.hidden, shadow & ~in_square)
        assert known.hidden.sum() > 200
        assert not (known.visible & known.hidden).any()


# ---- made to fool


def test_wind_moves_some_plants_and_the_truth_follows() -> None:
    scene = make_scene("wind", 3, width_px=SIZE[0])
    truth, still = (truth_in(s, "NIR") for s in (scene, replace(scene, moved_m={})))
    known = truth.bands["NIR"]
    off = np.linalg.norm(known.moving_px - still.bands["NIR"].moving_px, axis=-1)
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
