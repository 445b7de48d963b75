"""Spectral indices: formulas, rasters, statistics and table."""
