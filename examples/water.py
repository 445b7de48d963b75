"""Mask sun glint, boats and the shore in a stack: pixels that are brighter in near infrared than calm water.

python examples/water.py STACK.tif WATER.tif LIMIT

The stack has float32 bands (`--radiometry`). LIMIT is a value of near infrared, such as a reflectance of 0.05.
"""

import sys

import numpy as np
import rasterio

if len(sys.argv) != 4:
    sys.exit("usage: python examples/water.py STACK.tif WATER.tif LIMIT")
with rasterio.open(sys.argv[1]) as stack:
    bands, names, profile = stack.read(), stack.descriptions, stack.profile
is_water = bands[names.index("NIR")] < float(sys.argv[3])
with rasterio.open(sys.argv[2], "w", **profile) as water:
    water.write(np.where(is_water, bands, np.nan))
    water.descriptions = names
print(f"{is_water.mean():.0%} of the pixels are water")
