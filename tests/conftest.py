"""Scenes that the tests generate, and the way to the real captures where they are present."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from agalign.synthetic import flight as synthetic
from agalign.values import geometry

# Each worker has a core of its own. Torch, which nothing above loads, and the programs that tests start read the
# variable; OpenCV and the libraries of numpy are loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")
threadpool_limits(1)
cv2.setNumThreads(1)

REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures; skips where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"the real captures are not at {REAL_DATA}")
    return REAL_DATA


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic flight of two small captures; truth.json lies beside the images."""
    folder = tmp_path_factory.mktemp("flight")
    synthetic.make_flight(folder, captures=2, size_px=(480, 360), rng_seed=3)
    return folder


def textured_image(width: int, height: int, seed: int = 0) -> np.ndarray:
    """A smooth random image with detail at several scales, mean 0 and standard deviation 1."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for grain in (1.5, 3.0, 8.0, 20.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), grain)
        image += layer / layer.std()
    return ((image - image.mean()) / image.std()).astype(np.float32)


def textured_pair(
    fixed_to_moving: np.ndarray, width: int = 400, height: int = 320, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """A fixed and a moving view of one texture, the moving one contrast-reversed and bent in its tones.

    Painted at three times the resolution, so that neither is an interpolation of the other.
    """
    factor, margin = 3, 60
    canvas = textured_image((width + 2 * margin) * factor, (height + 2 * margin) * factor, seed)
    canvas = cv2.GaussianBlur(canvas, (0, 0), factor / 2)
    to_canvas = np.array([[factor, 0, margin * factor + 1], [0, factor, margin * factor + 1], [0, 0, 1.0]])

    def view(pixel_to_canvas: np.ndarray) -> np.ndarray:
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(canvas, pixel_to_canvas, (width, height), flags=flags)

    fixed = view(to_canvas)
    moving = view(to_canvas @ np.linalg.inv(fixed_to_moving))
    return fixed, (-moving + 0.15 * moving**2).astype(np.float32)


def mean_error_px(one: np.ndarray, other: np.ndarray, width: int, height: int) -> float:
    """Mean distance between where two homographies send the pixels of an image."""
    points = geometry.lattice(width, height, 40, 30)
    return float(np.linalg.norm(geometry.apply(one, points) - geometry.apply(other, points), axis=1).mean())
