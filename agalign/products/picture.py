"""The small before/after picture of a capture: three bands as red, green and blue; misalignment is colour."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from agalign.products.drawing import Picture, with_text, write_png
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.reduced_bands import Grey, ReducedBands
from agalign.values.capture import Band

_OVERVIEW_PX = 480
_ZOOM_SOURCE_PX = 160
_GAP_PX = 8
_TITLE_PX = 26
_RED_NM = 668.0
"""The middle band of the picture is the one nearest to this."""
_THERMAL_NM = 1000.0
"""A band beyond this shows warmth, in which vegetation has few edges."""


class BeforeAfterPicture(Product):
    """Before and after, with a detail of each."""

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
    """Return three bands for red, green and blue: the longest wavelength, a middle one, and the reference."""
    known = sorted((b for b in moving if b.wavelength_nm is not None), key=_wavelength_nm)
    others = known if len(known) >= 2 else moving
    red = max(others, key=lambda b: _wavelength_nm(b) if _wavelength_nm(b) < _THERMAL_NM else 0.0)
    rest = [b for b in others if b is not red]
    between = min(rest, key=lambda b: abs((b.wavelength_nm or _RED_NM) - _RED_NM)) if rest else reference
    return [red, between, reference]


def _wavelength_nm(band: Band) -> float:
    return band.wavelength_nm or 0.0


def write_picture(views: ReducedBands, names: Sequence[str], path: Path) -> None:
    """Write the picture of three bands as red, green and blue. Raises OutputError."""
    before, after = (np.stack([of[name] for name in names], axis=-1) for of in (views.before, views.after))
    sheet = _sheet(before, after, f"before: {', '.join(names)} as red, green, blue", "after")
    write_png(sheet, path)


def _sheet(before: Picture, after: Picture, title_before: str, title_after: str) -> Picture:
    height, width = before.shape[:2]
    overview = _OVERVIEW_PX, max(1, round(_OVERVIEW_PX * height / width))
    side_x = min(width, _ZOOM_SOURCE_PX)
    side_y = max(1, min(height, round(side_x * height / width)))
    zoom_x, zoom_y = busiest_window(after[..., 2], (side_x, side_y))
    columns = []
    for image, title in ((before, title_before), (after, title_after)):
        whole = cv2.resize(image, overview, interpolation=cv2.INTER_AREA)
        scale = overview[0] / width
        corner = round(zoom_x * scale), round(zoom_y * scale)
        opposite = round((zoom_x + side_x) * scale), round((zoom_y + side_y) * scale)
        cv2.rectangle(whole, corner, opposite, (255, 255, 255), 1)
        detail = image[zoom_y : zoom_y + side_y, zoom_x : zoom_x + side_x]
        detail = cv2.resize(detail, overview, interpolation=cv2.INTER_NEAREST)
        strip = np.full((_TITLE_PX, overview[0], 3), 255, np.uint8)
        gap = np.full((_GAP_PX, overview[0], 3), 255, np.uint8)
        columns.append(np.vstack([with_text(strip, title, (2, 18)), whole, gap, detail]))
    between = np.full((columns[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.hstack([columns[0], between, columns[1]])


def busiest_window(image: Grey, size_px: tuple[int, int]) -> tuple[int, int]:
    """(x, y) of the window (width, height) with the most edges: there a misalignment shows."""
    (height, width), (side_x, side_y) = image.shape, size_px
    edges = np.abs(cv2.Laplacian(image.astype(np.float32), cv2.CV_32F)).clip(0, 60)
    activity = cv2.boxFilter(edges, -1, size_px, anchor=(0, 0), normalize=True)
    inside = activity[: height - side_y + 1, : width - side_x + 1]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(x), int(y)
