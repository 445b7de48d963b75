"""The preview of a capture: all bands in grey, before and after alignment, on one JPEG, from which the report composes
colour pictures of any three bands; and the before/after picture, three bands as red, green and blue, so that
misalignment shows as colour.

The JPEG has a column for each band of the sidecar, in its order, and these rows:

    before         the raw files, each resized to the reference's file
    after          the written bands; black for a band that was not written
    before_detail  a detail of the first row, where there are most edges, at the resolution of the reduced bands
    after_detail   the same detail of the second row
    error          if error maps are written: the expected error, white for `ERROR_FULL_PX` and more
    relief         in the first column, if the capture has a relief: its parallax, white for the nearest
    indices        if any: the indices of the unaligned bands, a column for each, white for the upper end of the colours

`PreviewPart.rows` has their places.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.cameras.base import is_thermal
from agalign.host.files import complete_file
from agalign.rasters.alignment_maps import error_lattice_px, relief_layers
from agalign.rasters.drawing import Grey, ReducedBands, encoded, side_by_side, titled, write_png
from agalign.rasters.product import Product, ProductContext, WrittenFile
from agalign.records.sidecar import PreviewPart, ReliefPreviewPart
from agalign.values.alignment import relief_of
from agalign.values.capture import Band
from agalign.values.image import reduced_size_px
from agalign.values.resampling import NODES_PX
from agalign.values.spectrum import ROLES

ERROR_FULL_PX = 2.0
"""Expected error that is shown as white: twice the largest with which indices use a band."""
_MAX_TILE_PX = 640
"""Limit of the longer side of a tile."""
_DETAIL_SHARE = 0.35
"""Sides of a detail relative to those of a tile."""
_JPEG_QUALITY = 35
"""Low: edges, which show misalignment, remain sharp, and the size limits the resolution."""
_RELIEF_PERCENTILES = 1.0, 99.0
"""Percentiles shown as black and white: a few wrong pixels must not determine the contrast."""


def preview_bytes(captures: int) -> int:
    """Return the largest size in bytes of the preview of a capture in a run of this many captures."""
    # Report and previews of a season together must be small enough for an e-mail.
    return min(600_000, 44_000_000 // max(captures, 1))


ReliefTile = tuple[Grey, ReliefPreviewPart]
"""The relief of a capture, white for the nearest, and the limits of its greys."""


class Preview(Product):
    """The bands for the report; also of a failed capture, where they help to find the reason."""

    kind = "preview"
    suffix = ".preview.jpg"
    is_required = False
    needs_layers = False

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.preview.jpg."""
        path, reference = context.paths.file(self.suffix), context.capture.reference
        bands = [b.name for b in context.capture.bands]
        mapped = context.with_pixels if context.settings.write.error_map else {}
        errors_px = {name: error_lattice_px(a, reference, context.grid, NODES_PX) for name, a in mapped.items()}
        part = write_preview(
            context.reduced_bands, bands, errors_px, path, preview_bytes(context.options.captures), _relief_of(context)
        )
        return [WrittenFile(self.kind, path, preview=part)]


def _relief_of(context: ProductContext) -> ReliefTile | None:
    """The relief of a capture, with the size of a tile; None if no band is displaced by one."""
    relief = relief_of(context.with_pixels)
    if relief is None:
        return None
    reduction = max(1.0, max(context.grid.width, context.grid.height) / _MAX_TILE_PX)
    size_px = reduced_size_px((context.grid.width, context.grid.height), reduction)
    names = "parallax", "range"
    layers = relief_layers(context.capture, context.with_pixels, relief, context.grid, size_px, names=names)
    range_m = layers["range"][np.isfinite(layers["range"])]
    limits_m = tuple(np.percentile(range_m, _RELIEF_PERCENTILES).tolist()) if range_m.size else None
    return relief_tile(layers["parallax"], limits_m)


def relief_tile(parallax_px: NDArray[np.float32], range_m: tuple[float, float] | None) -> ReliefTile:
    """Return the tile of a parallax (height, width), and its limits with those of the range if it is known."""
    low, high = np.percentile(parallax_px, _RELIEF_PERCENTILES).tolist()
    high = max(high, low + 1e-3)
    tile = np.rint(((parallax_px - low) / (high - low)).clip(0, 1) * 255).astype(np.uint8)
    return tile, ReliefPreviewPart(parallax_px=(low, high), range_m=range_m)


def write_preview(
    views: ReducedBands,
    bands: Sequence[str],
    errors_px: Mapping[str, NDArray[np.float32]],
    path: Path,
    max_bytes: int,
    relief: ReliefTile | None = None,
) -> PreviewPart:
    """Write the preview, with tiles as large as `max_bytes` allows.

    The detail is where the first of the bands has most edges. `errors_px` has the expected error (rows, columns) by
    band, or is empty. Raises OutputError.
    """
    longest_px, min_tile_px = max(views.size_px), 96
    tile_px = min(_MAX_TILE_PX, longest_px)

    def smaller_px(size_bytes: float) -> int:
        # The size is proportional to the area of a tile.
        return max(min_tile_px, int(tile_px * 0.97 * (max_bytes / size_bytes) ** 0.5))

    first = next(images[name] for name in bands for images in (views.after, views.before) if name in images)
    size_px = reduced_size_px(views.size_px, longest_px / tile_px)
    of_tile = len(encoded(_resized(first, size_px), path, _JPEG_QUALITY))
    of_all = 2 * len(bands) * of_tile * (1 + _DETAIL_SHARE**2)
    if of_all > max_bytes:
        tile_px = smaller_px(of_all)
    for _ in range(6):  # one step is usually sufficient
        part, sheet = _sheet(views, bands, errors_px, relief, tile_px / longest_px, path.name)
        data = encoded(sheet, path, _JPEG_QUALITY)
        if len(data) <= max_bytes or tile_px <= min_tile_px:
            break
        tile_px = smaller_px(len(data))
    with complete_file(path) as partial:
        partial.write_bytes(data)
    return part


def _sheet(
    views: ReducedBands,
    bands: Sequence[str],
    errors_px: Mapping[str, NDArray[np.float32]],
    relief: ReliefTile | None,
    scale: float,
    name: str,
) -> tuple[PreviewPart, Grey]:
    width, height = views.size_px
    tile_px = _whole_blocks(width * scale, width), _whole_blocks(height * scale, height)
    detail_px = _whole_blocks(tile_px[0] * _DETAIL_SHARE, width), _whole_blocks(tile_px[1] * _DETAIL_SHARE, height)
    first = next(images[n] for n in bands for images in (views.after, views.before) if n in images)
    x, y = busiest_window(first, detail_px)
    black = np.zeros(views.size_px[::-1], np.uint8)
    pictures: dict[str, list[Grey]] = {}
    for when, by_band in (("before", views.before), ("after", views.after)):
        images = [by_band.get(n, black) for n in bands]
        pictures[when] = [_resized(image, tile_px) for image in images]
        pictures[f"{when}_detail"] = [image[y : y + detail_px[1], x : x + detail_px[0]] for image in images]
    if errors_px:
        errors = {n: np.nan_to_num(e / ERROR_FULL_PX, nan=1.0).clip(0, 1) * 255 for n, e in errors_px.items()}
        pictures["error"] = [_resized(np.asarray(errors.get(n, black), np.uint8), tile_px) for n in bands]
    if relief is not None:
        pictures["relief"] = [_resized(relief[0], tile_px)]
    # Like the picture of the index of the aligned bands, which is not smoothed either.
    nearest = partial(cv2.resize, dsize=tile_px, interpolation=cv2.INTER_NEAREST)
    pictures["indices"] = [nearest(image) for image in views.indices_before.values()]
    part = PreviewPart(
        file=name,
        tile_px=tile_px,
        detail_px=detail_px,
        detail=(x / width, y / height, detail_px[0] / width, detail_px[1] / height),
        error_full_px=ERROR_FULL_PX if errors_px else None,
        relief=None if relief is None else relief[1],
        indices=list(views.indices_before),
    )
    strips = {row: np.hstack(images) for row, images in pictures.items() if images}
    *_, (last, _, last_height) = part.rows.values()
    sheet = np.zeros((last + last_height, max(s.shape[1] for s in strips.values())), np.uint8)
    for row, (top, _, row_height) in part.rows.items():
        sheet[top : top + row_height, : strips[row].shape[1]] = strips[row]
    return part, sheet


def _whole_blocks(length_px: float, max_px: int) -> int:
    """A multiple of the side of a JPEG block, so that compression does not mix neighbouring tiles."""
    block_px = 8
    return min(max_px, max(block_px, int(length_px / block_px) * block_px))


def _resized(image: Grey, size_px: tuple[int, int]) -> Grey:
    """The image at a size (width, height)."""
    larger = size_px[0] > image.shape[1]
    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA))


class BeforeAfterPicture(Product):
    """The bands before and after alignment, with a detail of each."""

    kind = "picture"
    suffix = ".png"
    is_required = False

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.png."""
        path, reference = context.paths.file(self.suffix), context.capture.reference
        chosen = choose_bands([b for b in context.capture.moving if b.name in context.with_pixels], reference)
        write_picture(context.reduced_bands, [b.name for b in chosen], path)
        return [WrittenFile(self.kind, path)]


def choose_bands(moving: list[Band], reference: Band) -> list[Band]:
    """Return three bands for red, green and blue: the longest wavelength, the one nearest to red, and the reference."""
    known = sorted((b for b in moving if b.wavelength_nm is not None), key=lambda b: b.wavelength_nm or 0.0)
    candidates = known if len(known) >= 2 else moving
    # Vegetation has few edges in a thermal band.
    longest = max(candidates, key=lambda b: 0.0 if is_thermal(b) else b.wavelength_nm or 0.0)
    rest = [b for b in candidates if b is not longest]
    red_nm = ROLES["red"].nominal_nm
    nearest_to_red = min(rest, key=lambda b: abs((b.wavelength_nm or red_nm) - red_nm)) if rest else reference
    return [longest, nearest_to_red, reference]


def write_picture(views: ReducedBands, names: Sequence[str], path: Path) -> None:
    """Write the picture of three bands as red, green and blue: before and after alignment, each with an overview of
    480 px and a detail, which is enlarged from 160 px, below it. Raises OutputError.
    """
    before, after = (cv2.merge([bands[name] for name in names]) for bands in (views.before, views.after))
    width, height = views.size_px
    size_px, gap_px = (480, max(1, round(480 * height / width))), 8
    detail_width = min(width, 160)
    detail_height = max(1, min(height, round(detail_width * height / width)))
    x0, y0 = busiest_window(after[..., 2], (detail_width, detail_height))
    x1, y1 = x0 + detail_width, y0 + detail_height
    scale = size_px[0] / width
    columns = []
    for image, title in ((before, f"before: {', '.join(names)} as red, green, blue"), (after, "after")):
        overview = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)
        corners = (round(x0 * scale), round(y0 * scale)), (round(x1 * scale), round(y1 * scale))
        cv2.rectangle(overview, *corners, (255, 255, 255), 1)
        detail = cv2.resize(image[y0:y1, x0:x1], size_px, interpolation=cv2.INTER_NEAREST)
        gap = np.full((gap_px, size_px[0], 3), 255, np.uint8)
        columns.append(titled(np.vstack([overview, gap, detail]), title, height_px=26))
    write_png(side_by_side(columns, gap_px), path)


def busiest_window(image: Grey, size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the top-left pixel (x, y) of the window (width, height) with the most edges, where misalignment shows."""
    (height, width), (window_width, window_height) = image.shape, size_px
    # Single strong edges must not determine the position.
    edges = np.abs(cv2.Laplacian(image.astype(np.float32), cv2.CV_32F)).clip(0, 60)
    density = cv2.boxFilter(edges, -1, size_px, anchor=(0, 0), normalize=True)
    inside = density[: height - window_height + 1, : width - window_width + 1]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(x), int(y)
