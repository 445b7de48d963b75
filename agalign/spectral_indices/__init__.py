"""Spectral indices of aligned captures.

In: sidecars and rasters of a run. Out: index rasters, their statistics and table.
"""
