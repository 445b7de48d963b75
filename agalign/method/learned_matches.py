"""Initial alignment for large displacements: SIFT keypoints, learned descriptors, mutual nearest neighbours, MAGSAC++
(after the paper's supplement).
"""

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agalign.errors import GeometryError
from agalign.method.descriptor import PATCH_PX, REFERENCE, Descriptor, start_from, start_from_starter
from agalign.method.levels import LevelImage, make_level_image
from agalign.method.patches import Keypoints, footprint_radius, patch_positions, transform
from agalign.pixels.band_resampling import eight_bit, luma, shrink
from agalign.pixels.landmarks import robust_homography
from agalign.values import geometry, lens
from agalign.values.choices import Sharing
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

_MAX_KEYPOINTS = 2000
"""Default number of keypoints per image; matching takes time proportional to its square."""


def to_8_bit(raster: Raster) -> NDArray[np.uint8]:
    """Return the grey image, (H, W), stretched between the 1st and 99th percentile of the valid pixels."""
    return eight_bit(luma(raster.pixels), raster.valid)


def sift_keypoints(raster: Raster, maximum: int = _MAX_KEYPOINTS) -> Keypoints:
    """Return the `maximum` strongest SIFT keypoints of an image, raw px."""
    detected = cv2.SIFT.create(nfeatures=maximum).detect(to_8_bit(raster), raster.valid.astype(np.uint8))
    strongest = sorted(detected, key=lambda k: -k.response)[:maximum]
    # Patches are as wide as the area that SIFT describes, 6 times the size of the keypoint.
    spacing_per_size = 6 / PATCH_PX
    rows = [(*k.pt, math.radians(k.angle), k.size * spacing_per_size) for k in strongest]
    x, y, angle, scale = torch.tensor(rows, dtype=torch.float32).reshape(-1, 4).unbind(dim=1)
    return Keypoints(torch.stack([x, y], dim=1), angle, scale)


def visible_in_both(keypoints: Keypoints, fixed_to_moving: Matrix, fixed: Raster, moving: Raster) -> Keypoints:
    """Return the keypoints of `fixed` with patches inside both images."""
    positions = patch_positions(keypoints)
    warped = transform(torch.tensor(fixed_to_moving, dtype=torch.float32), positions)
    inside = torch.ones(len(keypoints), dtype=torch.bool)
    for points, raster in ((positions, fixed), (warped, moving)):
        last_px = torch.tensor(raster.size_px, dtype=torch.float32) - 1
        inside &= ((points >= 0) & (points <= last_px)).flatten(1).all(dim=1)
    return keypoints[inside.nonzero()[:, 0]]


_LONGEST_SIDE_PX = 1024
"""Larger images are reduced to this; the accuracy suffices for a seed."""
_INLIER_PX = 4.0
"""Maximum residual of an inlier, px of the reduced image."""
_MIN_MATCHES = 12
"""Minimum number of inliers of a homography: unrelated images have up to 7."""


def matching_network(learned: Descriptor, side: int, channels: tuple[int, int]) -> Descriptor:
    """Return a two-sided network with the weights of the reference side and of moving side `side` of a learned one."""
    sharing: Sharing = "unshared" if learned.sharing == "unshared" else "pseudo-siamese"
    net = Descriptor(sharing, channels, half_rectified=True, unit_length=True)
    start_from(net, learned.state_dict(), (REFERENCE, side))
    return net.to(next(learned.parameters()).device)


def starter_for_matching(channels: tuple[int, int]) -> Descriptor:
    """Return a two-sided network with the weights of the starter network."""
    net = Descriptor("pseudo-siamese", channels, half_rectified=True, unit_length=True)
    start_from_starter(net)
    return net


@torch.no_grad()
def match_seed(net: Descriptor, fixed: Raster, moving: Raster) -> Matrix | None:
    """Return fixed_to_moving (3, 3) between undistorted px from at most _MAX_KEYPOINTS keypoints per image.

    `net` is a `matching_network`. Mutual nearest descriptors, then a robust homography: None if it has fewer than
    _MIN_MATCHES inliers.
    """
    device = next(net.parameters()).device
    (image, keypoints), (image_prime, keypoints_prime) = (_keypoints(r, device) for r in (fixed, moving))
    if min(len(keypoints), len(keypoints_prime)) < _MIN_MATCHES:
        return None
    f = image.describe(net, keypoints)
    # Reversed contrast turns the gradient, and with it the orientation of a keypoint, by 180 degrees.
    orientations = [replace(keypoints_prime, angle=keypoints_prime.angle + turn) for turn in (0.0, torch.pi)]
    f_prime = torch.cat([image_prime.describe(net, k, side=1) for k in orientations])
    rows, columns = _mutual_nearest(f, f_prime, len(keypoints_prime))
    if len(rows) < _MIN_MATCHES:
        return None
    xy, xy_prime = (
        k.xy[i].cpu().numpy().astype(np.float64) for k, i in ((keypoints, rows), (keypoints_prime, columns))
    )
    matrix = robust_homography(xy, xy_prime, _INLIER_PX, _MIN_MATCHES)
    if matrix is None:
        return None
    try:
        return geometry.rescale(matrix, image.scale.inverse, image_prime.scale.inverse)
    except GeometryError:
        return None


def _keypoints(raster: Raster, device: torch.device) -> tuple[LevelImage, Keypoints]:
    """Return the image at the resolution of matching and its keypoints, undistorted px of that resolution."""
    scale = min(1.0, _LONGEST_SIDE_PX / max(raster.size_px))
    image = make_level_image(raster, scale, device)
    raw = sift_keypoints(shrink(raster, image.size_px))
    xy = torch.from_numpy(lens.undistort(image.lens, raw.xy.numpy()).astype(np.float32))
    undistorted = Keypoints(xy, raw.angle, raw.scale).to(device)
    rows = (image.clearance_at(undistorted.xy) > footprint_radius(undistorted.scale)).nonzero()[:, 0]
    return image, undistorted[rows]


def _mutual_nearest(f: Tensor, f_prime: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return indices of the keypoints that are mutual nearest neighbours.

    `f` (N, D) has one descriptor per keypoint, `f_prime` (k * count, D) has k, for k orientations.
    """
    d = torch.cdist(f, f_prime).reshape(len(f), -1, count).amin(dim=1)
    forward, backward = d.argmin(dim=1), d.argmin(dim=0)
    rows = (backward[forward] == torch.arange(len(f), device=f.device)).nonzero()[:, 0]
    return rows, forward[rows]
