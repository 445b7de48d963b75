"""Align two arrays, save the mapping as JSON, and use the file; here a synthetic scene, and the scene rotated by 2
degrees with reversed contrast.

python examples/two_arrays.py
"""

import json
from pathlib import Path

import cv2
import numpy as np
from map_pixels import mapped
from scipy.ndimage import affine_transform, gaussian_filter

import agalign


def save(result, path):
    """Write what other programs need of an alignment, under the names of the sidecar (docs/reference/sidecar.md)."""
    x, y = (np.linspace(0, side - 1, nodes) for side, nodes in zip(result.size_px, (65, 49), strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    band = {"status": result.status, "reason": result.reason, "relief": None}
    band["grid"] = {"reference_px": points.tolist(), "moving_px": result.map(points).round(4).tolist()}
    std_px = result.std_px if np.isfinite(result.std_px) else None  # unknown: null
    Path(path).write_text(json.dumps(band | {"size_px": result.size_px, "std_px": std_px}), encoding="utf-8")


def warp(image, band):
    """Resample an image to the reference by the mapping of a file that `save` wrote; NaN outside of the image."""
    x, y = (np.arange(side) for side in band["size_px"])
    at_px = mapped(band, np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    return cv2.remap(image.astype(np.float32), at_px, None, cv2.INTER_LANCZOS4, borderValue=np.nan)


noise = np.random.default_rng(0).normal(size=(520, 680))
scene = gaussian_filter(noise, 1.5) + 2 * gaussian_filter(noise, 6)
angle = np.radians(2)
rotation = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
green = scene[20:500, 20:660]
nir = -affine_transform(scene, rotation, offset=(12, -6))[20:500, 20:660]

result = agalign.align(green, nir)
print(f"{result.status}: seed {result.seed.kind}, residual {result.residual.median_px:.3f} px")
print(f"pixel (320, 240) of green is pixel {result.map([320, 240]).round(2)} of near infra-red")

nir_on_green, valid = result.warp(nir)
print(f"{valid.mean():.0%} of the green image has near infra-red")

save(result, "pair.json")
band = json.loads(Path("pair.json").read_text(encoding="utf-8"))
again = warp(nir, band)
both = valid & np.isfinite(again)
correlation = np.corrcoef(again[both], nir_on_green[both])[0, 1]
print(f"by pair.json: {band['status']}, correlation with the result above {correlation:.4f}")
