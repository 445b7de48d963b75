"""The before/after picture of a capture: three bands as red, green and blue, so that misalignment shows as colour."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from agalign.products.drawing import Picture, with_text, write_png
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.reduced_bands import Grey, ReducedBands
from agalign.values.capture import Band

_OVERVIEW_PX = 480
"""Width of the overview and of the detail."""
_DETAIL_SOURCE_PX = 160
"""Width of the part of the image that the detail enlarges."""
_MAX_EDGE = 60
"""Limit of the Laplacian of grey values: single strong edges must not determine the position of the detail."""
_GAP_PX, _TITLE_PX = 8, 26
_RED_NM = 668.0
"""The band nearest to this wavelength is shown as green."""
_MAX_REFLECTIVE_NM = 1000.0
"""Bands at longer wavelengths are thermal: vegetation has few edges in them."""


class BeforeAfterPicture(Product):
    """The bands before and after alignment, with a detail of each."""

    kind = "picture"
    suffix = ".png"
    is_required = False

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.png."""
        path, reference = context.paths.file(self.suffix), context.capture.reference
        usable = context.usable
        chosen = choose_bands([b for b in context.capture.moving if b.name in usable], reference)
        write_picture(context.reduced_bands, [b.name for b in chosen], path)
        return [WrittenFile(self.kind, path, StacAsset("picture", "image/png", ("thumbnail",)))]


def choose_bands(moving: list[Band], reference: Band) -> list[Band]:
    """Return three bands for red, green and blue: the longest wavelength, the one nearest to red, and the reference."""
    known = sorted((b for b in moving if b.wavelength_nm is not None), key=_wavelength_nm)
    candidates = known if len(known) >= 2 else moving
    longest = max(candidates, key=lambda b: _wavelength_nm(b) if _wavelength_nm(b) < _MAX_REFLECTIVE_NM else 0.0)
    rest = [b for b in candidates if b is not longest]
    nearest_to_red = min(rest, key=lambda b: abs((b.wavelength_nm or _RED_NM) - _RED_NM)) if rest else reference
    return [longest, nearest_to_red, reference]


def _wavelength_nm(band: Band) -> float:
    return band.wavelength_nm or 0.0


def write_picture(views: ReducedBands, names: Sequence[str], path: Path) -> None:
    """Write the picture of three bands as red, green and blue. Raises OutputError."""
    before, after = (np.stack([bands[name] for name in names], axis=-1) for bands in (views.before, views.after))
    write_png(_sheet(before, after, f"before: {', '.join(names)} as red, green, blue", "after"), path)


def _sheet(before: Picture, after: Picture, title_before: str, title_after: str) -> Picture:
    height, width = before.shape[:2]
    size_px = _OVERVIEW_PX, max(1, round(_OVERVIEW_PX * height / width))
    detail_width = min(width, _DETAIL_SOURCE_PX)
    detail_height = max(1, min(height, round(detail_width * height / width)))
    x0, y0 = busiest_window(after[..., 2], (detail_width, detail_height))
    x1, y1 = x0 + detail_width, y0 + detail_height
    scale = size_px[0] / width
    columns = []
    for image, title in ((before, title_before), (after, title_after)):
        overview = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)
        corners = (round(x0 * scale), round(y0 * scale)), (round(x1 * scale), round(y1 * scale))
        cv2.rectangle(overview, *corners, (255, 255, 255), 1)
        detail = cv2.resize(image[y0:y1, x0:x1], size_px, interpolation=cv2.INTER_NEAREST)
        strip = np.full((_TITLE_PX, size_px[0], 3), 255, np.uint8)
        gap = np.full((_GAP_PX, size_px[0], 3), 255, np.uint8)
        columns.append(np.vstack([with_text(strip, title, (2, 18)), overview, gap, detail]))
    between = np.full((columns[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.hstack([columns[0], between, columns[1]])


def busiest_window(image: Grey, size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the top-left pixel (x, y) of the window (width, height) with the most edges, where misalignment shows."""
    (height, width), (window_width, window_height) = image.shape, size_px
    edges = np.abs(cv2.Laplacian(image.astype(np.float32), cv2.CV_32F)).clip(0, _MAX_EDGE)
    density = cv2.boxFilter(edges, -1, size_px, anchor=(0, 0), normalize=True)
    inside = density[: height - window_height + 1, : width - window_width + 1]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(x), int(y)
