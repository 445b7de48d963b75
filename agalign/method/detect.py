"""Detection of SIFT keypoints, the centres of patches."""

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
"""Default number of keypoints per image; matching takes time proportional to its square."""
_SPACING_PER_SIZE = 6 / PATCH_PX
"""Patches are as wide as the area that SIFT describes, 6 times the size of the keypoint."""


def to_8_bit(raster: Raster) -> NDArray[np.uint8]:
    """Return the grey image, (H, W), stretched between the 1st and 99th percentile of the valid pixels."""
    return eight_bit(luma(raster.pixels), raster.valid)


def sift_keypoints(raster: Raster, maximum: int = MAX_KEYPOINTS) -> Keypoints:
    """Return the `maximum` strongest SIFT keypoints of an image, raw px."""
    detected = cv2.SIFT.create(nfeatures=maximum).detect(to_8_bit(raster), raster.valid.astype(np.uint8))
    strongest = sorted(detected, key=lambda k: -k.response)[:maximum]
    return Keypoints(
        torch.tensor([k.pt for k in strongest], dtype=torch.float32).reshape(-1, 2),
        torch.tensor([math.radians(k.angle) for k in strongest], dtype=torch.float32),
        torch.tensor([k.size * _SPACING_PER_SIZE for k in strongest], dtype=torch.float32),
    )


def visible_in_both(keypoints: Keypoints, fixed_to_moving: Matrix, fixed: Raster, moving: Raster) -> Keypoints:
    """Return the keypoints of `fixed` with patches inside both images."""
    positions = patch_positions(keypoints)
    warped = transform(torch.tensor(fixed_to_moving, dtype=torch.float32), positions)
    inside = torch.ones(len(keypoints), dtype=torch.bool)
    for points, raster in ((positions, fixed), (warped, moving)):
        last_px = torch.tensor(raster.size_px, dtype=torch.float32) - 1
        inside &= ((points >= 0) & (points <= last_px)).flatten(1).all(dim=1)
    return keypoints[inside.nonzero()[:, 0]]
