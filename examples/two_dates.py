"""Align a mosaic to an earlier one in the same CRS, and write the difference of a band: green if they have it.

python examples/two_dates.py EARLIER.tif LATER.tif CHANGE.tif
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio

import agalign

if len(sys.argv) != 4:
    sys.exit("usage: python examples/two_dates.py EARLIER.tif LATER.tif CHANGE.tif")
earlier, later, target = map(Path, sys.argv[1:4])
with tempfile.TemporaryDirectory() as folder:
    (report,) = agalign.onto(earlier, [later], folder)
    name, bands = report.sidecar.reference.band.removeprefix(f"{earlier.stem} "), report.sidecar.bands[1:]
    moving = next((band for band in bands if band.band == name or len(bands) == 1), None)
    if moving is None:
        sys.exit(f"{later} has no band {name}, to which it was aligned")
    if moving.status != "aligned":
        sys.exit(f"{later} cannot be aligned to {earlier}: {moving.reason}")
    with rasterio.open(earlier) as one, rasterio.open(later) as other:
        by_coordinates = ~other.transform * one.transform  # the mosaics have the same CRS
    x_px, y_px = by_coordinates * (moving.grid.reference_px.T + 0.5)
    offsets_px = moving.grid.moving_px + 0.5 - np.stack([x_px, y_px], axis=1)
    print(f"offset before alignment: {np.hypot(*np.median(offsets_px, axis=0)):.1f} px of {later.name}")
    with rasterio.open(report.path.with_suffix(".tif")) as both:
        change = both.read(moving.place.band_index, masked=True).astype("float32") - both.read(1, masked=True)
        profile = both.profile | {"count": 1, "dtype": "float32", "nodata": np.nan}
with rasterio.open(target, "w", **profile) as out:
    out.write(change.filled(np.nan), 1)
print(f"{target}: {float(change.mean()):+.3f} on average")
