"""Parallax that the bands of a capture have in common: whether windows show a relief, and which bands take part."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agalign.capture.candidate import RefinedBand
from agalign.fit.displacement_field import MIN_WINDOWS
from agalign.fit.window_fit import Adjustment, WindowShifts, adjust, are_of_lenses, are_on_a_line
from agalign.values.residual import Residual

MIN_BANDS = 2
"""Minimum number of moving lenses: a relief is verified with the other lenses."""
MIN_PARALLAX_PX = 0.3
"""Minimum p95 of the parallax of windows for a relief; windows of flat fields have up to 0.2 px, mostly noise."""


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
    """
    residuals = _common_residuals(group)
    # The p95 is robust, as a wrong peak is no parallax.
    if max((r.p95_px for r in residuals if len(r.lengths_px)), default=0.0) < MIN_PARALLAX_PX:
        return 0.0, False
    windows = WindowShifts.of(residuals, [band.warped.mapping for band in group])
    consistent = consistent_bands(windows, group)
    if consistent is None:
        return 0.0, False
    bands, model = consistent
    parallax_px = float(np.percentile(np.abs(model.parallax_px), 95))
    return parallax_px, layout_of([group[band] for band in bands]) is None and are_on_a_line(model.baselines)


def _common_residuals(group: Sequence[RefinedBand]) -> list[Residual]:
    """Return the residuals of all bands in the same windows: large ones if any band is blurred, else the smallest that
    the residual of any band uses.
    """
    smallest = min((band.warped.windows for band in group), key=lambda windows: windows.side)
    common = group[0].pair.reference.large_windows if any(band.pair.is_blurred for band in group) else smallest
    return [b.warped.residual if b.warped.windows is common else common.residuals(b.warped.warped) for b in group]


def layout_of(group: Sequence[RefinedBand]) -> NDArray[np.float64] | None:
    """Return the layouts (bands, 2) of bands; None if the tags lack one."""
    layouts = [band.pair.layout for band in group]
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
        layout, some = layout_of([group[band] for band in bands]), windows.of_bands(bands)
        model = adjust(some, size_px, layout, lens_std) if some.are_enough(MIN_WINDOWS) else None
        return model if model is not None and are_of_lenses(model.baselines, layout) else None

    def median_scale_px(bands: Sequence[int]) -> float:
        model = adjusted(bands, None)
        return math.inf if model is None else float(np.median(model.scales_px))

    kept = list(range(windows.shifts_px.shape[1]))
    model = adjusted(kept, lens_std)
    while len(kept) > MIN_BANDS:
        if model is None:
            worst = int(np.argmin([median_scale_px([b for b in kept if b != foreign]) for foreign in kept]))
        else:
            worst = int(model.scales_px.argmax())
            others_px = float(np.median(np.delete(model.scales_px, worst)))
            if model.scales_px[worst] <= max(min_foreign_px, max_scale_ratio * others_px):
                break
        kept.pop(worst)
        model = adjusted(kept, lens_std)
    return None if model is None else (kept, model)
