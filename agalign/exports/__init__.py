"""A run as input of other programs: photogrammetry, tie points, xarray.

In: sidecars and rasters of a run. Out: folders and tables that these programs read.
"""
