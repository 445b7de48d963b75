import numpy as np
import pytest
from synthetic_flights.troubles import PANEL_CODE, with_panel

from agalign.pixels import panel_detection as panels
from agalign.pixels.panel_detection import albedo_of, find_panel, inside
from agalign.synthetic.cameras import REDEDGE, Pose
from agalign.synthetic.flight import view
from agalign.synthetic.ground import paint_ground, reflectance
from agalign.values.image import Raster

from ..builders import whole
from ..conftest import textured_image

SIZE = 960, 720
HELD = Pose(1.0, 25.0, 2.0, -3.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def panel() -> np.ndarray:
    """Synthetic green band from one metre, rotated by 25 degrees: reflectances (720, 960)."""
    ground = with_panel(paint_ground(np.random.default_rng(0), [HELD], SIZE))
    green = REDEDGE.bands[REDEDGE.reference]
    return view(reflectance(ground, green), ground, green, HELD, SIZE)


def raster(pixels: np.ndarray) -> Raster:
    noise = np.random.default_rng(1).normal(0, 0.02, pixels.shape)
    return whole((5000 + 40000 * (pixels + noise)).astype(np.float32))


def test_a_panel_is_detected_by_its_code(panel: np.ndarray) -> None:
    result = find_panel(raster(panel))
    assert result.code == PANEL_CODE
    within = panel[inside(result.area_px, panel.shape)]
    assert len(within) > 1000
    assert within.mean() == pytest.approx(0.51, abs=0.005)
    assert within.std() < 0.01


def test_a_square_without_a_code_is_detected_only_on_request(panel: np.ndarray) -> None:
    bare = np.where(panel > 0.6, 0.05, panel)  # no label
    assert find_panel(raster(bare)) is None
    result = find_panel(raster(bare), without_code=True)
    assert result.code == ""
    assert panel[inside(result.area_px, panel.shape)].mean() == pytest.approx(0.51, abs=0.005)


TARGETS = {(0.03, 0.21, 0.45, 0.86): True, (0.45, 0.86): True, (0.2, 0.3, 0.5): True, (0.5, 0.5): False, (0.5,): False}


@pytest.mark.parametrize(("reflectances", "is_ambiguous"), TARGETS.items())
def test_of_several_squares_of_different_brightness_none_is_the_panel(
    reflectances: tuple[float, ...], is_ambiguous: bool
) -> None:
    scene = np.full((300, 400), 0.08)
    for k, reflectance_ in enumerate(reflectances):
        x, y = 140 + 60 * (k % 2), 90 + 60 * (k // 2)
        scene[y : y + 50, x : x + 50] = reflectance_
    result = find_panel(raster(scene), without_code=True)
    assert (result.is_ambiguous, result.area_px == ()) == (is_ambiguous, is_ambiguous)


@pytest.mark.parametrize(("at", "in_scene"), [((0, 0), True), ((540, 405), True), ((270, 200), False)])
def test_a_small_panel_far_from_the_centre_is_part_of_a_scene(
    panel: np.ndarray, at: tuple[int, int], in_scene: bool
) -> None:
    held = find_panel(raster(panel))
    assert not held.in_scene
    scene = np.full((1125, 1500), 0.08)
    x, y = at
    scene[y : y + SIZE[1], x : x + SIZE[0]] = panel
    result = find_panel(raster(scene))
    assert result.code == PANEL_CODE
    assert result.in_scene is in_scene


@pytest.mark.slow
def test_no_panel_is_detected_in_a_field() -> None:
    pose = Pose(28.0, 25.0, 0.0, 0.0, 0.0, 0.0)
    ground = paint_ground(np.random.default_rng(3), [pose], SIZE)
    fields = [view(reflectance(ground, band), ground, band, pose, SIZE) for band in REDEDGE.bands]
    for pixels in (*fields, 0.2 + 0.05 * textured_image(*SIZE), np.full(SIZE[::-1], 0.3)):
        assert not any(find_panel(raster(pixels), without_code=without_code) for without_code in (False, True))


def test_the_search_is_short_in_noise_and_in_a_lattice_of_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV searches noise for a code, and every square of a lattice would be measured, for seconds."""
    looked = []
    for module, name in ((panels, "_is_panel"), (panels.cv2, "QRCodeDetector")):
        function = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, f=function, n=name: (looked.append(n), f(*a))[1])
    noise = np.random.default_rng(0).normal(0.5, 0.1, (300, 400))
    assert find_panel(raster(noise), without_code=True) is None
    assert looked == []
    lattice = np.tile(np.pad(np.full((40, 40), 0.5), 8, constant_values=0.1), (6, 8))
    assert find_panel(raster(lattice), without_code=True) is not None
    assert looked == ["QRCodeDetector", "_is_panel"]


def test_codes_give_reflectance_linear_in_the_wavelength() -> None:
    """The code of a real panel; the tags of its camera have 0.5105 at 475 nm and 0.508067 at 840 nm."""
    code = "RP04-1826246-SC_04005111000507"
    assert albedo_of(code, 475.0) == pytest.approx(0.5105)
    assert albedo_of(code, 840.0) == pytest.approx(0.5080667, abs=1e-6)
    for text, nm in ((code, 1100.0), (code, None), ("https://example.org", 560.0), ("RP04-1_04005110400507", 400.0)):
        assert albedo_of(text, nm) is None
