"""The small before/after picture beside each stack: three bands as red, green and blue; misalignment is colour."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.raster import read_preview
from agalign.products.drawing import Picture, with_text, write_png
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid

_OVERVIEW_PX = 480
_ZOOM_SOURCE_PX = 160
_GAP_PX = 8
_TITLE_PX = 26


def choose_bands(bands: list[Band], reference: Band) -> list[Band]:
    """Three bands for red, green and blue: the longest wavelength, a middle one, and the reference."""
    others = [b for b in bands if b is not reference]
    known = sorted((b for b in others if b.wavelength_nm is not None), key=lambda b: b.wavelength_nm or 0.0)
    others = known if len(known) >= 2 else others
    red = max(others, key=lambda b: (b.wavelength_nm or 0.0) if (b.wavelength_nm or 0.0) < 1000 else 0.0)
    rest = [b for b in others if b is not red]
    between = min(rest, key=lambda b: abs((b.wavelength_nm or 668.0) - 668.0)) if rest else reference
    return [red, between, reference]


def write_picture(
    capture: Capture, places: Mapping[str, tuple[Path, int]], grid: OutputGrid, usable: list[Band], path: Path
) -> None:
    """Write the picture of a capture, whose bands were written to `places` on a grid. Raises OutputError."""
    chosen = choose_bands(usable, capture.reference)
    after_planes = [read_preview(*places[b.name], (0, 0, grid.width, grid.height)) for b in chosen]
    before_planes = [_before(b, capture.reference, grid) for b in chosen]
    # Each by its own limits: what is written may be reflectance of what the files have as numbers.
    before, after = (
        np.stack([_stretched(p, _limits(p)) for p in planes], axis=-1) for planes in (before_planes, after_planes)
    )
    names = ", ".join(b.name for b in chosen)
    sheet = _sheet(before, after, f"before: {names} as red, green, blue", "after")
    write_png(sheet, path)


def _before(band: Band, reference: Band, grid: OutputGrid) -> NDArray[np.float32]:
    """The raw file laid on the reference as it is, cut to the grid."""
    sx, sy = (n / (s * m) for n, s, m in zip(band.size_px, grid.scale_xy, reference.size_px, strict=True))
    window = (
        round(grid.x0 * sx), round(grid.y0 * sy), max(1, round(grid.width * sx)), max(1, round(grid.height * sy)),
    )  # fmt: skip
    return read_preview(band.path, band.band_index, window, size_px=_preview_size(grid.width, grid.height))


def _preview_size(width: int, height: int) -> tuple[int, int]:
    """Large images are read reduced: the picture does not need more."""
    reduction = max(1.0, max(width, height) / 2048)
    return round(width / reduction), round(height / reduction)


def _limits(plane: NDArray[np.float32]) -> tuple[float, float]:
    finite = plane[np.isfinite(plane) & (plane != 0)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(finite[:: max(1, finite.size // 200_000)], (1.5, 98.5))
    return float(low), max(float(high), float(low) + 1e-9)


def _stretched(plane: NDArray[np.float32], limits: tuple[float, float]) -> Picture:
    low, high = limits
    return np.asarray((np.clip(np.nan_to_num((plane - low) / (high - low)), 0, 1) * 255).astype(np.uint8))


def _sheet(before: Picture, after: Picture, title_before: str, title_after: str) -> Picture:
    height, width = before.shape[:2]
    overview = _OVERVIEW_PX, max(1, round(_OVERVIEW_PX * height / width))
    zoom_x, zoom_y, side_x, side_y = _busiest_window(after)
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


def _busiest_window(image: Picture) -> tuple[int, int, int, int]:
    """(x, y, width, height) of the window with the most edges: there a misalignment shows."""
    height, width = image.shape[:2]
    side_x = min(width, _ZOOM_SOURCE_PX)
    side_y = max(1, min(height, round(side_x * height / width)))
    edges = np.abs(cv2.Laplacian(image[..., 2].astype(np.float32), cv2.CV_32F)).clip(0, 60)
    activity = cv2.boxFilter(edges, -1, (side_x, side_y), anchor=(0, 0), normalize=True)
    y, x = np.unravel_index(
        int(activity[: height - side_y + 1, : width - side_x + 1].argmax()), (height - side_y + 1, width - side_x + 1)
    )
    return int(x), int(y), side_x, side_y
