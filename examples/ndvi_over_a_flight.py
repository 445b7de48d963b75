"""Read a flight as one lazy xarray Dataset; print the NDVI and position of every capture.

pip install '.[xarray]'
python examples/ndvi_over_a_flight.py ALIGNED
"""

import sys

import agalign

if len(sys.argv) != 2:
    sys.exit("usage: python examples/ndvi_over_a_flight.py ALIGNED")
flight = agalign.open_flight(sys.argv[1])
print(flight)

red, nir = flight["Red"], flight["NIR"]
usable = flight.status.isin(["reference", "aligned"]).sel(band=["Red", "NIR"]).all("band")
ndvi = ((nir - red) / (nir + red)).where(usable & (nir + red > 0))
median = ndvi.median(("y", "x"), skipna=True).compute()
for capture in median.capture:
    here = median.sel(capture=capture)
    print(f"{capture.item()}: {float(here):.3f} at {float(here.latitude):.6f}, {float(here.longitude):.6f}")

# rioxarray gives the coordinate reference system of a capture, if its file has one.
one = agalign.open_capture(f"{sys.argv[1]}/{flight.capture.values[0]}.json")
print(one["NIR"].attrs, one.rio.crs)
