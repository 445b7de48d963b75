"""The pixels of the files of one capture, each file read once for all steps that use it."""

import numpy as np
from numpy.typing import NDArray

from agalign.host.held_sizes import MAX_CAPTURE_BYTES
from agalign.pixels.raster import read_tile
from agalign.values.capture import Band
from agalign.values.image import Mask, Tile


class CapturePixels:
    """Reads the bands of a capture, and holds them as long as they fit into MAX_CAPTURE_BYTES."""

    def __init__(self) -> None:
        self._held: dict[tuple[object, ...], tuple[NDArray[np.generic], Mask]] = {}
        self._bytes = 0

    def read(self, band: Band, tile: Tile) -> tuple[NDArray[np.generic], Mask]:
        """Return a tile inside a band: pixels in the type of the file and their mask, each (height, width).

        They are parts of held arrays and must not be changed. Raises UnreadableFileError.
        """
        key = band.path, band.page, band.band_index, band.missing
        if key not in self._held:
            size_bytes = band.width_px * band.height_px * (np.dtype(band.dtype).itemsize + 1)
            if self._bytes + size_bytes > MAX_CAPTURE_BYTES:
                return read_tile(band, tile)
            self._held[key] = read_tile(band, Tile(0, 0, *band.size_px))
            self._bytes += size_bytes
        pixels, valid = self._held[key]
        cut = np.s_[tile.y0 : tile.y0 + tile.height, tile.x0 : tile.x0 + tile.width]
        return pixels[cut], valid[cut]
