"""The picture of an index raster: its values in colours, and below them their histogram."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.products.drawing import with_text, write_png

_BARS = 120
_PICTURE_PX = 720
"""Longer side of the image at the top left of the picture; the report overlays it on the composite."""
_COLOURS = np.array([(38, 70, 148), (120, 74, 40), (214, 190, 120), (250, 245, 170), (90, 180, 80), (0, 90, 40)], float)
"""Red, green, blue from the low to the high end of the scale: water, soil, sparse to dense vegetation."""
_NEUTRAL = np.array([(20, 20, 20), (245, 245, 245)], float)
"""Greys for raw numbers, whose values do not distinguish soil and vegetation."""
_NODATA_COLOUR = (225, 190, 215)


def picture_size(width: int, height: int) -> tuple[int, int]:
    """Return (width, height) px of the image in the picture of a raster of this size."""
    scale = min(1.0, _PICTURE_PX / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def write_picture(
    values: NDArray[np.float32], sample: NDArray[np.float32], span: tuple[float, float], title: str, path: Path, *,
    neutral: bool,
) -> None:  # fmt: skip
    """Write an image (height, width) of an index and the histogram of a sample of its values in the same colours.

    `span` is the range of the colour scale; with `neutral` the colours are greys. Raises OutputError.
    """
    shape = values.shape
    width, margin, bars = max(shape[1], 360), 24, 90
    # In float64: a value clipped in float32 may be just outside the span.
    counts = np.histogram(sample.astype(float).clip(*span), _BARS, span)[0]
    sheet = np.full((shape[0] + bars + 2 * margin + 8, width, 3), 255, np.uint8)
    sheet[: shape[0], : shape[1]] = _coloured(values, span, neutral=neutral)
    base = shape[0] + margin + bars
    edges = np.linspace(margin, width - margin, _BARS + 1).round().astype(int)
    centres = np.linspace(*span, 2 * _BARS + 1, dtype=np.float32)[1::2]
    colours = _coloured(centres[None], span, neutral=neutral)[0]
    # The first and last bins also contain the values beyond the span.
    heights = (bars * counts / max(int(counts[1:-1].max(initial=1)), 1)).clip(0, bars).round().astype(int)
    for left, right, height, colour in zip(edges, edges[1:], heights.tolist(), colours.tolist(), strict=False):
        cv2.rectangle(sheet, (int(left), base - height), (int(right) - 1, base), colour, -1)
    for value in np.linspace(*span, 5):
        at = round(margin + (value - span[0]) / (span[1] - span[0]) * (width - 2 * margin))
        sheet = with_text(sheet, f"{value:.3g}" if abs(value) >= 100 else f"{value:.2f}", (at, base + 18), anchor="ms")
    write_png(with_text(sheet, title, (margin, shape[0] + 18), 16), path)


def _coloured(values: NDArray[Any], span: tuple[float, float], *, neutral: bool) -> NDArray[np.uint8]:
    """Values (height, width) as colours (height, width, 3)."""
    ramp = _NEUTRAL if neutral else _COLOURS
    share = np.nan_to_num(np.clip((values - span[0]) / (span[1] - span[0]), 0, 1))
    stops = np.linspace(0, 1, len(ramp))
    result = np.stack([np.interp(share, stops, channel) for channel in ramp.T], axis=-1)
    result[~np.isfinite(values)] = _NODATA_COLOUR
    return np.asarray(result.round(), np.uint8)
