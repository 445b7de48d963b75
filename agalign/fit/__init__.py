"""Fits to windows of a band pair and of a capture: shifts, the adjustment of all bands, fields, relief.

In: images of band pairs under a mapping. Out: shifts of windows, and geometry fitted to them.
"""
