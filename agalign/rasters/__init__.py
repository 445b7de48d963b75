"""The files of pixels of a capture: stacks, maps, parallax, pictures, on one grid.

In: a capture with its alignments. Out: GeoTIFF, PNG and JPEG files, and the part of the sidecar that lists them.
"""
