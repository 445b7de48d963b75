"""Evaluation protocol of Dong et al. (2018): nearest neighbours of patches that the true homography maps."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agalign.method.detect import to_8_bit
from agalign.method.patches import bilinear
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import Raster


def grey_patches(raster: Raster, grid: Tensor) -> Tensor:
    """Return grey patches (N, 1, side, side) in [0, 1] at positions (N, side, side, 2) px."""
    plane = torch.from_numpy(to_8_bit(raster).astype(np.float32) / 255)
    return bilinear(plane[None], grid)


def average_precision(f: Tensor, f_prime: Tensor) -> float:
    """Return the share of descriptors (N, D) of the first image with the corresponding descriptor as exact L2 nearest
    neighbour among those of the second (N, D); nan for N = 0.
    """
    if len(f) == 0:
        return math.nan
    nearest = torch.cat([torch.cdist(some, f_prime).argmin(dim=1) for some in torch.split(f, 512)])
    return float((nearest == torch.arange(len(f), device=f.device)).float().mean())


def homography_error_px(result: Matrix, truth: Matrix, points: NDArray[np.float64]) -> float:
    """Return the mean distance of points (N, 2) mapped by two homographies, px of the second image."""
    return float(np.linalg.norm(geometry.apply(result, points) - geometry.apply(truth, points), axis=1).mean())
