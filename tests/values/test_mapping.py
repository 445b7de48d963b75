"""Mappings: all ways to evaluate one agree, at any resolution and from undistorted pixels too."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.synthetic import cameras
from agalign.values import geometry, lens
from agalign.values.image import Tile
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

SIZE = 640, 480
H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [2e-5, -4e-5, 1.0]])
FIXED, MOVING = (cameras.BANDS[k].lens(*SIZE) for k in (1, 3))
BASELINE = 0.8, -0.6
HALF = PixelScale.between(SIZE, (320, 240))


def stepped(size: tuple[int, int] = SIZE, scale: PixelScale = SAME_PIXELS) -> Relief:
    """A sloping ground with two boxes, one of them near the border."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    z = 0.01 * x - 0.004 * y
    z[size[1] // 3 : size[1] // 2, size[0] // 4 : size[0] // 2] = 12
    z[-40:, -60:] = -7
    return Relief(z.astype(np.float32), np.ones_like(z, np.float32), scale)


def box_hidden() -> np.ndarray:
    hidden = np.zeros(SIZE[::-1], bool)
    hidden[100:160, 320:333] = True
    hidden[20:60, 30:80] = True
    return hidden


MAPPING = PixelMapping(H, FIXED, MOVING, parallax=Parallax(stepped(), BASELINE, box_hidden()))


def pixels(tile: Tile) -> np.ndarray:
    x, y = np.arange(tile.x0, tile.x0 + tile.width), np.arange(tile.y0, tile.y0 + tile.height)
    return np.stack(np.meshgrid(x, y), axis=-1).astype(float)


WHOLE = Tile(0, 0, *SIZE)


@pytest.mark.parametrize("tile", [WHOLE, Tile(30, 40, 1, 1), Tile(-5, -3, 70, 60), Tile(600, 450, 60, 50)])
def test_positions_of_a_tile_are_those_of_its_pixels(tile: Tile) -> None:
    for mapping in (MAPPING, PixelMapping(H), PixelMapping(H, None, MOVING)):
        assert np.abs(mapping.positions(tile) - mapping(pixels(tile))).max() < 0.002
        assert np.abs(mapping.positions(tile, np.float32) - mapping(pixels(tile))).max() < 0.002


@pytest.mark.parametrize("step", [1.0, 1.37])
def test_positions_between_pixels(step: float) -> None:
    x, y = np.arange(100.5, 330, step), np.arange(120.25, 260, step)
    assert np.abs(MAPPING.at_crossings(x, y) - MAPPING(np.stack(np.meshgrid(x, y), axis=-1))).max() < 0.002


def test_a_pixel_moves_along_the_baseline_before_the_homography() -> None:
    point = np.array([200.0, 170.0])
    undistorted = lens.undistort(FIXED, point)
    expected = lens.distort(MOVING, geometry.apply(H, undistorted + 12 * np.array(BASELINE)))
    np.testing.assert_allclose(MAPPING(point), expected, atol=1e-6)
    plane = lens.distort(MOVING, geometry.apply(H, undistorted))
    np.testing.assert_allclose(MAPPING.of_the_plane(point), plane, atol=1e-6)
    assert MAPPING.of_the_plane.parallax is None
    flat = PixelMapping(H)
    assert flat.of_the_plane is flat


@pytest.mark.parametrize(
    ("fixed", "moving"), [((0.5, 0.5), (0.25, 0.25)), ((2.0, 2.0), (1.5, 1.5)), ((0.55, 0.83), (1, 1))]
)
def test_rescaled_maps_the_same_ground(fixed: tuple[float, float], moving: tuple[float, float]) -> None:
    fixed_scale, moving_scale = PixelScale(*fixed), PixelScale(*moving)
    scaled = MAPPING.rescaled(fixed_scale, moving_scale)
    points = pixels(WHOLE)[7::13, 5::11]
    expected = moving_scale.positions(MAPPING(points))
    np.testing.assert_allclose(scaled(fixed_scale.positions(points)), expected, atol=1e-4)
    tile = Tile(20, 30, 200, 150)
    assert np.abs(scaled.positions(tile) - scaled(pixels(tile))).max() < 0.002
    again = scaled.rescaled(fixed_scale.inverse, moving_scale.inverse)
    np.testing.assert_allclose(again(points), MAPPING(points), atol=1e-4)


def test_from_undistorted_pixels() -> None:
    rectified = MAPPING.from_undistorted(FIXED)
    points = pixels(WHOLE)[3::17, 4::19]
    np.testing.assert_allclose(rectified(points), MAPPING(lens.distort(FIXED, points)), atol=1e-6)
    tile = Tile(20, 10, 330, 240)
    error = np.linalg.norm(rectified.positions(tile) - rectified(pixels(tile)), axis=-1)
    assert error.max() < 0.002
    # The mask is one of raw pixels as well.
    raw = np.rint(lens.distort(FIXED, pixels(tile))).astype(int)
    np.testing.assert_array_equal(rectified.hidden(tile), box_hidden()[raw[..., 1], raw[..., 0]])


def test_hidden_is_that_of_the_nearest_pixel() -> None:
    np.testing.assert_array_equal(MAPPING.hidden(WHOLE), box_hidden())
    tile = Tile(310, 90, 40, 30)
    np.testing.assert_array_equal(MAPPING.hidden(tile), box_hidden()[90:120, 310:350])
    doubled = MAPPING.rescaled(PixelScale(2, 2), SAME_PIXELS)
    expected = box_hidden().repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_array_equal(doubled.hidden(Tile(0, 0, 1280, 960)), expected)
    assert not replace(MAPPING, parallax=replace(MAPPING.parallax, hidden=None)).hidden(tile).any()
    assert not MAPPING.of_the_plane.hidden(tile).any()


def test_beyond_the_image_the_parallax_and_the_mask_are_those_of_the_edge() -> None:
    relief = stepped()
    np.testing.assert_allclose(relief(np.array([[700.0, 470.0], [-9.0, 0.0]])), [-7, 0], atol=1e-5)
    x, y = np.arange(630.0, 660), np.arange(460.0, 490)
    expected = relief(np.stack(np.meshgrid(x, y), axis=-1))
    np.testing.assert_allclose(relief.at_crossings(x, y), expected, atol=2e-3)
    hidden = np.zeros((4, 5), bool)
    hidden[-1, -1] = True
    at = np.array([[9.0, 9.0], [-3.0, 2.0]])
    parallax = Parallax(Relief(hidden.astype(np.float32), hidden.astype(np.float32)), BASELINE, hidden)
    assert parallax.hides(*at.T).tolist() == [True, False]


def test_a_relief_of_fewer_pixels_is_one_of_the_whole_image() -> None:
    """Its parallax stays in px of the image."""
    x = np.broadcast_to(np.arange(320), (240, 320))
    ramp = Relief(x.astype(np.float32), np.ones_like(x, np.float32), HALF)
    # Pixel 100 of the raster covers the pixels 200 and 201.
    assert ramp(np.array([200.5, 40.0])) == pytest.approx(100, abs=1e-4)
    np.testing.assert_allclose(
        ramp.at_crossings(np.array([200.5, 201.5]), np.array([3.0, 4.0])), [[100, 100.5]] * 2, atol=0.02
    )
    assert ramp.negated(np.array([200.5, 40.0])) == pytest.approx(-100, abs=1e-4)


def test_the_displacement_field_of_lenses_and_the_parallax_add_up() -> None:
    """The parallax is that of the raw pixel, not of the displaced one."""
    field = DisplacementField(96.0, np.broadcast_to(np.float64([0.7, -0.4]), (6, 8, 2)).copy())
    mapping = replace(MAPPING, field=field)
    edge = np.array([160.0, 200.0])  # the left edge of the box
    expected = lens.undistort(FIXED, edge + np.array([0.7, -0.4])) + 12 * np.array(BASELINE)
    np.testing.assert_allclose(mapping(edge), lens.distort(MOVING, geometry.apply(H, expected)), atol=1e-6)
    tile = Tile(100, 100, 240, 170)
    assert np.abs(mapping.positions(tile) - mapping(pixels(tile))).max() < 0.002
