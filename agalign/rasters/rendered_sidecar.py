"""The part of a sidecar that describes the rendered files."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from agalign.errors import UnreadableFileError
from agalign.flight.fingerprint import RENDER_STAGES, render_fingerprint
from agalign.flight.footprint import accuracy_of_footprint_m, footprint, with_assumed_height
from agalign.rasters.aligned_files import BandFiles, Stack
from agalign.rasters.alignment_maps import ReliefMap, share_over_1_px
from agalign.rasters.product import ProductContext
from agalign.records.sidecar import (
    BandResult,
    FilePart,
    IlluminationPart,
    OutputPart,
    PlacePart,
    Sidecar,
    capture_status,
)

_FOOTPRINT_DECIMALS = 7
"""Of degrees: a centimetre."""


def rendered(
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
            # Captures with further bands may have been added since the estimation.
            "missing_bands": list(capture.missing_bands),
            "unreadable_bands": dict(capture.unreadable_bands),
            "accept_predicted_px": accept_predicted_px,
            "pose": shown.pose,
            "output": _output(context) if context.layers else None,
            # RFC 7946: outer rings are counter-clockwise.
            "footprint": None if ring is None else [(x, y) for x, y in ring[::-1].round(_FOOTPRINT_DECIMALS).tolist()],
            "footprint_accuracy_m": None if ring is None else accuracy_of_footprint_m(shown),
            "preview": next((f.preview for f in context.written if f.preview is not None), None),
            "products": [*(_file(context, file.kind, file) for file in context.written), *gone],
            "not_written": list(not_written),
            "rendered_with": render_fingerprint(capture, context.settings.write, context.settings.check),
            "options": _options(context),
            "seconds": round(sum(band.seconds for band in sidecar.bands) + seconds, 3),
        }
    )


def _bands(context: ProductContext) -> list[BandResult]:
    """The entries of the bands, with what is known of their pixels."""
    saturated: dict[str, float] = {}
    with suppress(UnreadableFileError):  # the preview has failed with this reason
        saturated = dict(context.reduced_bands.saturated)
    relief = next((context.paths.relative(f.path) for f in context.written if f.kind == ReliefMap.kind), None)
    result = []
    for band in context.sidecar.bands:
        facts: dict[str, Any] = {"place": None, "saturated": saturated.get(band.band), "share_over_1_px": None}
        if (place := context.places.get(band.band)) is not None:  # None if all pixels are nodata
            facts["place"] = PlacePart(file=context.paths.relative(place[0].path), band_index=place[1])
            if band.band in context.with_pixels:
                alignment = context.with_pixels[band.band]
                facts["share_over_1_px"] = share_over_1_px(alignment, context.capture.reference, context.grid)
        if band.relief is not None:
            facts["relief"] = band.relief.model_copy(update={"file": relief})
        result.append(band.model_copy(update=facts))
    return result


def _options(context: ProductContext) -> dict[str, Any]:
    """The settings that differ from the defaults: of the estimation, and of this rendering."""
    now = context.settings.model_dump(mode="json", exclude_defaults=True)
    estimated = {k: v for k, v in (context.sidecar.options or {}).items() if k not in RENDER_STAGES}
    return estimated | {k: v for k, v in now.items() if k in RENDER_STAGES}


def _file(context: ProductContext, kind: str, file: Any) -> FilePart:
    name = context.paths.relative(file.path)
    return FilePart(kind=kind, file=name, bytes=file.path.stat().st_size, sha256=file.sha256)


def _output(context: ProductContext) -> OutputPart:
    stack = [f for f in context.written if f.kind == Stack.kind]
    values = {f.nodata_in_json for f in stack or [f for f in context.written if f.kind == BandFiles.kind]}
    grid, capture = context.grid, context.capture
    radiometry = {b.name: b.radiometry for b in capture.bands if b.radiometry is not None and not context.is_raw}
    names = dict.fromkeys(f"{r.quantity} by {r.source}" for r in radiometry.values())
    return OutputPart(
        file=context.paths.relative(stack[0].path) if stack else None,
        bands=[layer.band.name for layer in context.layers],
        radiometry=" and ".join(names) or None,
        panel_age_s=next((r.panel_age_s for r in radiometry.values() if r.panel_age_s is not None), None),
        illumination=[
            IlluminationPart(band=name, irradiance=r.irradiance, reflectance_per_radiance=r.factor)
            for name, r in radiometry.items()
            if "reflectance" in r.quantity
        ],
        crop=(grid.x0, grid.y0, grid.width, grid.height),
        scale=(grid.scale.x, grid.scale.y),
        undistorted=grid.undistorted,
        vignetting_corrected=any(file.is_flat for file in context.written),
        nodata=values.pop() if len(values) == 1 else None,
    )
