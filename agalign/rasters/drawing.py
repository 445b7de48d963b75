"""The bands of a capture as reduced grey images, pictures with text, and PNG files."""

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from agalign.errors import OutputError, UnreadableFileError
from agalign.host.files import complete_file
from agalign.host.held_sizes import WORK_TILE_PX
from agalign.host.own_files import SOFTWARE
from agalign.pixels.masks import saturated
from agalign.pixels.raster import ReadTile, read_preview, read_tile
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid, Tile, reduced_size_px
from agalign.values.resampling import tiles

Grey = NDArray[np.uint8]
"""(height, width)"""
Picture = NDArray[np.uint8]
"""(height, width, 3) red, green, blue."""
_MAX_REDUCED_PX = 2048
"""Longer side of reduced images: larger than most screens."""


@dataclass(frozen=True)
class ReducedBands:
    """The bands of a capture on its output grid, reduced to the size of a screen."""

    before: Mapping[str, Grey]
    """The raw file, resized to that of the reference, of each band that can be read."""
    after: Mapping[str, Grey]
    """The aligned pixels of each band that was written."""
    size_px: tuple[int, int]
    """(width, height) of all images."""
    saturated: Mapping[str, float] = field(default_factory=dict)
    """Share of saturated pixels in the part of the raw file that the grid shows, of each band with a known saturation
    value."""
    indices_before: Mapping[str, Grey] = field(default_factory=dict)
    """Indices of the unaligned bands, by name, on the output grid, not reduced: 0 and 255 are the ends of their colour
    scale."""


def read_reduced_bands(
    capture: Capture, places: Mapping[str, tuple[Path, int]], grid: OutputGrid, read: ReadTile = read_tile
) -> ReducedBands:
    """Read the bands of a capture, given file and index of each written band, and a function that reads the pixels of
    the capture's files. Raises UnreadableFileError for the written ones.
    """
    size_px = reduced_size_px((grid.width, grid.height), max(1.0, max(grid.width, grid.height) / _MAX_REDUCED_PX))
    before, saturated_shares = {}, {}
    for band in capture.bands:
        with suppress(UnreadableFileError):  # the band pair has failed with this reason
            to_band = np.divide(band.size_px, np.multiply(grid.scale, capture.reference.size_px))
            corner, extent = np.rint(np.array([(grid.x0, grid.y0), (grid.width, grid.height)]) * to_band).astype(int)
            window = Tile(*corner.tolist(), *extent.clip(1).tolist())
            window_px = window.x0, window.y0, window.width, window.height
            before[band.name] = grey(read_preview(band.path, band.index_in_page, window_px, size_px, band.page))
            if band.saturation_value is not None:
                saturated_shares[band.name] = _saturated_share(band, window, read)
    whole_px = 0, 0, grid.width, grid.height
    after = {name: grey(read_preview(*place, whole_px, size_px)) for name, place in places.items()}
    return ReducedBands(before, after, size_px, saturated_shares)


def _saturated_share(band: Band, window: Tile, read: ReadTile) -> float:
    """Return the share of saturated pixels in the part of a window that is in a file: a reduced image has means, which
    are not saturated.
    """
    x0, y0 = max(window.x0, 0), max(window.y0, 0)
    x1, y1 = min(window.x0 + window.width, band.width_px), min(window.y0 + window.height, band.height_px)
    inside, count = Tile(x0, y0, max(x1 - x0, 0), max(y1 - y0, 0)), 0
    for tile in tiles(inside, WORK_TILE_PX):
        pixels, valid = read(band, tile)
        count += int(np.count_nonzero(saturated(valid, pixels, band.saturation_value)))
    return count / max(inside.width * inside.height, 1)


def grey(plane: NDArray[np.float32]) -> Grey:
    """Return the grey values of a band (height, width), NaN for nodata, between its own percentiles: raw numbers and
    reflectance have different ranges.
    """
    sample_pixels = 20_000  # pixels from which the contrast is calculated: percentiles then have an error of 0.1 %
    sample = plane.ravel()[:: max(1, plane.size // sample_pixels)]
    sample = sample[np.isfinite(sample) & (sample != 0)]
    low, high = np.percentile(sample, (1.5, 98.5)).tolist() if sample.size else (0.0, 1.0)
    scaled = (plane - np.float32(low)) * np.float32(255.0 / max(high - low, 1e-9))
    return np.asarray(np.nan_to_num(scaled).clip(0, 255), np.uint8)


def write_png(image: Picture, path: Path) -> None:
    """Write a picture atomically, in the format of the path's suffix. Raises OutputError."""
    with complete_file(path) as partial:
        partial.write_bytes(encoded(image, path))


def encoded(image: Picture | Grey, path: Path, quality: int = 95) -> bytes:
    """Return an image in the format of the path's suffix, with the name of the program, by which later commands
    recognise it. `quality` is that of a JPEG. Raises OutputError for one that is too large for its format.
    """
    name, file = PngInfo(), io.BytesIO()
    name.add_text("Software", SOFTWARE)
    # Each format uses those of these options that it knows. Higher levels of compression take longer and gain little.
    options: dict[str, Any] = {"pnginfo": name, "comment": SOFTWARE, "software": SOFTWARE, "compress_level": 1}
    format_name = Image.registered_extensions()[path.suffix.lower()]
    try:
        Image.fromarray(image).save(file, format_name, quality=quality, **options)
    except OSError as error:
        raise OutputError(f"{path}: cannot be encoded ({error})") from None
    return file.getvalue()


def with_text(
    image: Picture, text: str, at_px: tuple[float, float], size_px: float = 14, anchor: str = "ls"
) -> Picture:
    """Return the picture with a line of text; `anchor` is Pillow's, by default the left end of the baseline."""
    drawn = Image.fromarray(image)
    ImageDraw.Draw(drawn).text(at_px, text, (40, 40, 40), ImageFont.load_default(size_px), anchor)
    return np.asarray(drawn)


def titled(picture: Picture, title: str, height_px: int) -> Picture:
    """Return the picture below a white strip of this height with a line of text."""
    strip = np.full((height_px, picture.shape[1], 3), 255, np.uint8)
    return np.vstack([with_text(strip, title, (2, round(0.7 * height_px))), picture])


def side_by_side(pictures: Sequence[Picture], gap_px: int) -> Picture:
    """Return the pictures in a row, aligned at the top, with white gaps."""
    height = max(picture.shape[0] for picture in pictures)
    pads = [((0, height - picture.shape[0]), (0, gap_px), (0, 0)) for picture in pictures]
    padded = [np.pad(picture, pad, constant_values=255) for picture, pad in zip(pictures, pads, strict=True)]
    return np.hstack(padded)[:, :-gap_px]
