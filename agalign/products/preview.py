"""The preview of a capture: all bands in grey, before and after alignment, on one JPEG, from which the report composes
colour pictures of any three bands; and the before/after picture, three bands as red, green and blue, so that
misalignment shows as colour.

The JPEG has a column for each band of the sidecar, in its order, and these rows:

    0  the raw files, each resized to the reference's file
    1  the written bands; black for a band that was not written
    2  a detail of row 0, where there are most edges, at the resolution of the reduced bands
    3  the same detail of row 1
    4  if error maps are written: the expected error, white for `ERROR_FULL_PX` and more
    5  (4 without error maps) in the first column, if the capture has a relief: its parallax, white for the nearest
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.products.drawing import Grey, Picture, ReducedBands, encoded, with_text, write_png
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.quality_raster import error_lattice_px
from agalign.products.relief_map import relief_layers, relief_of
from agalign.products.sidecar import PreviewPart, ReliefPreviewPart
from agalign.values.capture import Band
from agalign.values.files import complete_file
from agalign.values.image import reduced_size_px

ERROR_FULL_PX = 0.5
"""Expected error that is shown as white."""
_MAX_TILE_PX, _MIN_TILE_PX, _DETAIL_SHARE = 640, 96, 0.35
"""Limits of the longer side of a tile, and the size of a detail as a share of a tile."""
_RELIEF_PERCENTILES = 1.0, 99.0
"""Percentiles shown as black and white: a few wrong pixels must not determine the contrast."""
_QUALITY = 35
"""JPEG quality."""
_BLOCK_PX = 8
"""Side of a JPEG block: tiles are multiples of it, so that compression does not mix neighbouring tiles."""
_MAX_SHRINK_STEPS = 6
_MAX_BYTES_EACH, _MAX_TOTAL_BYTES = 600_000, 44_000_000
"""Limits that keep the report of a season, which contains all previews, small enough for an e-mail."""
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


def preview_bytes(captures: int) -> int:
    """Return the largest size in bytes of the preview of a capture in a run of this many captures."""
    return min(_MAX_BYTES_EACH, _MAX_TOTAL_BYTES // max(captures, 1))


@dataclass(frozen=True)
class ReliefView:
    """The relief of a capture, reduced to the size of a tile."""

    parallax_px: NDArray[np.float32]
    """(height, width)"""
    range_m: tuple[float, float] | None
    """Smallest and largest range; None if it is unknown."""

    @property
    def limits_px(self) -> tuple[float, float]:
        """Parallax shown as black and as white."""
        low, high = np.percentile(self.parallax_px, _RELIEF_PERCENTILES)
        return float(low), max(float(high), float(low) + 1e-3)

    @property
    def grey(self) -> Grey:
        """The parallax as grey values (height, width)."""
        low, high = self.limits_px
        return np.asarray(np.rint(((self.parallax_px - low) / (high - low)).clip(0, 1) * 255), np.uint8)


class Preview(Product):
    """The bands for the report; also of a failed capture, where they help to find the reason."""

    kind = "preview"
    suffix = ".preview.jpg"
    is_required = False
    needs_layers = False

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.preview.jpg."""
        path, size_px = context.paths.file(self.suffix), context.capture.reference.size_px
        bands = [b.name for b in context.capture.bands]
        mapped = context.usable if context.write_settings.error_map else {}
        errors_px = {name: error_lattice_px(a, size_px, context.grid) for name, a in mapped.items()}
        part = write_preview(
            context.reduced_bands, bands, errors_px, path, context.max_preview_bytes, relief_view(context)
        )
        return [WrittenFile(self.kind, path, preview=part)]


def relief_view(context: ProductContext) -> ReliefView | None:
    """Return the reduced relief of a capture; None if no band is displaced by one."""
    relief = relief_of(context.usable)
    if relief is None:
        return None
    reduction = max(1.0, max(context.grid.width, context.grid.height) / _MAX_TILE_PX)
    size_px = reduced_size_px((context.grid.width, context.grid.height), reduction)
    layers = relief_layers(context.capture, context.usable, relief, context.grid, size_px)
    range_m = layers["range"][np.isfinite(layers["range"])]
    if range_m.size == 0:
        return ReliefView(layers["parallax"], None)
    near, far = np.percentile(range_m, _RELIEF_PERCENTILES).tolist()
    return ReliefView(layers["parallax"], (near, far))


def write_preview(
    views: ReducedBands,
    bands: Sequence[str],
    errors_px: Mapping[str, NDArray[np.float32]],
    path: Path,
    max_bytes: int,
    relief: ReliefView | None = None,
) -> PreviewPart:
    """Write the preview, with tiles as large as `max_bytes` allows.

    The detail is where the first of the bands has most edges. `errors_px` has the expected error (rows, columns) by
    band, or is empty. Raises OutputError.
    """
    longest_px = max(views.size_px)
    tile_px = min(_MAX_TILE_PX, longest_px)
    for _ in range(_MAX_SHRINK_STEPS):
        part, sheet = _sheet(views, bands, errors_px, relief, tile_px / longest_px, path.name)
        data = encoded(sheet, path, cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
        if len(data) <= max_bytes or tile_px <= _MIN_TILE_PX:
            break
        # The size is proportional to the area of a tile.
        tile_px = max(_MIN_TILE_PX, int(tile_px * 0.97 * (max_bytes / len(data)) ** 0.5))
    with complete_file(path) as partial:
        partial.write_bytes(data)
    return part


def _sheet(
    views: ReducedBands,
    bands: Sequence[str],
    errors_px: Mapping[str, NDArray[np.float32]],
    relief: ReliefView | None,
    scale: float,
    name: str,
) -> tuple[PreviewPart, Grey]:
    width, height = views.size_px
    tile_px = _whole_blocks(width * scale, width), _whole_blocks(height * scale, height)
    detail_px = _whole_blocks(tile_px[0] * _DETAIL_SHARE, width), _whole_blocks(tile_px[1] * _DETAIL_SHARE, height)
    first = next(images[n] for n in bands for images in (views.after, views.before) if n in images)
    x, y = busiest_window(first, detail_px)
    detail = np.s_[y : y + detail_px[1], x : x + detail_px[0]]
    black = np.zeros((height, width), np.uint8)
    before, after = ([images.get(n, black) for n in bands] for images in (views.before, views.after))
    rows = [[_resized(image, tile_px) for image in images] for images in (before, after)]
    rows += [[image[detail] for image in images] for images in (before, after)]
    if errors_px:
        errors = [_as_grey(errors_px[n]) if n in errors_px else black for n in bands]
        rows.append([_resized(image, tile_px) for image in errors])
    if relief is not None:
        rows.append([_resized(relief.grey, tile_px)])
    strips = [np.hstack(row) for row in rows]
    sheet_width = max(s.shape[1] for s in strips)
    sheet = np.vstack([np.pad(s, ((0, 0), (0, sheet_width - s.shape[1]))) for s in strips])
    part = PreviewPart(
        file=name,
        tile_px=tile_px,
        detail_px=detail_px,
        detail=(x / width, y / height, detail_px[0] / width, detail_px[1] / height),
        error_full_px=ERROR_FULL_PX if errors_px else None,
        relief=None if relief is None else _relief_part(relief),
    )
    return part, np.asarray(sheet, np.uint8)


def _whole_blocks(length_px: float, max_px: int) -> int:
    return min(max_px, max(_BLOCK_PX, int(length_px / _BLOCK_PX) * _BLOCK_PX))


def _resized(image: Grey, size_px: tuple[int, int]) -> Grey:
    """The image at a size (width, height)."""
    larger = size_px[0] > image.shape[1]
    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA))


def _relief_part(relief: ReliefView) -> ReliefPreviewPart:
    low, high = relief.limits_px
    range_m = None if relief.range_m is None else (round(relief.range_m[0], 3), round(relief.range_m[1], 3))
    return ReliefPreviewPart(parallax_px=(round(low, 2), round(high, 2)), range_m=range_m)


def _as_grey(error_px: NDArray[np.float32]) -> Grey:
    return np.asarray(np.nan_to_num(error_px / ERROR_FULL_PX, nan=1.0).clip(0, 1) * 255, np.uint8)


class BeforeAfterPicture(Product):
    """The bands before and after alignment, with a detail of each."""

    kind = "picture"
    suffix = ".png"
    is_required = False

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.png."""
        path, reference = context.paths.file(self.suffix), context.capture.reference
        chosen = choose_bands([b for b in context.capture.moving if b.name in context.usable], reference)
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
    write_png(_before_and_after(before, after, f"before: {', '.join(names)} as red, green, blue", "after"), path)


def _before_and_after(before: Picture, after: Picture, title_before: str, title_after: str) -> Picture:
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
