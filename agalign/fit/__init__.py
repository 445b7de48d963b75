"""Fits to windows of a band pair and of a capture: shifts, the adjustment of all bands, fields, relief."""
