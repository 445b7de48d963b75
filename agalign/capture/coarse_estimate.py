"""Prediction of bands with few pixels, such as thermal ones, from windows that are too few to verify an alignment.

Temperature and reflectance differ: often only a third of the windows of a thermal image have structure in common with
another band. If nearly all of these agree with a trusted seed, they determine the mapping and its standard error.
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
"""Minimum number of measured windows, which overlap by half: twice the parameters of a homography."""
_CLOSE_PX = 3.0
"""Maximum residual of a consistent window, px of the reduced reference: 1.5 px of the band. By chance, one in a hundred
windows of at least 56 px has a smaller one."""
_MIN_CLOSE_SHARE = 0.85
"""Minimum share of consistent windows among the measured ones."""
_ROUNDS = 3
"""Rounds of warping and fitting: correlation peaks are sharper when windows overlap better."""


def predicted_if_coarse(pair: BandPair, alignment: Alignment[FixedImagePx]) -> Alignment[FixedImagePx]:
    """Return the prediction of a coarse band by windows that agree with its seed.

    The alignment is returned unchanged if the band is not coarse, is aligned or predicted, if its seed is not trusted,
    few windows agree with it, or the scene is repetitive.
    """
    if not pair.is_coarse or alignment.status in ("aligned", "predicted") or not alignment.seed.trusted:
        return alignment
    start = replace(alignment, mapping=pair.mapping(alignment.seed.fixed_to_moving))
    for _ in range(_ROUNDS):
        mapping = replace(start.mapping, local=None)
        fit = _fit(pair, mapping)
        if fit is None:
            return alignment
        start = with_fit(pair, start, fit)
    warped_pair = WarpedPair.of(pair, start.mapping)
    return alignment if alias_peak(*warped_pair.reduced_spectra()).ratio > MAX_ALIAS_PEAK else start


def _fit(pair: BandPair, mapping: PixelMapping) -> LensFit | None:
    """Return the correction of a mapping by windows; None if few are measured or consistent."""
    residual = pair.reference.overlapping_windows.residuals(pair.warped_moving(mapping))
    fit = fit_with_lens(mapping, residual, pair.fixed.size_px, calibrated=pair.space == "undistorted")
    return fit if _is_consistent(fit, residual) else None


def _is_consistent(fit: LensFit, residual: Residual[FixedImagePx]) -> bool:
    measured = np.isfinite(residual.shifts_px[:, 0])
    if measured.sum() < _MIN_WINDOWS:
        return False
    lengths_px = np.linalg.norm(fit.residuals_px(residual.centres_px[measured], residual.shifts_px[measured]), axis=1)
    return bool((lengths_px <= _CLOSE_PX).mean() >= _MIN_CLOSE_SHARE)
