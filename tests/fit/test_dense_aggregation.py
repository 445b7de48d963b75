"""Semi-global matching, compared with a direct implementation of its definition."""

import numpy as np
import pytest

from agalign.fit.dense import MAX_LARGE, aggregated, sub_label_minimum


def by_definition(costs: np.ndarray, small: int, large: int) -> np.ndarray:
    labels, height, width = costs.shape
    total = np.zeros(costs.shape, int)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros(costs.shape, int)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                for d in range(labels):
                    path[d, y, x] = costs[d, y, x]
                    if 0 <= x - dx < width and 0 <= y - dy < height:
                        before = path[:, y - dy, x - dx]
                        steps = [before[k] + (0, small, large)[min(abs(k - d), 2)] for k in range(labels)]
                        path[d, y, x] += min(steps) - before.min()
        total += path
    return total


@pytest.mark.parametrize(
    ("labels", "small", "large"), [(5, 6, 40), (7, 3, 15), (3, 10, 10), (1, 2, 5), (6, 9, MAX_LARGE)]
)
def test_four_paths(labels: int, small: int, large: int) -> None:
    """With the highest costs that do not overflow."""
    some = np.array([0, 13, 60, 61, 255 - small - large], np.uint8)
    costs = np.random.default_rng(labels).choice(some, (labels, 6, 8))
    given = costs.copy()
    np.testing.assert_array_equal(aggregated(costs, small, large), by_definition(costs, small, large))
    np.testing.assert_array_equal(costs, given)


@pytest.mark.parametrize(
    ("costs", "label"),
    [
        ([1, 5, 9, 20], 0),
        ([20, 9, 5, 1], 3),
        ([4, 4, 4, 4], 0),  # no minimum at all
        ([9, 5, 5, 9], 1.5),  # halfway
        ([9, 2, 4, 2], 1 + 0.5 * 5 / 9),  # the first of two: (9 - 4) / (2 * (9 - 4 + 4))
    ],
)
def test_at_the_borders_there_is_no_parabola(costs: list[float], label: float) -> None:
    volume = np.array(costs, np.float32)[:, None, None]
    assert sub_label_minimum(volume)[0, 0] == pytest.approx(label, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_every_pixel_has_its_own_minimum(dtype: type) -> None:
    at = np.random.default_rng(0).uniform(0.6, 4.4, (5, 6))
    costs = np.round(1000 * (np.arange(6)[:, None, None] - at) ** 2 + 50).astype(dtype)
    np.testing.assert_allclose(sub_label_minimum(costs), at, atol=1e-3)
