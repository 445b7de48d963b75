"""Rasters on the output grid of a capture."""
