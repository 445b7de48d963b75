"""Alignments that are extrapolated to a part of the image without common structure.

Differences of lens distortion cause errors of the homography there that no residual contains. The distortion is
estimated too, and the alignment becomes a prediction with a standard error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.verification import WarpedPair
from agalign.errors import GeometryError
from agalign.flight.rig import Rig
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction
from agalign.values.issues import Issue
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.extrapolation_check import issues_of_extrapolation, points_in_frame
from agalign.verify.lens_shapes import LensFit, fit_with_lens


def without_extrapolated(
    pairs: Sequence[BandPair], result: Mapping[str, Alignment[FixedImagePx]], rig: Rig | None = None
) -> dict[str, Alignment[FixedImagePx]]:
    """Return the alignments; those `aligned` but extrapolated over a quarter of the image become `predicted`.

    Bands that the rig covers and georeferenced files, which have no lens distortion, are not changed.
    """
    checked = dict(result)
    for pair in pairs:
        alignment = result[pair.name]
        if alignment.status != "aligned" or "geo" in pair.candidates or _is_covered(pair, rig):
            continue
        assert alignment.residual is not None
        in_frame_px = points_in_frame(alignment.mapping.of_the_plane, pair.fixed.size_px, pair.moving.size_px)
        issues = issues_of_extrapolation(alignment.residual, pair.fixed.size_px, in_frame_px)
        if issues:
            checked[pair.name] = _extrapolated(pair, alignment, issues)
    return checked


def _is_covered(pair: BandPair, rig: Rig | None) -> bool:
    """Return True if the band's mapping in the flight's rig was observed in all parts of the image."""
    return rig is not None and pair.has_rig_pixels and pair.has_rig and rig.covers(pair.name)


def _extrapolated(
    pair: BandPair, alignment: Alignment[FixedImagePx], issues: tuple[Issue, ...]
) -> Alignment[FixedImagePx]:
    """Return the MAP estimate of homography and lens distortion from the windows as a prediction."""
    size_px = pair.fixed.size_px
    # A displacement field that was fitted to the windows is extrapolated too and therefore replaced.
    start = replace(alignment.mapping.of_the_plane, local=None)
    fit = fit_with_lens(
        start, WarpedPair.of(pair, start).residual, size_px, calibrated=pair.space == "undistorted"
    )  # fmt: skip
    return with_fit(pair, replace(alignment, issues=issues), fit)


def with_fit(pair: BandPair, alignment: Alignment[FixedImagePx], fit: LensFit) -> Alignment[FixedImagePx]:
    """Return the alignment as `predicted` by the corrected homography and lens field, with the error of the fit."""
    size_px = pair.fixed.size_px
    try:
        corrected = geometry.compose(
            alignment.fixed_to_moving, geometry.moving_corners(fit.mean_px[:8], *size_px)
        )  # fmt: skip
    except GeometryError:
        corrected = alignment.fixed_to_moving
    mapping = pair.mapping(corrected, fit.field())
    std_px = FixedImagePx(fit.std_px(points_in_frame(mapping, size_px, pair.moving.size_px)))
    to_file_px = np.r_[np.tile(pair.scales.fixed.inverse, 4), np.full(4, pair.scales.fixed.inverse.mean)]
    prediction = Prediction(
        pair.scales.between_files(corrected), "windows", pair.in_moving_file_px(std_px, corrected),
        covariance_px2=fit.covariance_px2 * np.outer(to_file_px, to_file_px),
    )  # fmt: skip
    return replace(
        alignment, mapping=mapping, status="predicted", residual=WarpedPair.of(pair, mapping).residual,
        prediction=prediction,
    )  # fmt: skip
