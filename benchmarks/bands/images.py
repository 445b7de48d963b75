"""The images of the sets: finding them by checksum, reading, and degrading them."""

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from synthetic_flights import troubles

from agalign.host.files import file_checksum
from agalign.pixels.band_resampling import warped
from agalign.synthetic.ground import Field
from agalign.values import lens
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from bands.score import AS_IT_IS, LOST, Pair, movement

Image = NDArray[Any]
"""(H, W), or (H, W, 3) with red first, uint8 or uint16."""

LENS_CORRECTED = "lens-corrected"
LIGHT: dict[str, Callable[[Field, np.random.Generator], Field]] = {
    "blur 3 px": troubles.blur,
    "motion 25 px": troubles.motion,
    "noise 30 %": troubles.noise,
    "half saturated": troubles.half_saturated,
}
VARIANTS = (AS_IT_IS, LENS_CORRECTED, *LIGHT, "turn 3", "turn 10", "turn 20", "scale 0.8", LOST)


Paths = dict[str, Path]


def locate(folder: Path, sets: Mapping[str, Mapping[str, Any]]) -> tuple[dict[str, Paths], dict[str, list[str]]]:
    """Return the files below `folder` that belong to a set, by checksum: {set: {name: path}} of complete sets, and
    {set: names of missing files}.
    """
    sizes = {entry["bytes"] for s in sets.values() for entry in s["files"].values()}
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.stat().st_size in sizes]
    by_sum = {file_checksum(path): path for path in files}
    paths = {name: {f: by_sum.get(e["sha256"]) for f, e in s["files"].items()} for name, s in sets.items()}
    missing = {name: [f for f, path in of_set.items() if path is None] for name, of_set in paths.items()}
    located = {name: of_set for name, of_set in paths.items() if not missing[name]}
    return located, {name: absent for name, absent in missing.items() if absent}


def read(path: Path) -> Image:
    """An image file as it is stored. Raises OSError."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise OSError(f"{path}: cannot be read as an image")
    return np.asarray(image if image.ndim == 2 else image[..., 2::-1])


def straightened(raster: Raster) -> Raster:
    """Return an image without lens distortion."""
    if not lens.is_distorting(raster.lens):
        return raster
    return warped(raster, PixelMapping(np.eye(3), None, raster.lens), raster.size_px)


def degraded(image: Image, pair: Pair, variant: str) -> Image:
    """Return the moving image of a pair in a variant; the same in every run."""
    seed = zlib.crc32("/".join((*pair.key, variant)).encode())
    if variant in LIGHT:
        planes = np.moveaxis(np.atleast_3d(image), -1, 0)
        made = [in_other_light(plane, variant, np.random.default_rng(seed)) for plane in planes]
        return np.dstack(made).reshape(image.shape)
    if variant == LOST:
        return _as(without_scene(image, np.random.default_rng(seed)), image)
    return moved(image, movement(variant, pair.size_px))


def without_scene(image: Image, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise about the brightness of an image, as of a frame that a camera wrote without an exposure."""
    return np.median(image) + 0.5 * image.std() * rng.normal(size=image.shape)


def in_other_light(plane: Image, variant: str, rng: np.random.Generator) -> Image:
    """Return a plane (H, W) in a variant of `LIGHT`. Black areas of an earlier warp stay black."""
    full = float(np.iinfo(plane.dtype).max)
    lit = plane > 0
    light = np.where(lit, plane, np.median(plane[lit])).astype(np.float32) / full
    return _as(np.where(lit, LIGHT[variant](light, rng) * np.float32(full), np.float32(0)), plane)


def moved(image: Image, matrix: NDArray[np.float64], size_px: tuple[int, int] | None = None) -> Image:
    """Return the image transformed by an affine mapping, black outside, in its frame or that of another size."""
    if np.array_equal(matrix, np.eye(3)):
        return image
    shrink = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    # Blur against aliasing.
    source = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / shrink**2 - 1)) if shrink < 0.999 else image
    return np.asarray(cv2.warpAffine(source, matrix[:2], size_px or image.shape[1::-1], flags=cv2.INTER_CUBIC))


def _as(values: NDArray[Any], like: Image) -> Image:
    return np.asarray(values.clip(0, np.iinfo(like.dtype).max).round().astype(like.dtype))
