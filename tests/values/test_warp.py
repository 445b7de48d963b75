"""An alignment resamples images of any type and layout by its complete mapping, and inverts it."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from agalign.errors import InputError
from agalign.synthetic import cameras
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.choices import Interpolation
from agalign.values.image import Tile
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief

SIZE = 320, 240
H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [2e-5, -4e-5, 1.0]])
FIXED, MOVING = (cameras.BANDS[k].lens(*SIZE) for k in (1, 3))


def waves(amplitude_px: float, period_px: float, step_px: float = 48.0) -> DisplacementField:
    """A smooth field over the image."""
    x, y = np.meshgrid(*(np.arange(0, n + step_px, step_px) for n in SIZE))
    at = 2 * np.pi / period_px
    return DisplacementField(step_px, amplitude_px * np.stack([np.sin(at * y), np.cos(at * x)], axis=-1))


def hill(height_px: float) -> Relief:
    x, y = np.meshgrid(*(np.arange(n) for n in SIZE))
    z = height_px * np.exp(-((x - 160) ** 2 + (y - 120) ** 2) / 2 / 50**2)
    return Relief(z.astype(np.float32), np.ones_like(z, np.float32))


FIELD, HILL = waves(1.5, 160.0), Parallax(hill(8.0), (0.8, -0.6))
MAPPINGS = {
    "homography": PixelMapping(H),
    "lenses": PixelMapping(H, FIXED, MOVING),
    "field": PixelMapping(H, FIXED, MOVING, field=FIELD),
    "relief": PixelMapping(H, FIXED, MOVING, parallax=HILL),
    "relief and field": PixelMapping(H, FIXED, MOVING, field=FIELD, parallax=HILL),
}


def alignment(mapping: PixelMapping, size_px: tuple[int, int] = SIZE) -> Alignment:
    return Alignment(mapping, size_px, "aligned", (), Seed("user", mapping.fixed_to_moving, 0.0))


def pixels(size_px: tuple[int, int] = SIZE) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in size_px)), axis=-1).astype(float)


def scene(points: np.ndarray) -> np.ndarray:
    """Known everywhere, -1 to 1, with details of 30 px."""
    return np.asarray(np.sin(points[..., 0] / 7) * np.cos(points[..., 1] / 9))


@pytest.mark.parametrize("kind", list(MAPPINGS))
def test_pixels_are_resampled_by_the_complete_mapping(kind: str) -> None:
    result = alignment(MAPPINGS[kind])
    warped, valid = result.warp(scene(pixels()).astype(np.float32))
    moving_px = result.map(pixels())
    inside = ((moving_px >= 0.01) & (moving_px <= np.subtract(SIZE, 1.01))).all(axis=-1)
    assert valid[inside].all()
    assert not valid[((moving_px < -0.01) | (moving_px > np.subtract(SIZE, 0.99))).any(axis=-1)].any()
    assert np.isnan(warped[~valid]).all()
    assert np.abs(warped - scene(moving_px))[valid].max() < 0.005
    assert result.geometry == ("homography" if kind == "lenses" else kind)


@pytest.mark.parametrize("shape", ["(H, W, C)", "(C, H, W)"])
def test_the_layout_of_channels_is_kept(shape: str) -> None:
    result, channels = alignment(MAPPINGS["field"]), (1.0, -2.0, 0.5)
    axis = -1 if shape == "(H, W, C)" else 0
    one, valid = result.warp(scene(pixels()))
    several, several_valid = result.warp(np.stack([k * scene(pixels()) for k in channels], axis))
    np.testing.assert_allclose(several, np.stack([k * one for k in channels], axis), atol=1e-9)
    np.testing.assert_array_equal(several_valid, valid)


@pytest.mark.parametrize(
    ("dtype", "gain", "offset"), [("uint8", 100, 128), ("uint16", 3e4, 32000), ("int32", 1e9, 0), ("float64", 1e12, 0)]
)
def test_the_type_is_kept(dtype: str, gain: float, offset: float) -> None:
    result = alignment(MAPPINGS["field"])
    warped, valid = result.warp((gain * scene(pixels()) + offset).astype(dtype))
    assert warped.dtype == dtype
    assert valid.mean() > 0.9
    expected = gain * scene(result.map(pixels())) + offset
    assert np.abs(warped.astype(np.float64) - expected)[valid].max() < 0.005 * gain + 1.5
    assert (np.isnan(warped[~valid]) if dtype == "float64" else warped[~valid] == 0).all()


@pytest.mark.parametrize("dtype", ["int32", "float64"])
def test_types_of_more_than_24_bits_are_not_rounded(dtype: str) -> None:
    """16,777,217 is the first integer that float32 does not have."""
    image, shift = np.full(SIZE[::-1], 16_777_217, dtype), alignment(PixelMapping(geometry.translation(3, 2)))
    for interpolation in ("nearest", "bilinear"):
        warped, valid = shift.warp(image, interpolation=interpolation)
        assert (warped[valid] == 16_777_217).all()


@pytest.mark.parametrize("interpolation", get_args(Interpolation))
def test_masks_are_resampled(interpolation: Interpolation) -> None:
    result = alignment(MAPPINGS["field"])
    warped, valid = result.warp(scene(pixels()) > 0, interpolation=interpolation)
    assert warped.dtype == bool
    expected = scene(result.map(pixels()))
    clear = valid & (np.abs(expected) > 0.15)
    np.testing.assert_array_equal(warped[clear], expected[clear] > 0)
    assert not warped[~valid].any()


@pytest.mark.parametrize("unusable", ["nan", "nodata", "valid"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear", "lanczos"])
def test_unusable_pixels_are_never_used(unusable: str, interpolation: str) -> None:
    """Here in the second of two channels; they are 1000 times as bright as the others."""
    hole = np.zeros(SIZE[::-1], bool)
    hole[100:120, 140:170] = True
    image = np.stack([scene(pixels()), scene(pixels())])
    image[1, hole] = np.nan if unusable == "nan" else 1000.0
    options: dict[str, object] = {"nodata": {"nodata": 1000.0}, "valid": {"valid": ~hole}}.get(unusable, {})
    result = alignment(MAPPINGS["field"])
    warped, valid = result.warp(image, interpolation=interpolation, **options)
    x, y = np.rint(result.map(pixels())).astype(int).transpose(2, 0, 1)
    inside = (x >= 0) & (x < SIZE[0]) & (y >= 0) & (y < SIZE[1])
    in_hole = np.zeros_like(inside)
    in_hole[inside] = hole[y[inside], x[inside]]
    assert in_hole.sum() > 500
    assert not valid[in_hole].any()
    assert valid[~in_hole & inside].mean() > 0.98
    max_error = 0.05 if interpolation == "lanczos" else 0.15
    assert np.abs(warped[:, valid] - scene(result.map(pixels()))[valid]).max() < max_error
    filled = warped[:, ~valid]
    assert ((filled == 1000.0) if unusable == "nodata" else np.isnan(filled)).all()


def test_occluded_pixels_are_not_valid() -> None:
    hidden = np.zeros(SIZE[::-1], bool)
    hidden[100:120, 140:170] = True
    plain = alignment(MAPPINGS["relief"])
    _, valid = plain.warp(scene(pixels()))
    parallax = replace(HILL, hidden=hidden)
    _, not_hidden = alignment(plain.mapping.with_parallax(parallax)).warp(scene(pixels()))
    np.testing.assert_array_equal(not_hidden, valid & ~hidden)


@pytest.mark.parametrize("scale", [1.0, 40.0])
def test_images_wider_than_opencv_resamples(scale: float) -> None:
    """Its limit is 32,767 px, and float32 positions beyond are coarse. A scale of 40 needs a window of that width."""
    moving = np.tile(np.arange(40_000, dtype=np.float32) % 1000, (40, 1))
    width = int(40_000 / scale)
    mapping = PixelMapping(np.array([[scale, 0.0, 5.302], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]]))
    warped, valid = alignment(mapping, (width, 40)).warp(moving, interpolation="bilinear")
    expected = (np.arange(width) * scale + 5.302) % 1000
    assert valid[:38, : int(39_994 / scale)].all()
    assert not valid[38:].any()
    assert np.abs(warped - expected)[:38, expected < 999].max(initial=0, where=valid[:38, expected < 999]) < 0.001


def test_pixels_near_the_horizon() -> None:
    """The columns from 190 to 199 cover the whole moving image, between two coarse samples of the positions."""
    mapping = PixelMapping(np.array([[1.0, 0.0, -190.0], [0.0, 1.0, 0.0], [-1 / 200, 0.0, 1.0]]))
    assert not mapping.is_smooth(Tile(0, 0, *SIZE))
    assert mapping.is_smooth(Tile(0, 0, 199, 240))
    moving = np.tile(np.arange(900, dtype=np.float32), (900, 1))
    warped, valid = alignment(mapping).warp(moving, interpolation="bilinear")
    with np.errstate(all="ignore"):
        expected = mapping(pixels())
    assert valid[:8, 190:199].all()
    assert np.abs(warped - expected[..., 0])[valid].max() < 0.01


def test_what_cannot_be_resampled() -> None:
    result = alignment(MAPPINGS["homography"])
    with pytest.raises(InputError, match=r"valid is \(3, 3\), the image \(240, 320\)"):
        result.warp(scene(pixels()), valid=np.ones((3, 3), bool))
    with pytest.raises(InputError, match="moving must be"):
        result.warp(np.zeros(5))
    for nodata in (-9999, 0.5, np.nan):
        with pytest.raises(InputError, match=f"nodata is {nodata:g}, which uint8 cannot hold"):
            result.warp(np.zeros(SIZE[::-1], np.uint8), nodata=nodata)


@pytest.mark.parametrize("change", [np.s_[::2, ::2], np.s_[:-1], np.s_[:, 8:]], ids=["half", "height", "width"])
def test_an_image_of_another_size_is_refused(change: tuple[slice, ...]) -> None:
    """The mapping has pixels of the image that was aligned, so that others give the wrong part of the scene."""
    image = scene(pixels())
    result = replace(alignment(MAPPINGS["field"]), moving_size_px=SIZE)
    for other in (image[change], np.stack([image[change]] * 3, axis=-1), image.T, np.kron(image, np.ones((2, 2)))):
        height, width = other.shape[:2]
        with pytest.raises(InputError, match=f"{width} x {height} px, the aligned image 320 x 240 px"):
            result.warp(other)
    assert result.warp(np.stack([image] * 3))[1].mean() > 0.9


def test_positions_do_not_depend_on_the_tile() -> None:
    """To the last bit, because OpenCV's Lanczos kernel rounds them."""
    for mapping in MAPPINGS.values():
        whole = mapping.positions(Tile(0, 0, *SIZE), np.float32, SIZE)
        part = mapping.positions(Tile(34, 2, 229, 201), np.float32, SIZE)
        np.testing.assert_array_equal(part, whole[2:203, 34:263])
        assert np.abs(part - mapping(pixels())[2:203, 34:263]).max() < 0.01


# ---- inverse


@pytest.mark.parametrize("kind", list(MAPPINGS))
def test_the_inverse_of_a_mapped_pixel_is_the_pixel(kind: str) -> None:
    result, points = alignment(MAPPINGS[kind]), pixels()[::7, ::7]
    assert np.abs(result.map(points) - points).max() > 3
    np.testing.assert_allclose(result.inverse(result.map(points)), points, atol=0.01)
    np.testing.assert_allclose(result.inverse(result.map(points[3, 4])), points[3, 4], atol=0.01)


def test_the_inverse_from_undistorted_pixels_of_the_reference() -> None:
    mapping, points = MAPPINGS["field"].from_undistorted(FIXED), pixels()[20:-20:7, 20:-20:7]
    np.testing.assert_allclose(mapping.inverse(mapping(points)), points, atol=0.01)


def test_the_inverse_is_nan_where_it_does_not_converge() -> None:
    """Waves of 12 px with a period of 40 px fold the image; the upper quarter has none."""
    field = waves(12.0, 40.0, step_px=8.0)
    field.displacements_px[:14] = 0
    result = alignment(PixelMapping(geometry.identity(), field=field))
    inverted = result.inverse(pixels())
    known = np.isfinite(inverted).all(axis=-1)
    assert known[:60].all()
    assert 0.05 < (~known).mean() < 0.7
    np.testing.assert_allclose(result.map(inverted[known]), pixels()[known], atol=0.05)
