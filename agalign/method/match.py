"""A seed for large displacements: keypoints of both images, learnt descriptors, nearest neighbours, and a homography
that many of them agree on (the paper's supplement).
"""

import cv2
import numpy as np
import torch
from torch import Tensor

from agalign.errors import GeometryError
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.detect import MAX_KEYPOINTS, sift_keypoints
from agalign.method.levels import LevelImage, make_level_image
from agalign.method.patches import Keypoints, footprint_radius, patch_positions
from agalign.method.starter import start_from, start_from_starter
from agalign.pixels.resample import shrink
from agalign.values import geometry, lens
from agalign.values.choices import Sharing
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

_LONGEST_SIDE_PX = 1024
"""Larger images are reduced to this: a seed need not be exact."""
_WITHIN_PX = 4.0
_MIN_MATCHES = 12
"""Of one homography: unrelated images reach 7."""


def matching_network(learnt: Descriptor, side: int, channels: tuple[int, int]) -> Descriptor:
    """A network for two images of these channels: the reference's and a moving side of a learnt one."""
    sharing: Sharing = "unshared" if learnt.sharing == "unshared" else "pseudo-siamese"
    net = Descriptor(sharing, channels, half_rectified=True, unit_length=True)
    start_from(net, learnt.state_dict(), (REFERENCE, side))
    return net.to(next(learnt.parameters()).device)


def starter_for_matching(channels: tuple[int, int]) -> Descriptor:
    """The same of the starter."""
    net = Descriptor("pseudo-siamese", channels, half_rectified=True, unit_length=True)
    start_from_starter(net)
    return net


@torch.no_grad()
def match_seed(net: Descriptor, fixed: Raster, moving: Raster, maximum: int = MAX_KEYPOINTS) -> Matrix | None:
    """fixed_to_moving between undistorted px, from matches of a `matching_network`'s descriptors.

    So many keypoints of each image are tried. None where fewer than twelve mutual nearest neighbours agree on one
    homography.
    """
    device = next(net.parameters()).device
    here, there = (_keypoints(raster, device, maximum) for raster in (fixed, moving))
    if min(len(here[1]), len(there[1])) < _MIN_MATCHES:
        return None
    f = net(here[0].patches(patch_positions(here[1])), REFERENCE)
    # Where contrast is reversed the gradient points the other way, and so does the keypoint.
    both_ways = [_turned(there[1], angle) for angle in (0.0, torch.pi)]
    f_prime = torch.cat([net(there[0].patches(patch_positions(k)), 1) for k in both_ways])
    rows, columns = _mutual_nearest(f, f_prime, len(there[1]))
    if len(rows) < _MIN_MATCHES:
        return None
    xy = (here[1].xy[rows].cpu().numpy().astype(np.float64), there[1].xy[columns].cpu().numpy().astype(np.float64))
    result, inliers = cv2.findHomography(*xy, cv2.USAC_MAGSAC, _WITHIN_PX, maxIters=20_000, confidence=0.9999)
    if result is None or int(inliers.sum()) < _MIN_MATCHES:
        return None
    try:
        return geometry.rescale(geometry.normalised(result), here[0].scale.inverse, there[0].scale.inverse)
    except GeometryError:
        return None


def _keypoints(raster: Raster, device: torch.device, maximum: int) -> tuple[LevelImage, Keypoints]:
    """An image at the resolution at which it is matched, and its keypoints as undistorted positions."""
    scale = min(1.0, _LONGEST_SIDE_PX / max(raster.size_px))
    view = make_level_image(raster, scale, device)
    small = shrink(raster, view.size_px)
    result = sift_keypoints(small, maximum)
    xy = torch.from_numpy(lens.undistort(view.lens, result.xy.numpy()).astype(np.float32))
    straight = Keypoints(xy, result.angle, result.scale).to(device)
    rows = (view.room_at(straight.xy) > footprint_radius(straight.scale)).nonzero()[:, 0]
    return view, straight[rows]


def _turned(keypoints: Keypoints, angle: float) -> Keypoints:
    return Keypoints(keypoints.xy, keypoints.angle + angle, keypoints.scale)


def _mutual_nearest(f: Tensor, f_prime: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows of `f` (N, D) and keypoints of `f_prime` (k count, D) that are mutual nearest neighbours."""
    d = torch.cdist(f, f_prime).reshape(len(f), -1, count).amin(dim=1)
    forth, back = d.argmin(dim=1), d.argmin(dim=0)
    rows = (back[forth] == torch.arange(len(f), device=f.device)).nonzero()[:, 0]
    return rows, forth[rows]
