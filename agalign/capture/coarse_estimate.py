"""The prediction of a band with few pixels, such as a thermal one, by windows that are too few to verify an alignment.

Warm and bright are different things: often a third of the windows of a thermal image show what another band shows.
Where nearly all of these agree with a seed that its correlation peak confirms, the mapping and its error are known.
"""

from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.extrapolation import with_fit
from agalign.capture.verification import WarpedPair
from agalign.values.alignment import Alignment, Residual
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.lens_shapes import LensFit, fit_with_lens
from agalign.verify.repetition import MAX_ALIAS_PEAK, alias_peak

_MIN_WINDOWS = 16
"""Measured windows, which overlap by a half: twice the unknowns of a homography."""
_CLOSE_PX = 3.0
"""Distance from the fit within which a window agrees, px of the reduced reference: one and a half px of the band. Of
windows of 56 px and more, one in a hundred does by chance."""
_MIN_CLOSE = 0.85
"""Share of the measured windows that must agree."""
_ROUNDS = 3
"""Windows that overlap better have sharper peaks."""


def predicted_if_coarse(pair: BandPair, alignment: Alignment[FixedImagePx]) -> Alignment[FixedImagePx]:
    """The alignment; of a coarse band that is not aligned, the prediction by the windows that agree with its seed.

    It stays as it is where the seed is not trusted, few windows agree, or the scene repeats.
    """
    if not pair.is_coarse or alignment.status in ("aligned", "predicted") or not alignment.seed.trusted:
        return alignment
    start = replace(alignment, fixed_to_moving=alignment.seed.fixed_to_moving, field=pair.field, local=None)
    for _ in range(_ROUNDS):
        mapping = replace(pair.mapping(start.fixed_to_moving), local=None)
        fit = _fit(pair, mapping)
        if fit is None:
            return alignment
        start = with_fit(pair, start, fit)
    if alias_peak(*WarpedPair.of(pair, pair.mapping(start.fixed_to_moving, start.field)).reduced_spectra()).ratio > (
        MAX_ALIAS_PEAK
    ):
        return alignment
    return start


def _fit(pair: BandPair, mapping: PixelMapping) -> LensFit | None:
    """The correction of a mapping by its windows; None where few were measured, or many of them disagree with it."""
    residual = pair.reference.overlapping_windows.residuals(pair.warped_moving(mapping))
    fit = fit_with_lens(mapping, residual, pair.fixed.size_px, calibrated=pair.space == "undistorted")
    return fit if _agrees(fit, residual) else None


def _agrees(fit: LensFit, residual: Residual[FixedImagePx]) -> bool:
    measured = np.isfinite(residual.shifts_px[:, 0])
    if measured.sum() < _MIN_WINDOWS:
        return False
    misfits_px = np.linalg.norm(fit.residuals_px(residual.centres_px[measured], residual.shifts_px[measured]), axis=1)
    return bool((misfits_px <= _CLOSE_PX).mean() >= _MIN_CLOSE)
