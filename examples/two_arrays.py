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

found = agalign.align(green, nir)
print(f"{found.status}: seed {found.seed.kind}, residual {found.residual.median_px:.3f} px")
print(found.fixed_to_moving.round(5))

aligned, valid = agalign.warp_onto(nir, found.fixed_to_moving, (green.shape[1], green.shape[0]))
print(f"{valid.mean():.0%} of the green image has near infra-red")
