"""Rendering: the files of a capture, from its images and the result of its estimation.

A product with an option that an earlier command wrote is written again with the settings of this one, whether they ask
for it or not.
One that cannot be written any more is removed, and the report of the capture names it.
"""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agalign.batch.capture_report import CaptureReport
from agalign.batch.output_files import outdated_files, remove_files
from agalign.batch.products import PRODUCTS
from agalign.capture.align_bands import tie_windows
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, UnreadableFileError
from agalign.flight.fingerprint import joined_options, render_fingerprint
from agalign.flight.footprint import accuracy_of_footprint_m, footprint, with_assumed_height
from agalign.pixels.raster import ReadTile, read_tile
from agalign.rasters.aligned_files import BandFiles, Stack
from agalign.rasters.alignment_maps import ReliefMap, error_shares
from agalign.rasters.output_grid import output_layers
from agalign.rasters.product import CapturePaths, LostFile, ProductContext, RenderOptions, WrittenFile
from agalign.records.sidecar import (
    BandRadiometryPart,
    BandResult,
    FilePart,
    IlluminationPart,
    OutputPart,
    PlacePart,
    Sidecar,
    capture_status,
)
from agalign.records.sidecar_file import file_part, write_sidecar
from agalign.spectral_indices.rasters import impossible_indices, index_rasters
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.choices import RadiometryChoice
from agalign.values.image import OutputGrid
from agalign.values.radiometric_errors import saturation_error
from agalign.values.radiometry import Radiometry, total_percent

_ADDED = {product.option: product.kind for product in PRODUCTS if product.option} | {"relief_map": "relief"}
"""Settings that add files or layers, and the kind of product that shows that these exist."""
_FOOTPRINT_DECIMALS = 7
"""Of degrees: a centimetre."""


def with_earlier_products(settings: WriteSettings, sidecar: Sidecar) -> WriteSettings:
    """Return the settings with the products that an earlier command has added; deleted ones are restored."""
    kinds = {part.kind for part in sidecar.products}
    earlier = sidecar.write_options
    return settings.model_copy(
        update={name: True for name, kind in _ADDED.items() if earlier.get(name) and kind in kinds}
    )


def render(
    capture: Capture,
    out: Path,
    settings: Settings,
    sidecar: Sidecar,
    alignments: Mapping[str, Alignment],
    options: RenderOptions,
    read: ReadTile = read_tile,
) -> CaptureReport:
    """Write the products of an estimated capture, and its sidecar with them; return its report, without its time.

    `capture` has the radiometry and the saturation values with which it is written, `alignments` are those of the
    sidecar. `read` reads the pixels of the files. Raises OutputError, UnreadableFileError for an image of the
    reference, and InputError.
    """
    began_s, paths = time.perf_counter(), CapturePaths.of(capture, out)
    write = with_earlier_products(settings.write, sidecar)
    settings = settings.model_copy(update={"write": write})
    outdated = outdated_files(capture, out, write, sidecar.products)
    gone = _gone_indices(sidecar, paths)
    if sidecar.rendered_with:  # a run that is killed now must render again
        sidecar = write_sidecar(paths.sidecar, sidecar.model_copy(update={"rendered_with": ""}))
    whole = OutputGrid(0, 0, *capture.reference.size_px)
    written: list[WrittenFile] = []
    context = ProductContext(capture, paths, settings, sidecar, alignments, (), whole, options, written, read)
    if context.with_pixels:
        layers, grid = output_layers(capture, context.with_pixels, write, options.common, read)
        ties = tie_windows(capture, alignments, read) if write.tie_points else {}
        context = replace(context, layers=layers, grid=grid, ties=ties)
    failures, lost = _write_products(context, written)
    here = {file.path for file in written}
    removed = [(path, reason) for path, reason in outdated.items() if path not in here]
    remove_files([path for path, _ in removed], out)
    reasons = tuple((path, lost.get(path, reason)) for path, reason in removed if reason)
    gone = [part for part in gone if paths.folder / part.file not in here]
    result = rendered_sidecar(context, list(failures), time.perf_counter() - began_s, gone)
    written_sidecar = write_sidecar(paths.sidecar, result).without_tables()
    failed = tuple(dict.fromkeys(failures.values()))  # products that need the same file fail with the same message
    return CaptureReport(
        capture.label,
        "done",
        written_sidecar,
        paths.sidecar,
        failed_products=failed,
        impossible_products=impossible_indices(write.indices, written_sidecar, paths.folder),
        removed=reasons,
    )


def _gone_indices(sidecar: Sidecar, paths: CapturePaths) -> list[FilePart]:
    """Return the entries of index rasters that were deleted or damaged, and of their pictures: only `agalign indices`
    knows their formulas.
    """
    here = {paths.relative(raster.path) for raster in index_rasters(paths.file(""))}
    parts = [part for part in sidecar.products if part.kind == "index"]
    gone = {part.file.removesuffix(".tif") for part in parts if part.file.endswith(".tif") and part.file not in here}
    return [part for part in parts if part.file.removesuffix(".tif").removesuffix(".png") in gone]


def _write_products(context: ProductContext, written: list[WrittenFile]) -> tuple[dict[str, str], dict[Path, str]]:
    """Write the enabled products, and add their files to `written`, which the context has. Return the messages of
    optional ones that failed, by kind, and why files of an earlier command are lost, by path.

    Raises like `Product.write`.
    """
    failures, lost = dict[str, str](), dict[Path, str]()
    for product in PRODUCTS:
        if not product.is_enabled(context.settings.write) or (product.needs_layers and not context.layers):
            continue
        try:
            for file in product.write(context):
                if isinstance(file, LostFile):
                    lost[file.path] = file.reason
                else:  # at once: the sidecar also lists the files before an error, so that they are removed later
                    written.append(file)
        except AgalignError as error:
            if product.is_required:
                raise
            failures[product.kind] = str(error)
    return failures, lost


# ---- the part of the sidecar that describes the rendered files


def rendered_sidecar(
    context: ProductContext, not_written: Sequence[str] = (), seconds: float = 0.0, gone: Sequence[FilePart] = ()
) -> Sidecar:
    """Return the sidecar of a capture after its products were written.

    `not_written` has the kinds that failed, `seconds` is the time of rendering, and `gone` has files that were deleted
    and that only another command can write. Raises OutputError.
    """
    sidecar, capture, bands = context.sidecar, context.capture, _bands(context)
    shown = with_assumed_height(capture)
    ring = footprint(shown, context.grid)
    accept_predicted_px = context.settings.check.accept_predicted_px
    return sidecar.model_copy(
        update={
            "bands": bands,
            "status": capture_status(bands, capture.missing_bands, accept_predicted_px),
            # Captures with further bands or serial numbers may have been added since the estimation.
            "camera": capture.camera,
            "missing_bands": list(capture.missing_bands),
            "unreadable_bands": {name: str(why) for name, why in capture.unreadable_bands.items()},
            "accept_predicted_px": accept_predicted_px,
            "pose": shown.pose,
            "output": _output(context, {b.band: b.saturated or 0.0 for b in bands}) if context.layers else None,
            # RFC 7946: outer rings are counter-clockwise.
            "footprint": None if ring is None else [(x, y) for x, y in ring[::-1].round(_FOOTPRINT_DECIMALS).tolist()],
            "footprint_accuracy_m": None if ring is None else accuracy_of_footprint_m(shown),
            "preview": next((f.preview for f in context.written if f.preview is not None), None),
            "products": [*(file_part(f.kind, f.path, context.paths.folder, f.sha256) for f in context.written), *gone],
            "not_written": list(not_written),
            "rendered_with": render_fingerprint(capture, context.settings.write, context.settings.check),
            "options": joined_options(sidecar.options, context.settings.model_dump(mode="json", exclude_defaults=True)),
            "seconds": round(sum(band.seconds for band in sidecar.bands) + seconds, 3),
        }
    )


def _bands(context: ProductContext) -> list[BandResult]:
    """The entries of the bands, with what is known of their pixels."""
    saturated: dict[str, float] = {}
    with suppress(UnreadableFileError):  # the preview has failed with this reason
        saturated = dict(context.reduced_bands.saturated)
    for name, clipped in context.clipped.items():
        saturated[name] = max(saturated.get(name, 0.0), float(clipped.mean()))
    relief = next((context.paths.relative(f.path) for f in context.written if f.kind == ReliefMap.kind), None)
    result = []
    for band in context.sidecar.bands:
        facts: dict[str, Any] = {"place": None, "saturated": saturated.get(band.band)}
        facts |= {"share_over_1_px": None, "moved_share": None}
        if (place := context.places.get(band.band)) is not None:  # None if all pixels are nodata
            facts["place"] = PlacePart(file=context.paths.relative(place[0].path), band_index=place[1])
            if band.band in context.with_pixels:
                of_band = context.with_pixels[band.band], context.capture.reference, context.grid
                facts["share_over_1_px"], facts["moved_share"] = error_shares(*of_band)
        if band.relief is not None:
            facts["relief"] = band.relief.model_copy(update={"file": relief})
        result.append(band.model_copy(update=facts))
    return result


def _output(context: ProductContext, saturated: Mapping[str, float]) -> OutputPart:
    """The part about the rasters, given the share of saturated pixels by band."""
    stack = [f for f in context.written if f.kind == Stack.kind]
    values = {f.nodata_in_json for f in stack or [f for f in context.written if f.kind == BandFiles.kind]}
    grid, capture = context.grid, context.capture
    radiometry = {b.name: b.radiometry for b in capture.bands if b.radiometry is not None and not context.is_raw}
    bands = [_band_radiometry(name, r, saturated.get(name, 0.0)) for name, r in radiometry.items()]
    return OutputPart(
        file=context.paths.relative(stack[0].path) if stack else None,
        bands=[layer.band.name for layer in context.layers],
        radiometry=" and ".join(dict.fromkeys(f"{part.quantity} by {part.source}" for part in bands)) or None,
        panel_age_s=max((r.panel_age_s for r in radiometry.values() if r.panel_age_s is not None), default=None),
        illumination=[
            IlluminationPart(band=name, irradiance=r.irradiance, reflectance_per_radiance=r.factor)
            for name, r in radiometry.items()
            if "reflectance" in r.quantity
        ],
        band_radiometry=bands,
        crop=(grid.x0, grid.y0, grid.width, grid.height),
        scale=(grid.scale.x, grid.scale.y),
        undistorted=grid.undistorted,
        vignetting_corrected=any(file.is_flat for file in context.written),
        nodata=values.pop() if len(values) == 1 else None,
        without_reflectance=lost_reflectance(capture, context.settings.write.radiometry),
    )


def lost_reflectance(capture: Capture, choice: RadiometryChoice) -> str | None:
    """Return the implausible or lacking tag by which `auto` writes radiance instead of reflectance; None if there is
    none.
    """
    lost = (b for b in capture.bands if b.implausible and b.radiometry is not None and b.radiometry.is_of_light)
    return next((f"{b.name}: {b.implausible}" for b in lost), None) if choice == "auto" else None


def _band_radiometry(band: str, radiometry: Radiometry, saturated: float) -> BandRadiometryPart:
    """The part about the values of a band, given the share of its pixels that are saturated."""
    facts: dict[str, Any] = {"band": band, "quantity": radiometry.quantity, "source": radiometry.source}
    if radiometry.quantity == "temperature":
        return BandRadiometryPart(**facts, std_percent=math.nan, errors=[])
    errors = [*radiometry.errors, *([saturation_error(saturated)] if saturated else [])]
    means = np.array(radiometry.cell_means) if radiometry.cell_means else None
    return BandRadiometryPart(**facts, std_percent=total_percent(errors), errors=errors, cell_means=means)
