"""Align two arrays: images of one scene in different modalities.

python examples/two_arrays.py
"""

import tempfile
from pathlib import Path

import tifffile

import agalign
from agalign.synthetic.flight import make_flight

with tempfile.TemporaryDirectory() as folder:
    make_flight(Path(folder), captures=1, size_px=(640, 480))
    green = tifffile.imread(Path(folder) / "0000SET/000/IMG_0001_2.tif")
    nir = tifffile.imread(Path(folder) / "0000SET/000/IMG_0001_4.tif")

result = agalign.align(green, nir)
print(f"{result.status}: seed {result.seed.kind}, residual {result.residual.median_px:.3f} px")
print(f"pixel (320, 240) of green is pixel {result.map([320, 240]).round(2)} of near infra-red")

nir_on_green, valid = result.warp(nir)
print(f"{valid.mean():.0%} of the green image has near infra-red")
