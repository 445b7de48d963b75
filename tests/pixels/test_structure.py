import cv2
import numpy as np
import pytest

from agalign.pixels.band_resampling import shrink, textured
from agalign.pixels.structure import (
    correlation_surfaces,
    find_peak,
    gradient_magnitude,
    structure_field,
    windowed_spectra,
)
from agalign.values.image import Raster

from ..builders import texture, whole
from ..conftest import textured_image

IMAGE = texture(320, 240)


def test_contrast_reversal_does_not_change_the_field() -> None:
    np.testing.assert_allclose(structure_field(IMAGE), structure_field(whole(-IMAGE.pixels)), atol=1e-5)


@pytest.mark.parametrize("shift", [(7.0, -4.0), (-20.5, 11.25)])
def test_the_peak_is_at_the_shift(shift: tuple[float, float]) -> None:
    big = textured_image(480, 400)
    matrix = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    moved = -cv2.warpAffine(big, matrix, (480, 400), flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP)
    crop = np.s_[80:320, 80:400]
    fields = [structure_field(whole(i[crop])) for i in (big, moved)]
    peak = find_peak(correlation_surfaces(*map(windowed_spectra, fields)), 16)
    # With cv2.WARP_INVERSE_MAP, moved(p) = big(p - shift): content at p is moved to p + shift.
    np.testing.assert_allclose(peak.shift_px, shift, atol=0.15)
    assert peak.sigma > 3 * peak.runner_up_sigma


def test_unrelated_images_have_no_significant_peak() -> None:
    fields = [structure_field(texture(320, 240, s)) for s in (1, 2)]
    peak = find_peak(correlation_surfaces(*map(windowed_spectra, fields)), 16)
    assert peak.sigma < 8
    assert peak.sigma < 1.4 * peak.runner_up_sigma


def test_invalid_pixels_leave_no_edge() -> None:
    valid = np.ones((240, 320), bool)
    valid[100:140, 100:180] = False
    holed = structure_field(Raster(np.where(valid, IMAGE.pixels, np.float32(-50)), valid))
    assert np.abs(holed[~valid]).max() == 0
    far = cv2.erode(valid.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    assert np.abs(holed - structure_field(IMAGE))[far].mean() < 0.02


def test_shrinking_averages_and_keeps_invalid_pixels_out() -> None:
    pixels = np.arange(64, dtype=np.float32).reshape(8, 8)
    valid = np.ones((8, 8), bool)
    valid[0, 0] = False
    small = shrink(Raster(pixels, valid), (4, 4))
    assert not small.valid[0, 0]
    assert small.valid.sum() == 15
    assert small.pixels[1, 1] == pytest.approx(pixels[2:4, 2:4].mean())


def test_textured() -> None:
    assert textured(IMAGE)
    assert not textured(whole(np.full((240, 320), 7, np.float32)))
    assert not textured(Raster(IMAGE.pixels, ~IMAGE.valid))


def at_offset(image: np.ndarray, offset: int) -> np.ndarray:
    """Return a copy of an image at an offset in bytes from a multiple of 128 in memory."""
    room = np.empty(image.nbytes + 256, np.uint8)
    start = -room.ctypes.data % 128 + offset
    placed = room[start : start + image.nbytes].view(image.dtype).reshape(image.shape)
    placed[...] = image
    return placed


def test_the_magnitude_does_not_depend_on_memory_alignment() -> None:
    gx, gy = textured_image(471, 353, 1), textured_image(471, 353, 2)
    result = {gradient_magnitude(at_offset(gx, k), at_offset(gy, (5 * k) % 128)).tobytes() for k in range(0, 128, 4)}
    assert len(result) == 1
    np.testing.assert_allclose(gradient_magnitude(gx, gy), cv2.magnitude(gx, gy), atol=1e-5)
