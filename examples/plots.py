"""Write the statistics of plots: the mean of an index map, or of the rasters of single captures, inside each outline.

pip install exactextract geopandas
python examples/plots.py PLOTS.gpkg RASTER.tif [RASTER.tif ...]

plots.csv gets a row per plot, from the one raster that shows most of it; of equal ones, from that whose centre is
nearest. Values of several rasters are not averaged. `captures` counts the rasters that show at least half of the plot,
`count` the valid pixels, and `valid_share` is their area divided by that of the plot.
"""

import sys

import geopandas
import numpy as np
import pandas
import rasterio
from exactextract import exact_extract
from exactextract.raster import RasterioRasterSource
from rasterio.vrt import WarpedVRT

if len(sys.argv) < 3:
    sys.exit("usage: python examples/plots.py PLOTS.gpkg RASTER.tif [RASTER.tif ...]")
plots = geopandas.read_file(sys.argv[1])
tables = []
for name in sys.argv[2:]:
    # exactextract ignores the rotation of a geotransform; WarpedVRT resamples rotated rasters to a north-up grid.
    with rasterio.open(name) as raster:
        if raster.crs is None:
            print(f"{name}: skipped, has no CRS; align with --georeference", file=sys.stderr)
            continue
        with WarpedVRT(raster, nodata=np.nan) as index:
            here = plots.to_crs(index.crs)
            here.geometry = here.make_valid()
            columns = ["count", "mean", "median", "stdev"]
            table = exact_extract(RasterioRasterSource(index), here, columns, output="pandas")
            pixel_area, centre = abs(index.transform.determinant), index.transform * (index.width / 2, index.height / 2)
    table["valid_share"] = table["count"] * pixel_area / here.area
    table["distance"] = here.centroid.distance(geopandas.points_from_xy([centre[0]], [centre[1]])[0])
    tables.append(table.assign(raster=name, plot_row=range(len(plots))))
if not tables:
    sys.exit("no raster has a CRS")
every = pandas.concat(tables)
every["share"] = every.valid_share.round(1)  # rasters that show a plot equally well differ by a few pixels
best = every.sort_values(["share", "distance"], ascending=[False, True]).groupby("plot_row").head(1)
best = best.set_index("plot_row").sort_index()
best["captures"] = every[every.valid_share >= 0.5].groupby("plot_row").size().reindex(best.index, fill_value=0)
values = best[["raster", "captures", "count", "valid_share", "mean", "median", "stdev"]]
plots.drop(columns="geometry").join(values).to_csv("plots.csv", index=False)
