"""Align two arrays: a synthetic scene, and the scene rotated by 2 degrees with reversed contrast.

python examples/two_arrays.py
"""

import numpy as np
from scipy.ndimage import affine_transform, gaussian_filter

import agalign

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
