"""Sizes that are held in memory at once: of images as a whole, and of the tiles in which larger ones are processed."""

WORK_TILE_PX = 2048
"""Side of the tiles of rasters that are written one after another."""
RESAMPLED_TILE_PX = 1024
"""Side of the tiles of an array that is resampled."""
MAX_HELD_POSITIONS_PX = 8_000_000
"""Pixels of an image whose positions in a moving band are held, 8 bytes each: more than cameras have in an image that
is not reduced for the estimation."""
MAX_CAPTURE_BYTES = 1 << 26
"""Size of the pixels and masks of a capture that are held: six bands of 3.5 million pixels in 16 bits."""
MAX_DECODED_PX = 1 << 26
"""Pixels of an image that is decoded completely before it is reduced: 128 MB in 16 bits."""
MAX_MATCHED_PX = 3_000_000
"""Pixels of a reference in dense matching; larger ones are reduced."""
GDAL_CACHE_BYTES = 256 * 2**20
"""GDAL's cache of blocks in each worker; its default is 5 % of the machine's memory."""
