"""The mapping of an alignment: all ways to evaluate one agree, and images of any type are resampled by all of it."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from agalign.errors import InputError
from agalign.synthetic import cameras
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, Seed
from agalign.values.choices import Interpolation
from agalign.values.image import Tile
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

SIZE = 320, 240
WHOLE = Tile(0, 0, *SIZE)
H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [2e-5, -4e-5, 1.0]])
FIXED, MOVING = (cameras.BANDS[k].lens(*SIZE) for k in (1, 3))
BASELINE = 0.8, -0.6


def pixels(tile: Tile = WHOLE) -> np.ndarray:
    x, y = np.arange(tile.x0, tile.x0 + tile.width), np.arange(tile.y0, tile.y0 + tile.height)
    return np.stack(np.meshgrid(x, y), axis=-1).astype(float)


def relief(z: np.ndarray) -> Relief:
    return Relief(z.astype(np.float32), np.ones_like(z, np.float32))


def waves(amplitude_px: float, period_px: float, step_px: float = 48.0) -> DisplacementField:
    """A smooth field over the image."""
    x, y = np.meshgrid(*(np.arange(0, n + step_px, step_px) for n in SIZE))
    at = 2 * np.pi / period_px
    return DisplacementField(step_px, amplitude_px * np.stack([np.sin(at * y), np.cos(at * x)], axis=-1))


X, Y = np.moveaxis(pixels(), -1, 0)
STEPPED = 0.01 * X - 0.004 * Y
"""A sloping ground with two boxes, one of them near the border."""
STEPPED[80:120, 80:160] = 12
STEPPED[-40:, -60:] = -7
HIDDEN = np.zeros(SIZE[::-1], bool)
HIDDEN[50:80, 160:173] = True
HIDDEN[20:40, 30:60] = True
MAPPING = PixelMapping(H, FIXED, MOVING, parallax=Parallax(relief(STEPPED), BASELINE, HIDDEN))
FIELD = waves(1.5, 160.0)
HILL = Parallax(relief(8.0 * np.exp(-((X - 160) ** 2 + (Y - 120) ** 2) / 2 / 50**2)), BASELINE)
MAPPINGS = {
    "homography": PixelMapping(H),
    "lenses": PixelMapping(H, FIXED, MOVING),
    "field": PixelMapping(H, FIXED, MOVING, field=FIELD),
    "relief": PixelMapping(H, FIXED, MOVING, parallax=HILL),
    "relief and field": PixelMapping(H, FIXED, MOVING, field=FIELD, parallax=HILL),
}


@pytest.mark.parametrize("mapping", [MAPPING, PixelMapping(H, None, MOVING), *MAPPINGS.values()])
def test_positions_of_a_tile_are_those_of_its_pixels(mapping: PixelMapping) -> None:
    max_px = 0.01 if mapping.field is FIELD else 0.004
    for tile in (Tile(30, 40, 1, 1), Tile(-5, -3, 70, 60), Tile(280, 210, 60, 50)):
        assert np.abs(mapping.positions(tile) - mapping(pixels(tile))).max() < max_px
    # Equal to the last bit in every tile, because OpenCV's Lanczos kernel rounds positions.
    whole, part = (mapping.positions(tile, np.float32, SIZE) for tile in (WHOLE, Tile(34, 2, 229, 201)))
    np.testing.assert_array_equal(part, whole[2:203, 34:263])
    assert np.abs(whole - mapping(pixels())).max() < max_px


@pytest.mark.parametrize("step", [1.0, 1.37])
def test_positions_between_pixels(step: float) -> None:
    x, y = np.arange(50.5, 170, step), np.arange(60.25, 130, step)
    assert np.abs(MAPPING.at_crossings(x, y) - MAPPING(np.stack(np.meshgrid(x, y), axis=-1))).max() < 0.002


def test_the_displacements_of_lenses_and_the_parallax_add_up_before_the_homography() -> None:
    """The parallax is that of the raw pixel, not of the displaced one."""
    off = np.array([0.7, -0.4])
    mapping = replace(MAPPING, field=DisplacementField(96.0, np.broadcast_to(off, (6, 8, 2)).copy()))
    edge = np.array([80.0, 100.0])  # the left edge of the box
    plane = lens.undistort(FIXED, edge + off)
    for each, expected in ((mapping, plane + 12 * np.array(BASELINE)), (mapping.without_parallax, plane)):
        np.testing.assert_allclose(each(edge), lens.distort(MOVING, geometry.apply(H, expected)), atol=1e-6)
    assert mapping.without_parallax.parallax is None


def test_a_displacement_field_is_that_of_cubic_splines_and_beyond_the_image_that_of_the_edge() -> None:
    nodes = FIELD.displacements_px
    points = np.random.default_rng(1).uniform((-60, -60), (SIZE[0] + 200, SIZE[1] + 200), (500, 2))
    rows_columns = points[:, ::-1].T / FIELD.step_px
    expected = [map_coordinates(plane, rows_columns, order=3, mode="nearest") for plane in np.moveaxis(nodes, -1, 0)]
    np.testing.assert_array_equal(FIELD(points), np.transpose(expected))
    np.testing.assert_allclose(FIELD(np.array([[96.0, 48.0], [-5000.0, 48.0]])), nodes[1, [2, 0]], atol=1e-5)


@pytest.mark.parametrize(
    ("fixed", "moving"), [((0.5, 0.5), (0.25, 0.25)), ((2.0, 2.0), (1.5, 1.5)), ((0.55, 0.83), (1, 1))]
)
def test_rescaled_maps_the_same_ground(fixed: tuple[float, float], moving: tuple[float, float]) -> None:
    fixed_scale, moving_scale = PixelScale(*fixed), PixelScale(*moving)
    scaled = MAPPING.rescaled(fixed_scale, moving_scale)
    points = pixels()[7::13, 5::11]
    expected = moving_scale.positions(MAPPING(points))
    np.testing.assert_allclose(scaled(fixed_scale.positions(points)), expected, atol=1e-4)
    again = scaled.rescaled(fixed_scale.inverse, moving_scale.inverse)
    np.testing.assert_allclose(again(points), MAPPING(points), atol=1e-4)


def test_from_undistorted_pixels() -> None:
    rectified = MAPPING.from_undistorted(FIXED)
    points = pixels()[3::17, 4::19]
    np.testing.assert_allclose(rectified(points), MAPPING(lens.distort(FIXED, points)), atol=1e-6)
    tile = Tile(20, 10, 165, 120)
    assert np.abs(rectified.positions(tile) - rectified(pixels(tile))).max() < 0.003
    # The mask is one of raw pixels as well.
    raw = np.rint(lens.distort(FIXED, pixels(tile))).astype(int)
    np.testing.assert_array_equal(rectified.hidden(tile), HIDDEN[raw[..., 1], raw[..., 0]])


def test_hidden_is_that_of_the_nearest_pixel() -> None:
    np.testing.assert_array_equal(MAPPING.hidden(WHOLE), HIDDEN)
    tile = Tile(150, 45, 40, 30)
    np.testing.assert_array_equal(MAPPING.hidden(tile), HIDDEN[45:75, 150:190])
    doubled = MAPPING.rescaled(PixelScale(2, 2), SAME_PIXELS)
    expected = HIDDEN.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_array_equal(doubled.hidden(Tile(0, 0, 640, 480)), expected)
    assert not replace(MAPPING, parallax=replace(MAPPING.parallax, hidden=None)).hidden(tile).any()
    assert not MAPPING.without_parallax.hidden(tile).any()


def test_beyond_the_image_the_parallax_and_the_mask_are_those_of_the_edge() -> None:
    stepped = relief(STEPPED)
    np.testing.assert_allclose(stepped(np.array([[340.0, 235.0], [-9.0, 0.0]])), [-7, 0], atol=1e-5)
    x, y = np.arange(310.0, 340), np.arange(220.0, 250)
    expected = stepped(np.stack(np.meshgrid(x, y), axis=-1))
    np.testing.assert_allclose(stepped.at_crossings(x, y), expected, atol=2e-3)
    hidden = np.zeros((4, 5), bool)
    hidden[-1, -1] = True
    at = np.array([[9.0, 9.0], [-3.0, 2.0]])
    assert Parallax(relief(hidden), BASELINE, hidden).hides(*at.T).tolist() == [True, False]


def test_a_relief_of_fewer_pixels_is_one_of_the_whole_image() -> None:
    """Its parallax stays in px of the image."""
    x = np.broadcast_to(np.arange(320), (240, 320))
    ramp = Relief(x.astype(np.float32), np.ones_like(x, np.float32), PixelScale(0.5, 0.5))
    # Pixel 100 of the raster covers the pixels 200 and 201.
    assert ramp(np.array([200.5, 40.0])) == pytest.approx(100, abs=1e-4)
    np.testing.assert_allclose(
        ramp.at_crossings(np.array([200.5, 201.5]), np.array([3.0, 4.0])), [[100, 100.5]] * 2, atol=0.02
    )
    assert ramp.negated(np.array([200.5, 40.0])) == pytest.approx(-100, abs=1e-4)


# ---- resampled images


def alignment(mapping: PixelMapping, size_px: tuple[int, int] = SIZE) -> Alignment:
    return Alignment(mapping, size_px, (), Seed("user", mapping.fixed_to_moving, 0.0))


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
    visible = replace(MAPPING, parallax=replace(MAPPING.parallax, hidden=None))
    (_, not_hidden), (_, valid) = (alignment(mapping).warp(scene(pixels())) for mapping in (MAPPING, visible))
    np.testing.assert_array_equal(not_hidden, valid & ~HIDDEN)


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
    assert not mapping.is_smooth(WHOLE)
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
    with pytest.raises(InputError, match=r"nodata is 1e\+300, which float32 cannot hold"):
        result.warp(np.zeros(SIZE[::-1], np.float32), nodata=1e300)
    assert result.warp(np.zeros(SIZE[::-1], np.float32), nodata=-3.40282346638529e38)[1].any()  # as GDAL rounds it


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
    points = pixels()[::2, ::2]
    inverted = result.inverse(points)
    known = np.isfinite(inverted).all(axis=-1)
    assert known[:30].all()
    assert 0.05 < (~known).mean() < 0.7
    np.testing.assert_allclose(result.map(inverted[known]), points[known], atol=0.05)
