"""The images of the sets: finding them by checksum, reading, and degrading them."""

import hashlib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from synthetic_flights import troubles

from agalign.synthetic.ground import Field
from bands.score import AS_IT_IS, LOST, Pair, movement

Image = NDArray[Any]
"""(H, W), or (H, W, 3) with red first, uint8 or uint16."""

LENS_CORRECTED = "lens-corrected"
_LIGHT: dict[str, Callable[[Field, np.random.Generator], Field]] = {
    "blur 3 px": troubles.blur, "motion 25 px": troubles.motion, "noise 30 %": troubles.noise,
    "half saturated": troubles.half_saturated,
}  # fmt: skip
VARIANTS = (
    AS_IT_IS, LENS_CORRECTED, *_LIGHT, "turn 3", "turn 10", "turn 20", "scale 0.8", LOST,
)  # fmt: skip


@dataclass(frozen=True)
class Located:
    """Files of the sets that are on disk."""

    paths: dict[str, dict[str, Path]]
    """Paths by set and name; complete sets only."""
    missing: dict[str, list[str]]
    """Names of missing files by set."""


def locate(folder: Path, sets: Mapping[str, Mapping[str, Any]]) -> Located:
    """Return the files below `folder` that belong to a set, by checksum."""
    sizes = {entry["bytes"] for s in sets.values() for entry in s["files"].values()}
    by_sum = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if path.stat().st_size in sizes:
            by_sum[hashlib.sha256(path.read_bytes()).hexdigest()] = path
    paths: dict[str, dict[str, Path]] = {}
    missing: dict[str, list[str]] = {}
    for name, description in sets.items():
        result = {f: by_sum.get(entry["sha256"]) for f, entry in description["files"].items()}
        absent = [f for f, path in result.items() if path is None]
        if absent:
            missing[name] = absent
        else:
            paths[name] = {f: path for f, path in result.items() if path is not None}
    return Located(paths, missing)


def read(path: Path) -> Image:
    """An image file as it is stored. Raises OSError."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise OSError(f"{path}: is no image that can be read")
    return np.asarray(image if image.ndim == 2 else image[..., 2::-1])


def spoilt(image: Image, pair: Pair, variant: str) -> Image:
    """Return the moving image of a pair in a variant; the same in every run."""
    seed = zlib.crc32("/".join((*pair.key, variant)).encode())
    rng = np.random.default_rng(seed)
    if variant in _LIGHT:
        planes = np.moveaxis(np.atleast_3d(image), -1, 0)
        made = [_in_other_light(plane, variant, np.random.default_rng(seed)) for plane in planes]
        return _as(np.dstack(made).reshape(image.shape), image)
    if variant == LOST:
        # Noise about its own brightness: a frame that a camera wrote without having seen anything.
        return _as(np.median(image) + 0.5 * image.std() * rng.normal(size=image.shape), image)
    return moved(image, movement(variant, pair.size_px))


def _in_other_light(plane: Image, variant: str, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W). Black that an earlier warp has left stays black: it is no part of the scene."""
    full = float(np.iinfo(plane.dtype).max)
    lit = plane > 0
    light = np.where(lit, plane, np.median(plane[lit])).astype(np.float32) / full
    return np.where(lit, _LIGHT[variant](light, rng) * np.float32(full), np.float32(0))


def moved(image: Image, matrix: NDArray[np.float64]) -> Image:
    """Return the image transformed by an affine mapping in its frame, black outside."""
    if np.array_equal(matrix, np.eye(3)):
        return image
    shrink = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    # What the smaller image cannot hold would fold back into it.
    source = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / shrink**2 - 1)) if shrink < 0.999 else image
    return np.asarray(cv2.warpAffine(source, matrix[:2], image.shape[1::-1], flags=cv2.INTER_CUBIC))


def _as(values: NDArray[Any], like: Image) -> Image:
    return np.asarray(values.clip(0, np.iinfo(like.dtype).max).round().astype(like.dtype))
