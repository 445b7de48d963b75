"""The picture of a spectral index: the raster in colours, with its histogram."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.raster import open_raster
from agalign.rasters.drawing import with_text, write_png
from agalign.values.image import reduced_size_px

PICTURE_PX = 720
"""Longer side of the image at the top left of a picture, which the report overlays on the composite."""
INDEX_COLOURS = (38, 70, 148), (120, 74, 40), (214, 190, 120), (250, 245, 170), (90, 180, 80), (0, 90, 40)
"""Red, green, blue from the low to the high end of the scale: water, soil, sparse to dense vegetation."""
INDEX_GREYS = (20, 20, 20), (245, 245, 245)
"""The same for raw numbers, whose values do not distinguish soil and vegetation."""


def write_picture(
    index: str, raster: Path, sample: NDArray[np.float32], span: tuple[float, float], *, is_raw: bool
) -> None:
    """Write the picture of the raster of an index, and the histogram of a sample of its values in the same colours.

    `span` has the values at the ends of the colour scale. Indices of raw numbers are drawn in greys. Raises
    OutputError.
    """
    with open_raster(raster) as dataset:
        size_px = dataset.width, dataset.height
        values = dataset.read(1, out_shape=reduced_size_px(size_px, max(1.0, max(size_px) / PICTURE_PX))[::-1])
    ramp = np.array(INDEX_GREYS if is_raw else INDEX_COLOURS, float)
    shape = values.shape
    width, margin, bars, bins = max(shape[1], 360), 24, 90, 120
    # In float64: a value clipped in float32 may be just outside the span.
    counts = np.histogram(sample.astype(float).clip(*span), bins, span)[0]
    sheet = np.full((shape[0] + bars + 2 * margin + 8, width, 3), 255, np.uint8)
    sheet[: shape[0], : shape[1]] = _coloured(values, span, ramp)
    base = shape[0] + margin + bars
    edges = np.linspace(margin, width - margin, bins + 1).round().astype(int)
    centres = np.linspace(*span, 2 * bins + 1, dtype=np.float32)[1::2]
    colours = _coloured(centres[None], span, ramp)[0]
    # The first and last bins also contain the values beyond the span.
    heights = (bars * counts / max(int(counts[1:-1].max(initial=1)), 1)).clip(0, bars).round().astype(int)
    for left, right, height, colour in zip(edges, edges[1:], heights.tolist(), colours.tolist(), strict=False):
        cv2.rectangle(sheet, (int(left), base - height), (int(right) - 1, base), colour, -1)
    for value in np.linspace(*span, 5):
        at = round(margin + (value - span[0]) / (span[1] - span[0]) * (width - 2 * margin))
        sheet = with_text(sheet, f"{value:.3g}" if abs(value) >= 100 else f"{value:.2f}", (at, base + 18), anchor="ms")
    note = ": raw numbers, not reflectance" if is_raw else ""
    title = f"{index.upper()} of {raster.stem.removesuffix(f'_{index}')}{note}"
    write_png(with_text(sheet, title, (margin, shape[0] + 18), 16), raster.with_suffix(".png"))


def _coloured(values: NDArray[Any], span: tuple[float, float], ramp: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Values (height, width) as colours (height, width, 3)."""
    share = np.nan_to_num(np.clip((values - span[0]) / (span[1] - span[0]), 0, 1))
    stops = np.linspace(0, 1, len(ramp))
    result = np.stack([np.interp(share, stops, channel) for channel in ramp.T], axis=-1)
    result[~np.isfinite(values)] = (225, 190, 215)
    return np.asarray(result.round(), np.uint8)
