"""OpenDroneMap's own alignment of bands, by its code in a checkout, whose functions are called unchanged.

    git clone https://github.com/OpenDroneMap/ODM && git -C ODM checkout 32cfaacfe15ae0a037da25c8e544b92ddf875342
    export ODM_SOURCE=$PWD/ODM

It matches SIFT features of the raw files, without a lens model; ECC follows if they have no result. A flight has one
matrix per band: of the matrices of up to 30 captures, that with the most common eigenvalues. OpenDroneMap warps all
captures by it before it removes distortion, and checks no result. A band without a matrix is left as it is.

What `opendm.multispectral` imports for other purposes (OpenSfM, messages, memory, light sensors) is replaced.
"""

import importlib
import os
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]
SOURCE = "ODM_SOURCE"
"""Environment variable with the path of a checkout of OpenDroneMap/ODM."""
MODULE = Path("opendm", "multispectral.py")
_IMAGES: dict[str, Image] = {}
"""What OpenDroneMap reads, by file name."""


def _imread(name: str, **_: bool) -> Image:
    """Stand-in for `opensfm.io.imread` of OpenDroneMap: (height, width, bands) as stored, red first."""
    return np.atleast_3d(_IMAGES[name])


def _ignore(*_: object) -> None:
    """Log nothing."""


STAND_INS: Mapping[str, Mapping[str, Any]] = {
    "vmem": {"virtual_memory": None},
    "opensfm": {},
    "opensfm.io": {"imread": _imread},
    "opendm.log": {"ODM_INFO": _ignore, "ODM_WARNING": _ignore},
    "opendm.dls": {},
}
"""Attributes by module."""


@cache
def _multispectral() -> Any:
    sys.path.insert(0, os.environ[SOURCE])
    package = importlib.import_module("opendm")
    for name, attributes in STAND_INS.items():
        sys.modules[name] = module = ModuleType(name)
        vars(module).update(attributes)
        if name.startswith("opendm."):
            setattr(package, name.partition(".")[2], module)
    return importlib.import_module("opendm.multispectral")


def matrix_of_pair(fixed: Image, moving: Image) -> NDArray[np.float64] | None:
    """Return OpenDroneMap's matrix of a single capture (3, 3), from pixels of `fixed` to pixels of `moving`, or None.

    The range of values is that of the type, as OpenDroneMap has it.
    """
    _IMAGES.update(fixed=fixed, moving=moving)
    matrix, _, _ = _multispectral().compute_homography("moving", "fixed")
    return None if matrix is None else _inverted(matrix, fixed, moving)


def voted_matrices(
    images: Mapping[str, Image], bands: Mapping[str, str], references: Mapping[str, str]
) -> dict[str, NDArray[np.float64]]:
    """Return OpenDroneMap's matrix (3, 3) of each band of a flight, from pixels of the reference to pixels of the band.

    Arguments are by file name: pixels, name of the band, and, for moving bands, the file of the reference. Raises
    ValueError if OpenDroneMap has another reference band.
    """
    _IMAGES.update(images)
    photos: dict[str, list[SimpleNamespace]] = {}
    for file, band in bands.items():
        photos.setdefault(band, []).append(SimpleNamespace(filename=file))
    cameras = [{"name": band, "photos": files} for band, files in photos.items()]
    primary = _multispectral().get_primary_band_name(cameras, "auto")
    if wrong := {bands[file] for file in references.values()} - {primary}:
        raise ValueError(f"OpenDroneMap aligns to {primary}, and not to {wrong.pop()}")
    primaries = {file: SimpleNamespace(filename=reference) for file, reference in references.items()}
    found = _multispectral().compute_alignment_matrices(cameras, primary, "", primaries, {})
    pairs = {bands[file]: (images[reference], images[file]) for file, reference in references.items()}
    return {band: _inverted(one["warp_matrix"], *pairs[band]) for band, one in found.items()}


def _inverted(moving_to_fixed: NDArray[Any], fixed: Image, moving: Image) -> NDArray[np.float64]:
    """Return fixed_to_moving for OpenDroneMap's matrix, by which cv2.warpPerspective warps the moving image."""
    if fixed.shape[:2] != moving.shape[:2]:
        raise ValueError(f"OpenDroneMap resizes images of {moving.shape[:2]} to {fixed.shape[:2]}: not implemented")
    return np.linalg.inv(np.asarray(moving_to_fixed, float))
