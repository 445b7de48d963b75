"""Rendering: the files of a capture, from its images and the result of its estimation.

A product that an earlier command wrote is written again with the settings of this one, whether they ask for it or not.
One that cannot be written any more is removed, and the report of the capture names it.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from agalign.batch.output_files import outdated_files, remove_files
from agalign.batch.products import PRODUCTS
from agalign.capture.align_bands import tie_windows
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError
from agalign.pixels.raster import ReadTile, read_tile
from agalign.rasters.output_grid import FlightLimits, output_layers
from agalign.rasters.parallax_file import read_relief
from agalign.rasters.preview import preview_bytes
from agalign.rasters.product import CapturePaths, ProductContext
from agalign.rasters.rendered_sidecar import rendered
from agalign.records.sidecar import FilePart, Sidecar
from agalign.records.sidecar_file import write_sidecar
from agalign.spectral_indices.rasters import index_rasters
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid

_ADDED = {
    "pan_sharpen": "pan_sharpened",
    "error_map": "error_map",
    "qa": "qa",
    "tie_points": "tie_points",
    "relief_map": "relief",
}
"""Settings that add files or layers, and the kind of product that shows that these exist."""


@dataclass(frozen=True)
class RenderOptions:
    """What the rasters of a capture share with those of its flight."""

    max_preview_bytes: int = preview_bytes(1)
    """About the largest size of the preview."""
    limits: FlightLimits = ()
    """Limits of the flights of the camera."""
    common: OutputGrid | None = None
    """Grid of the captures of the camera, if they share one."""


@dataclass(frozen=True)
class Rendering:
    """The result of rendering a capture."""

    sidecar: Sidecar
    failures: tuple[str, ...]
    """Products that could not be written, and why."""
    removed: tuple[tuple[Path, str], ...]
    """Files of an earlier command that were removed, and why."""


def with_earlier_products(settings: WriteSettings, sidecar: Sidecar) -> WriteSettings:
    """Return the settings with the products that an earlier command has added; deleted ones are restored."""
    kinds = {part.kind for part in sidecar.products}
    earlier = (sidecar.options or {}).get("write", {})
    return settings.model_copy(
        update={name: True for name, kind in _ADDED.items() if earlier.get(name) and kind in kinds}
    )


def render(
    capture: Capture,
    out: Path,
    settings: Settings,
    sidecar: Sidecar,
    options: RenderOptions,
    estimated: Mapping[str, Alignment] | None = None,
    read: ReadTile = read_tile,
) -> Rendering:
    """Write the products of an estimated capture, and its sidecar with them.

    `capture` has the radiometry and the saturation values with which it is written. The mappings are those in the
    sidecar; positions that the `estimated` ones hold are used again. `read` reads the pixels of the files. Raises
    OutputError, UnreadableFileError for an image of the reference or the parallax, and InputError.
    """
    began_s, paths = time.perf_counter(), CapturePaths.of(capture, out)
    write = with_earlier_products(settings.write, sidecar)
    settings = settings.model_copy(update={"write": write})
    outdated = outdated_files(capture, out, write, sidecar.products)
    gone = _gone_indices(sidecar, paths)
    if sidecar.rendered_with:  # a run that is killed now must render again
        sidecar = write_sidecar(paths.sidecar, sidecar.model_copy(update={"rendered_with": ""}))
    alignments = {
        name: _with_held_positions(alignment, (estimated or {}).get(name))
        for name, alignment in sidecar.alignments(read_relief(sidecar, paths.folder)).items()
    }
    whole = OutputGrid(0, 0, *capture.reference.size_px)
    context = ProductContext(
        capture, paths, settings, sidecar, alignments, (), whole, options.max_preview_bytes, options.limits, read=read
    )
    if context.with_pixels:
        layers, grid = output_layers(capture, context.with_pixels, write, options.common, read)
        ties = tie_windows(capture, settings.seed, alignments, read) if write.tie_points else {}
        context = replace(context, layers=layers, grid=grid, ties=ties)
    failures = _write_products(context)
    written = {file.path for file in context.written}
    removed = [(path, reason) for path, reason in outdated.items() if path not in written]
    remove_files([path for path, _ in removed], out)
    reasons = tuple((path, context.lost.get(path, reason)) for path, reason in removed if reason)
    gone = [part for part in gone if paths.folder / part.file not in written]
    complete = write_sidecar(paths.sidecar, rendered(context, list(failures), time.perf_counter() - began_s, gone))
    # Products that need the same file fail with the same message.
    return Rendering(complete, tuple(dict.fromkeys(failures.values())), reasons)


def _gone_indices(sidecar: Sidecar, paths: CapturePaths) -> list[FilePart]:
    """Return the entries of index rasters that were deleted or damaged, and of their pictures: only `agalign indices`
    knows their formulas.
    """
    here = {paths.relative(raster.path) for raster in index_rasters(paths.file(""))}
    parts = [part for part in sidecar.products if part.kind == "index"]
    gone = {part.file.removesuffix(".tif") for part in parts if part.file.endswith(".tif") and part.file not in here}
    return [part for part in parts if part.file.removesuffix(".tif").removesuffix(".png") in gone]


def _with_held_positions(alignment: Alignment, estimated: Alignment | None) -> Alignment:
    if estimated is None or not alignment.mapping.same_as(estimated.mapping):
        return alignment
    return replace(alignment, mapping=estimated.mapping)


def _write_products(context: ProductContext) -> dict[str, str]:
    """Write the enabled products; return {kind: message} of optional ones that failed. Raises like `Product.write`."""
    failures: dict[str, str] = {}
    for product in PRODUCTS:
        if not product.is_enabled(context.settings.write) or (product.needs_layers and not context.layers):
            continue
        try:
            for file in product.write(context):
                # At once: the sidecar also lists the files before an error, so that they are removed later.
                context.written.append(file)
        except AgalignError as error:
            if product.is_required:
                raise
            failures[product.kind] = str(error)
    return failures
