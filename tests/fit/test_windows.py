"""Windows: shifts between masked images, and windows that share no pixels."""

import cv2
import numpy as np
import pytest

from agalign.fit.windows import FixedWindows
from agalign.pixels.structure import structure_field
from agalign.values.image import Mask, Raster

from ..conftest import textured_image

SIZE = 640, 480
SHIFT_PX = (0.4, -0.3)


def spots(share: float, seed: int = 0) -> Mask:
    """A mask (height, width) with invalid spots of about 10 px that cover a share of the image."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SIZE[::-1]), (0, 0), 5)
    return np.asarray(noise <= np.quantile(noise, 1 - share))


def measured(fixed_valid: Mask, moving_valid: Mask) -> np.ndarray:
    """Return the errors (n, 2) of the measured shifts; NaN for windows without a clear peak."""
    image = textured_image(*SIZE, seed=2)
    matrix = np.array([[1.0, 0, SHIFT_PX[0]], [0, 1, SHIFT_PX[1]]])
    moved = -cv2.warpAffine(image, matrix, SIZE, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    fixed, moving = (Raster(np.where(v, x, 0), v) for x, v in ((image, fixed_valid), (moved, moving_valid)))
    windows = FixedWindows(fixed.valid, structure_field(fixed))
    return windows.residuals(moving).shifts_px - SHIFT_PX


@pytest.mark.parametrize(("share", "max_px"), [(0.05, 0.02), (0.2, 0.055), (0.5, 0.11)])
def test_windows_keep_what_they_show_outside_a_mask(share: float, max_px: float) -> None:
    """A mask at the same pixels in both images attracts the peak to zero: by 0.023, 0.062 and 0.125 px without the
    division by the overlap.
    """
    everywhere = np.ones(SIZE[::-1], bool)
    complete = np.nanmedian(measured(everywhere, everywhere), axis=0)
    errors = measured(spots(share), spots(share))
    assert np.isfinite(errors).all(axis=1).mean() > 0.9
    assert np.abs(np.nanmedian(errors, axis=0) - complete).max() < max_px


def test_masks_of_different_pixels_do_not_bias_the_shift() -> None:
    everywhere = np.ones(SIZE[::-1], bool)
    complete, masked = (measured(*m) for m in ((everywhere, everywhere), (spots(0.2), spots(0.2, seed=1))))
    assert np.abs(np.nanmedian(masked, axis=0) - np.nanmedian(complete, axis=0)).max() < 0.02


@pytest.mark.parametrize("shift_px", [0.1, 0.2, 0.3])
def test_small_shifts_are_hardly_attracted_by_whole_pixels(shift_px: float) -> None:
    """With all frequencies, they are measured as 0.73 to 0.83 of their length."""
    side_px, rng = 360, np.random.default_rng(0)
    along = np.fft.fftfreq(side_px)
    spectrum = np.fft.fft2(rng.normal(size=(side_px, side_px))) * np.exp(
        -((1.2 * np.pi) ** 2) * np.add.outer(along**2, along**2)
    )
    images = [np.fft.ifft2(spectrum * np.exp(-2j * np.pi * x * along)).real for x in (0.0, shift_px)]
    fixed, moving = (
        Raster((x + rng.normal(0, 0.1 * x.std(), x.shape)).astype(np.float32), np.ones(x.shape, bool)) for x in images
    )
    shifts_px = FixedWindows(fixed.valid, structure_field(fixed)).residuals(moving).shifts_px
    assert np.median(shifts_px[:, 0]) == pytest.approx(shift_px, rel=0.18)


def test_windows_with_too_few_valid_pixels_are_omitted() -> None:
    assert len(measured(np.ones(SIZE[::-1], bool), spots(0.9))) == 0


@pytest.mark.parametrize("size_px", [(640, 480), (1280, 960), (448, 336), (400, 320), (250, 200)])
def test_windows_share_no_pixels_and_cover_the_image(size_px: tuple[int, int]) -> None:
    image = textured_image(*size_px)
    windows = FixedWindows(np.ones(image.shape, bool), structure_field(Raster(image, np.ones(image.shape, bool))))
    counts = np.zeros(image.shape, int)
    for x, y in windows.origins:
        counts[y : y + windows.side, x : x + windows.side] += 1
    assert counts.max() == 1
    assert counts.mean() > 0.75
