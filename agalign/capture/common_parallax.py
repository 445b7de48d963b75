"""Parallax that the bands of a capture have in common: which bands, how much, and the model of their windows.

The residuals of the homographies contain it. Distortion of lenses, which lens shapes explain, is not parallax.
"""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import RefinedBand
from agalign.errors import GeometryError
from agalign.fit.adjustment import Adjustment, WindowShifts, adjust, are_of_lenses, are_on_a_line
from agalign.fit.displacement_field import MIN_WINDOWS
from agalign.fit.window_fit import fit_windows
from agalign.fit.windows import residual_under
from agalign.values.residual import Residual

MIN_PARALLAX_PX = 0.3
"""Minimum p95 of the parallax of windows for a relief; windows of flat fields have up to 0.2 px, mostly noise."""
MIN_BANDS = 2
"""Minimum number of moving lenses: a relief is verified with the other lenses."""


def parallax_groups(bands: Sequence[RefinedBand]) -> list[list[RefinedBand]]:
    """Group the bands by reference image and space of the homographies; sharp ones only, if these are enough.

    Bands without retrieval of held-out patches, with few measured windows or low resolution are excluded.
    """
    groups: dict[tuple[int, str], list[RefinedBand]] = {}
    for band in bands:
        pair, residual = band.pair, band.warped.residual
        is_reliable = band.joint.is_retrieved and len(residual.measured_px) >= MIN_WINDOWS
        if is_reliable and not pair.is_coarse:
            groups.setdefault((id(pair.reference), pair.space), []).append(band)
    sharp = [[b for b in group if not b.pair.is_blurred] for group in groups.values()]
    return [some if len(some) >= MIN_BANDS else group for some, group in zip(sharp, groups.values(), strict=True)]


def common_parallax_px(group: Sequence[RefinedBand]) -> tuple[float, bool]:
    """Return the p95 of the parallax that is common to the bands, 0 if there is none, and if the baselines are on one
    line without tags that confirm them.

    The distortion of the reference's lens is common to the bands too. What lens shapes explain is not parallax.
    """
    residuals = [_beyond_lens_shapes(b, r) for b, r in zip(group, _common_residuals(group), strict=True)]
    # The p95 ignores single wrong peaks, which are not parallax.
    if max((r.p95_px for r in residuals if len(r.lengths_px)), default=0.0) < MIN_PARALLAX_PX:
        return 0.0, False
    windows = WindowShifts.of(residuals, [band.warped.mapping for band in group])
    consistent = consistent_bands(windows, group)
    if consistent is None:
        return 0.0, False
    bands, model = consistent
    parallax_px = float(np.percentile(np.abs(model.parallax_px), 95))
    return parallax_px, layout_of([group[band].pair for band in bands]) is None and are_on_a_line(model.baselines)


def _common_residuals(group: Sequence[RefinedBand]) -> list[Residual]:
    """Return the residuals of all bands in the same windows: large ones if any band is blurred, else the smallest that
    the residual of any band uses.
    """
    smallest = min((band.warped.windows for band in group), key=lambda windows: windows.side)
    common = group[0].pair.reference.large_windows if any(band.pair.is_blurred for band in group) else smallest
    return [b.warped.residual if b.warped.windows is common else common.residuals(b.warped.warped) for b in group]


def _beyond_lens_shapes(band: RefinedBand, residual: Residual) -> Residual:
    """Return the residual under the homography and the lens shapes that fit it, where no rig contains these."""
    pair, mapping = band.pair, band.warped.mapping
    if pair.unknown_lens_std_px is None:
        return residual
    fit = fit_windows(mapping, residual, pair.fixed.size_px, pair.unknown_lens_std_px)
    assert fit is not None  # the prior of the shapes determines them
    with suppress(GeometryError):
        return residual_under(residual, mapping, fit.applied_to(mapping))
    return residual


def layout_of(pairs: Sequence[BandPair]) -> NDArray[np.float64] | None:
    """Return the layouts (bands, 2) of pairs; None if the tags lack one."""
    layouts = [pair.layout for pair in pairs]
    return None if any(layout is None for layout in layouts) else np.array(layouts, float)


def consistent_bands(
    windows: WindowShifts, group: Sequence[RefinedBand], lens_std: NDArray[np.float64] | None = None
) -> tuple[list[int], Adjustment] | None:
    """Adjust the model to the bands with common parallax; return their indices and the model, or None.

    A band that the parallax of the others does not explain is left out, one after another. Lens shapes are fitted with
    the standard deviations `lens_std` (4,), not without.
    """
    size_px = group[0].pair.fixed.size_px
    # Residual of a band relative to that of the others: up to 1.4 for bands of the same time, 2.4 for a photograph of
    # another time. Residuals below the minimum are accepted anyway.
    max_scale_ratio, min_foreign_px = 2.0, 0.4

    def adjusted(bands: Sequence[int], lens_std: NDArray[np.float64] | None) -> Adjustment | None:
        layout, some = layout_of([group[band].pair for band in bands]), windows.of_bands(bands)
        model = adjust(some, size_px, layout, lens_std) if some.are_enough(MIN_WINDOWS) else None
        return model if model is not None and are_of_lenses(model.baselines, layout) else None

    def without(foreign: int) -> tuple[float, int]:
        """Return the residual scale without a band, px, infinite if no model exists, and the windows of the band."""
        model, own = adjusted([b for b in kept if b != foreign], None), int((windows.weights[:, foreign] > 0).sum())
        return math.inf if model is None else float(np.median(model.scales_px)), own

    kept = list(range(windows.shifts_px.shape[1]))
    model = adjusted(kept, lens_std)
    while len(kept) > MIN_BANDS:
        if model is None:
            kept.remove(min(kept, key=without))
        else:
            worst = int(model.scales_px.argmax())
            others_px = float(np.median(np.delete(model.scales_px, worst)))
            if model.scales_px[worst] <= max(min_foreign_px, max_scale_ratio * others_px):
                break
            kept.pop(worst)
        model = adjusted(kept, lens_std)
    return None if model is None else (kept, model)
