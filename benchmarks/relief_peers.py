"""Dense registration by other methods, all from the same start: the homography of `agalign --relief never`.

A peer gets the reference and the moving band resampled onto it, and returns for each pixel of the reference the
displacement (height, width, 2) to the same content in the resampled band.
"""

import contextlib
import importlib
import importlib.util
import tempfile
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from relief_score import Map

from agalign.pixels.structure import structure_field
from agalign.values.image import Raster

Image = NDArray[np.float32]
Peer = Callable[[Image, Image, NDArray[np.bool_]], Map]

_GRID_PX = 32
"""Spacing of elastix's control points."""

_COARSEST_PX = 320
"""Width at which a flow starts. The start is off by some px only, and on smaller images of bands with different
contrast the flows go astray by 10-40 px: at 80 px, OpenCV's default for 640, on a flat field in near infra-red.
"""


def by_peer(peer: Peer, reference: Image, moving: Image, start: Map) -> Map:
    """The mapping reference -> moving image of a peer from a start."""
    height, width = moving.shape
    inside = ((start >= 0) & (start <= (width - 1, height - 1))).all(axis=-1)
    at = start.astype(np.float32)
    warped = cv2.remap(moving, at, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    moved = np.stack(np.meshgrid(*(np.arange(n) for n in at.shape[1::-1])), axis=-1) + peer(reference, warped, inside)
    return np.asarray(cv2.remap(at, moved.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def dis(reference: Image, moving: Image, inside: NDArray[np.bool_]) -> Map:
    """OpenCV's dense inverse search on structure images, which have the same contrast in all bands."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setCoarsestScale(_coarsest_scale(reference))
    return np.asarray(flow.calc(*_structure_images(reference, moving, inside), None), np.float64)


def farneback(reference: Image, moving: Image, inside: NDArray[np.bool_]) -> Map:
    """Farneback's polynomial expansion on structure images."""
    images = _structure_images(reference, moving, inside)
    levels = 1 + _coarsest_scale(reference)
    return np.asarray(cv2.calcOpticalFlowFarneback(*images, None, 0.5, levels, 21, 5, 7, 1.5, 0), np.float64)


def _coarsest_scale(reference: Image) -> int:
    """Halvings of the image that a flow starts from."""
    return max(0, round(np.log2(reference.shape[1] / _COARSEST_PX)))


def _structure_images(reference: Image, moving: Image, inside: NDArray[np.bool_]) -> list[NDArray[np.uint8]]:
    """Clipped gradient magnitude, 8 bits."""
    everywhere = np.ones(reference.shape, bool)
    fields = structure_field(Raster(reference, everywhere, None)), structure_field(Raster(moving, inside, None))
    return [np.asarray(np.rint(255 * np.abs(field)), np.uint8) for field in fields]


def elastix(reference: Image, moving: Image, inside: NDArray[np.bool_]) -> Map:
    """Elastix's B-spline registration by Mattes mutual information."""
    itk = importlib.import_module("itk")
    parameters = itk.ParameterObject.New()
    chosen = parameters.GetDefaultParameterMap("bspline", 4, float(_GRID_PX))
    chosen["Registration"], chosen["Metric"] = ["MultiResolutionRegistration"], ["AdvancedMattesMutualInformation"]
    parameters.AddParameterMap(chosen)
    images = [itk.GetImageFromArray(np.ascontiguousarray(i)) for i in (reference, moving)]
    mask = itk.GetImageFromArray(inside.astype(np.uint8))
    _, result = itk.elastix_registration_method(
        *images, fixed_mask=mask, parameter_object=parameters, log_to_console=False
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # it leaves a file where it runs
        field = itk.transformix_deformation_field(images[1], result)
    return np.asarray(itk.GetArrayFromImage(field), np.float64)[..., :2]


def available() -> dict[str, Peer]:
    """The peers that are installed, by name."""
    peers: dict[str, Peer] = {"DIS flow on structure": dis, "Farneback on structure": farneback}
    if importlib.util.find_spec("itk") is not None:
        peers["elastix B-spline"] = elastix
    return peers
