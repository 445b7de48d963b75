"""Rasters, pairs and results that the tests of several packages build."""

from collections.abc import Callable, Iterable, Mapping
from functools import cache

import cv2
import numpy as np
import pytest

from agalign.batch.capture_task import quiet
from agalign.capture.align_bands import CaptureEstimation
from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand
from agalign.capture.decision import decide
from agalign.capture.reference import Reference
from agalign.config import Settings
from agalign.values.alignment import Alignment, JointResult, Seed
from agalign.values.image import Raster
from agalign.values.issues import Issue
from agalign.values.lens import Lens
from agalign.values.residual import Residual

from .conftest import textured_image, textured_pair


def whole(image: np.ndarray, lens: Lens | None = None) -> Raster:
    """A raster of valid pixels only."""
    return Raster(image, np.ones(image.shape[-2:], bool), lens)


def texture(width: int = 400, height: int = 320, seed: int = 0) -> Raster:
    return whole(textured_image(width, height, seed))


def two_views(matrix: np.ndarray, width: int = 400, height: int = 320, seed: int = 0) -> list[Raster]:
    """The fixed and the moving view of `textured_pair`, painted once in a process."""
    return [whole(image.copy()) for image in _painted(tuple(map(float, np.ravel(matrix))), width, height, seed)]


@cache
def _painted(matrix: tuple[float, ...], width: int, height: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    return textured_pair(np.reshape(matrix, (3, 3)), width, height, seed)


def pair_of(
    fixed: Raster, moving: Raster, candidates: Mapping[str, np.ndarray] | None = None, **std_px: float
) -> BandPair:
    """A pair with candidates for its mapping, by default the identity, and their standard errors."""
    return BandPair("moving", Reference(fixed), moving, candidates or {"identity": np.eye(3)}, seed_std_px=std_px)


def joint_result(
    matrix: np.ndarray | None = None, *, std_px: float = 0.05, covariance: np.ndarray | None = None, **changes: object
) -> JointResult:
    """A result of the joint optimisation that passes verification."""
    facts = {"loss": 0.1, "retrieval": 0.9, "chance": 0.004, "iterations": 0, "levels": (1.0,), "recipe": "fast"}
    facts |= {"model_family": "homography", "last_step_px": 0.01, "corner_std_xy_px": ((std_px, std_px),) * 4}
    return JointResult(np.eye(3) if matrix is None else matrix, **facts | changes, corner_covariance_px2=covariance)


def decided(pair: BandPair, seed: Seed, candidates: Iterable[Candidate] = (), issue: Issue | None = None) -> Alignment:
    """The alignment that one band gets with these candidates, without a relief and a rig."""
    (result,) = decide([BandCandidates(pair, seed, issue, list(candidates))]).values()
    return result


def estimation_of(band: BandCandidates, refined: RefinedBand | None = None) -> CaptureEstimation:
    """The estimation of a capture with one moving band, without model."""
    band.refined = refined or band.refined
    return CaptureEstimation(Settings(), None, quiet, bands={band.pair.name: band})


def fitted_to_windows(band: BandCandidates, refined: RefinedBand | None = None) -> Alignment:
    """The alignment of a band after the estimators that are fitted to windows."""
    estimation = estimation_of(band, refined)
    result = estimation._fit_windows(estimation.decided())
    return estimation._add_errors_of_relief(result)[band.pair.name]


def residual_of(centres_px: np.ndarray, shifts_px: np.ndarray, sigma: float = 20.0) -> Residual:
    """Windows with shifts (n, 2) or one shift (2,), and peaks of equal height."""
    shifts_px = np.broadcast_to(np.asarray(shifts_px, float), np.shape(centres_px)).copy()
    columns_and_rows = [np.unique(along, return_inverse=True)[1] for along in np.reshape(centres_px, (-1, 2)).T]
    return Residual(centres_px, shifts_px, np.full(len(centres_px), sigma), np.stack(columns_and_rows, axis=1))


def grid_px(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 2) all positions (x, y), row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(float)


def rms(vectors: np.ndarray) -> float:
    """Root mean square length of vectors (n, 2)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def displaced_views(displacement: Callable[[np.ndarray], np.ndarray]) -> list[Raster]:
    """Views of 640 x 480 px in which the moving image shows at x + d(x) what the fixed one shows at x."""
    fixed, moving = two_views(np.eye(3), 640, 480, seed=4)
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1)
    # Two iterations invert x + d(x).
    back = (grid - displacement(grid - displacement(grid))).astype(np.float32)
    return [fixed, whole(cv2.remap(moving.pixels, back, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT))]


def in_full_run(*values: object) -> object:
    """Values of a parametrised test that the default run leaves out."""
    return pytest.param(*values, marks=pytest.mark.full)
