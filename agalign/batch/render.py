"""Rendering: the files of a capture, from its images and the result of its estimation.

A product that an earlier command wrote is written again with the settings of this one, whether they ask for it or not.
One that cannot be written any more is removed, and the report of the capture names it.
"""

import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from agalign.capture.align_bands import tie_windows
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, ConfigurationError, OutputError, SidecarError
from agalign.pixels.raster import ReadTile, read_tile
from agalign.products.indices.rasters import index_rasters
from agalign.products.product import CapturePaths, ProductContext
from agalign.products.rasters.aligned_files import band_file_names, is_aligned_raster
from agalign.products.rasters.output_grid import FlightLimits, output_layers
from agalign.products.rasters.parallax_file import PARALLAX_SUFFIX, read_relief
from agalign.products.registry import PRODUCTS
from agalign.products.report.preview import preview_bytes
from agalign.products.sidecar.file import is_sidecar, read_without_tables, write_sidecar
from agalign.products.sidecar.rendered import rendered
from agalign.products.sidecar.schema import Sidecar
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.files import check_inside
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


def with_earlier_products(settings: WriteSettings, sidecar: Sidecar, folder: Path) -> WriteSettings:
    """Return the settings with the products that an earlier command has added and that still exist."""
    kinds = {part.kind for part in sidecar.products if (folder / part.file).is_file()}
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
    write = with_earlier_products(settings.write, sidecar, paths.folder)
    settings = settings.model_copy(update={"write": write})
    outdated = outdated_files(capture, out, write, sidecar)
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
    for path, _ in removed:
        with suppress(OSError, OutputError):
            check_inside(path.parent, out)  # a link may have taken the place of the folder meanwhile
            path.unlink(missing_ok=True)
    reasons = tuple((path, context.lost.get(path, reason)) for path, reason in removed if reason)
    complete = write_sidecar(paths.sidecar, rendered(context, list(failures), time.perf_counter() - began_s))
    # Products that need the same file fail with the same message.
    return Rendering(complete, tuple(dict.fromkeys(failures.values())), reasons)


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


def paths_written(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Return the paths of all files that a run with these settings may write or remove for a capture."""
    paths = CapturePaths.of(capture, out)
    own = [paths.sidecar, paths.file(PARALLAX_SUFFIX)]
    return [*own, *(p for product in PRODUCTS for p in product.paths(capture, paths, settings))]


def refuse_to_overwrite(captures: Sequence[Capture], out: Path, settings: WriteSettings) -> None:
    """Raise ConfigurationError if an output would replace an input image, an output of another capture, or a file that
    no run has written.
    """
    sources = {band.path.resolve() for capture in captures for band in capture.bands}
    resolved: dict[Path, Path] = {}
    written: dict[str, Capture] = {}
    for capture in captures:
        for path in paths_written(capture, out, settings):
            if path.parent not in resolved:
                resolved[path.parent] = check_inside(path.parent, out).resolve()
            if resolved[path.parent] / path.name in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder")
            other = written.setdefault(str(path).lower(), capture)
            if other is not capture:
                raise ConfigurationError(
                    f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
                )
        if foreign := _foreign_file(CapturePaths.of(capture, out).sidecar, paths_written(capture, out, settings)):
            raise ConfigurationError(f"{foreign}: was not written by agalign; choose another output folder with -o")


def _foreign_file(sidecar: Path, written: Sequence[Path]) -> Path | None:
    """Return a file in the place of an output that no run has written; None if there is none.

    The sidecar of a capture is written before its products.
    """
    if sidecar.is_file():
        return None if is_sidecar(sidecar) else sidecar
    existing = [path for path in written if path.is_file() and not path.name.endswith(PARALLAX_SUFFIX)]
    # A sidecar may have been deleted to estimate the capture again.
    return None if any(map(is_aligned_raster, existing)) else next(iter(existing), None)


def outdated_files(capture: Capture, out: Path, settings: WriteSettings, sidecar: Sidecar | None) -> Mapping[Path, str]:
    """Return the files of an earlier command for a capture, which are removed unless they are written again, and why.

    Otherwise a sidecar could describe rasters of another run, and bands on an old grid could remain among new ones.
    Anyone may have written the sidecar: of its other files, only aligned rasters named as bands of this capture are
    returned. The reason is empty for files that users do not miss.
    """
    return {
        path: reason
        for path, reason in _outdated(capture, out, settings, sidecar)
        if path.is_file() and path.resolve() not in {band.path.resolve() for band in capture.bands}
    }


def _outdated(
    capture: Capture, out: Path, settings: WriteSettings, sidecar: Sidecar | None
) -> Iterator[tuple[Path, str]]:
    paths = CapturePaths.of(capture, out)
    with suppress(OutputError):
        check_inside(paths.folder, out)
        for product in PRODUCTS:
            is_unwanted = product.option is None and not product.is_enabled(settings)
            reason = f"--layout {settings.layout}" if is_unwanted else f"{product.kind} is not written again"
            yield from ((path, reason) for path in product.paths(capture, paths, settings))
        listed = [] if sidecar is None else [paths.folder / part.file for part in sidecar.products]
        # Also of a band that this run leaves out; a file with a sidecar is the stack of another capture.
        pattern = re.compile(rf"{re.escape(capture.name)}(\d|[._].+)\.tiff?", re.IGNORECASE)
        own = [p for p in listed if pattern.fullmatch(p.name) and not p.with_suffix(".json").exists()]
        own += [paths.folder / name for name in band_file_names(capture).values()]
        yield from ((p, f"--layout {settings.layout}") for p in own if p in listed and is_aligned_raster(p))
        for raster in index_rasters(paths.file("")):
            yield raster.path, "its bands are not aligned"
            yield raster.path.with_suffix(".png"), ""


def remove_outputs(capture: Capture, out: Path, settings: WriteSettings) -> None:
    """Remove the outputs of an earlier run for a capture that this one does not align."""
    paths, sidecar = CapturePaths.of(capture, out), None
    with suppress(SidecarError):
        sidecar = read_without_tables(paths.sidecar)
    for path in [*outdated_files(capture, out, settings, sidecar), paths.sidecar, paths.file(PARALLAX_SUFFIX)]:
        with suppress(OSError, OutputError):
            check_inside(path.parent, out)
            path.unlink(missing_ok=True)
