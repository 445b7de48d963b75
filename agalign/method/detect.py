"""SIFT keypoints as centres of patches."""

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from agalign.method.descriptor import PATCH_PX
from agalign.method.patches import Keypoints, patch_positions, transform
from agalign.pixels.grey import eight_bit, luma
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

MAX_KEYPOINTS = 2000
_SPACING_PER_SIZE = 6 / PATCH_PX
"""SIFT describes an area 6 times its keypoint's size wide; so do the patches."""


def to_8_bit(raster: Raster) -> NDArray[np.uint8]:
    """(H, W), grey, between the 1st and the 99th percentile of the valid pixels."""
    return eight_bit(luma(raster.pixels), raster.valid)


def sift_keypoints(raster: Raster, maximum: int = MAX_KEYPOINTS) -> Keypoints:
    """The `maximum` strongest SIFT keypoints of an image, raw px."""
    result = cv2.SIFT.create(nfeatures=maximum).detect(to_8_bit(raster), raster.valid.astype(np.uint8))
    result = sorted(result, key=lambda k: -k.response)[:maximum]
    return Keypoints(
        torch.tensor([k.pt for k in result], dtype=torch.float32).reshape(-1, 2),
        torch.tensor([math.radians(k.angle) for k in result], dtype=torch.float32),
        torch.tensor([k.size * _SPACING_PER_SIZE for k in result], dtype=torch.float32),
    )


def visible_in_both(keypoints: Keypoints, fixed_to_moving: Matrix, fixed: Raster, moving: Raster) -> Keypoints:
    """The keypoints with patches inside both images."""
    grid = patch_positions(keypoints)
    there = transform(torch.tensor(fixed_to_moving, dtype=torch.float32), grid)
    inside = torch.ones(len(keypoints), dtype=torch.bool)
    for points, raster in ((grid, fixed), (there, moving)):
        end = torch.tensor(raster.size_px, dtype=torch.float32) - 1
        inside &= ((points >= 0) & (points <= end)).flatten(1).all(dim=1)
    return keypoints[inside.nonzero()[:, 0]]
