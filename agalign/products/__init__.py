"""The files that a run writes: rasters, sidecars, pictures, indices, the summary and the report."""
