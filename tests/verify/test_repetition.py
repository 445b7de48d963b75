import cv2
import numpy as np
import pytest

import agalign
from agalign.pixels.structure import structure_field, windowed_spectra
from agalign.values import geometry
from agalign.verify.checks import alias_peak

from ..builders import texture, whole

PERIOD = 26.0
TRUTH = geometry.translation(9.0, -6.0)


def planted(shift: tuple[float, float], seed: int, sign: float = 1.0) -> np.ndarray:
    """Two images (300, 400) of plants on a grid, from different positions, with independent noise."""
    y, x = np.mgrid[:300, :400].astype(np.float64)
    across, along = (np.cos(2 * np.pi * (v - s) / PERIOD) for v, s in zip((x, y), shift, strict=True))
    plants = np.exp(3 * (across + along) - 6)
    noise = np.random.default_rng(seed).normal(size=plants.shape)
    return (sign * plants / plants.std() + 0.1 * noise).astype(np.float32)


def test_a_unique_scene_has_no_alias_peak() -> None:
    image = texture(400, 300)
    views = image, whole(cv2.GaussianBlur(-image.pixels, (0, 0), 0.7))
    assert alias_peak(*(windowed_spectra(structure_field(view)) for view in views)).ratio < 0.4


IMAGES = planted((0, 0), 1), planted((9.0, -6.0), 2, -0.7)


@pytest.mark.parametrize("off", [(2.0, 1.0), (PERIOD, 0.0)])
def test_a_repetitive_scene_without_prior_information_is_not_aligned(off: tuple[float, float]) -> None:
    result = agalign.align(*IMAGES, seed=geometry.compose(TRUTH, geometry.translation(*off)))
    assert result.status != "aligned"
    assert result.issues[0].code == "repeats"
    assert "px fits nearly as well" in (result.reason or "")


def test_a_seed_with_an_error_below_half_a_period_resolves_aliases() -> None:
    near = geometry.compose(TRUTH, geometry.translation(3.0, 2.0))
    result = agalign.align(*IMAGES, seed=near, seed_std_px=3.0)
    assert result.status == "aligned"
    assert geometry.corner_error_px(result.fixed_to_moving, TRUTH, 400, 300) < 1.0
