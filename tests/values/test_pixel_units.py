"""The scale between two pixel grids."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from agalign.values import geometry
from agalign.values.pixel_units import SAME_PIXELS, PixelScale


def test_a_scale_maps_outer_edges_onto_outer_edges() -> None:
    scale = PixelScale.between((200, 100), (50, 20))
    edges = np.array([[-0.5, -0.5], [199.5, 99.5]])
    assert_allclose(scale.positions(edges), [[-0.5, -0.5], [49.5, 19.5]])
    assert_allclose(scale.inverse.positions(scale.positions(edges)), edges)
    assert_allclose(geometry.apply(geometry.overlay((200, 100), (50, 20)), edges), scale.positions(edges))
    assert_allclose(scale.displacements([4.0, 5.0]), [1.0, 1.0])
    assert scale.mean == pytest.approx(np.sqrt(0.25 * 0.2))


def test_a_scale_is_that_of_an_image_resize() -> None:
    """A resized ramp holds at each pixel the position that the scale gives."""
    ramp = np.tile(np.arange(80, dtype=np.float32), (40, 1))
    small = cv2.resize(ramp, (20, 10), interpolation=cv2.INTER_AREA)
    columns = PixelScale.between((80, 40), (20, 10)).inverse.positions([[x, 0.0] for x in range(20)])[:, 0]
    assert_allclose(small[5], columns, atol=1e-5)


def test_scales_relative_to_one_image_give_the_scale_between_two() -> None:
    half, third = PixelScale(0.5, 0.25), PixelScale(2.0, 3.0)
    point = np.array([7.0, 9.0])
    assert_allclose(half.over(third).positions(third.positions(point)), half.positions(point))
    assert SAME_PIXELS.over(half) == half.inverse
