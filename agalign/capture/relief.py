"""One relief for all bands of a capture: test for parallax, estimation, verification of every band.

The verification of a band uses no pixels of the band to which its mapping was fitted. The homography and the baseline
are fitted to windows in the black fields of a chessboard. The band is verified in larger windows in the white fields,
with the relief that was estimated from the OTHER bands. The output uses the relief of all bands, which is more
accurate.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.corner_fit import corner_correction, with_corners
from agalign.capture.verification import WarpedPair
from agalign.errors import GeometryError
from agalign.pixels.grey import channel_mean
from agalign.relief.dense import DenseMatching, View
from agalign.relief.occlusion import nearer_sign, occluded
from agalign.relief.plane_parallax import (
    PlaneParallax,
    WindowShifts,
    are_of_lenses,
    fit_plane_parallax,
    parallax_of,
)
from agalign.values import geometry
from agalign.values.alignment import MIN_RETRIEVAL, Alignment, JointResult, Residual, Seed
from agalign.values.choices import ReliefUse
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.relief import Parallax, Relief
from agalign.verify.residuals import decrease_sigma

_MIN_BANDS = 2
"""Minimum number of moving lenses: a relief is verified with the other lenses."""
_MIN_WINDOWS = 24
"""Minimum number of measured windows in each band, for the test for parallax and for fits."""
_MIN_PARALLAX_PX = 0.3
"""Minimum p95 of the parallax of windows for a relief; windows of flat fields have up to 0.2 px, mostly noise."""
_MIN_GAIN_SIGMA = 4.0
"""Minimum decrease of the squared shifts of a band by the parallax from the others, in standard errors; below 3 by
chance."""
_FAR_PX, _MAX_FAR_SHARE = 1.0, 0.05
"""A relief is also tried if more than this share of the windows has shifts above _FAR_PX: windows across depth edges
may contain the parallax of neither side, so that the squared shifts do not decrease."""
_MAX_ROUNDS = 2
"""The relief is estimated again after the fit of lens fields, because the first one contains a part of these."""
_MAX_EXCLUDED_BANDS = 2
"""Each excluded band costs the time of one estimate."""
_RANGE_PERCENTILES = (1.0, 99.0)
"""Percentiles of the windows' parallax that limit its range; values beyond are wrong peaks."""


@dataclass(frozen=True)
class ReliefCandidate:
    """A band with a result of the joint optimisation and the residual of its windows."""

    pair: BandPair
    seed: Seed
    joint: JointResult[FixedImagePx]
    warped: WarpedPair


def aligned_by_relief(candidates: Sequence[ReliefCandidate], use: ReliefUse) -> dict[str, Alignment[FixedImagePx]]:
    """Align bands by one relief of the capture; return those that pass verification, by name.

    With `use` "auto" a relief is only estimated if `shows_relief`.
    """
    if use == "never":
        return {}
    result: dict[str, Alignment[FixedImagePx]] = {}
    for group in _comparable(candidates):
        if len(group) >= _MIN_BANDS and (use == "always" or shows_relief(group)):
            result |= _aligned_group(group)
    return result


def _aligned_group(group: Sequence[ReliefCandidate]) -> dict[str, Alignment[FixedImagePx]]:
    """Align the bands of one group by their relief.

    If a band does not pass verification, the relief is estimated again without the worst band, which may bias it.
    """
    result: dict[str, Alignment[FixedImagePx]] = {}
    for _ in range(_MAX_EXCLUDED_BANDS + 1):
        estimate = _Estimate.of(group)
        if estimate is None:
            break
        checked = [estimate.checked(band) for band in estimate.bands]
        passed = {c.name: c.alignment for c in checked if c.alignment is not None}
        if len(passed) < len(result):
            break
        result = passed
        worst = max(checked, key=lambda c: (c.alignment is None, c.p95_px))
        group = [c for c in group if c.pair.name != worst.name]
        if worst.alignment is not None or len(group) < _MIN_BANDS:
            break
    return result


def _comparable(candidates: Sequence[ReliefCandidate]) -> list[list[ReliefCandidate]]:
    """Group the bands by reference image and space of the homographies.

    Bands without retrieval of held-out patches, with few measured windows or low resolution are excluded.
    """
    groups: dict[tuple[int, str], list[ReliefCandidate]] = {}
    for candidate in candidates:
        pair, residual = candidate.pair, candidate.warped.residual
        is_reliable = candidate.joint.retrieval >= MIN_RETRIEVAL and len(residual.measured_px) >= _MIN_WINDOWS
        if is_reliable and not pair.is_coarse:
            groups.setdefault((id(pair.reference), pair.space), []).append(candidate)
    return list(groups.values())


def shows_relief(group: Sequence[ReliefCandidate]) -> bool:
    """Return True if the residuals of the homographies contain parallax that is common to the bands.

    The p95 of the parallax is at least _MIN_PARALLAX_PX, and either many shifts of a band are large, or the parallax
    from the other bands reduces the shifts of the median band significantly.
    """
    windows = WindowShifts.of(_common_residuals(group), [c.warped.mapping for c in group])
    model = _model(group, windows)
    if model is None or np.percentile(np.abs(model.parallax_px), 95) < _MIN_PARALLAX_PX:
        return False
    if max(_far_share(c.warped.residual) for c in group) > _MAX_FAR_SHARE:
        return True
    size_px = group[0].pair.fixed.size_px
    shifts_px = windows.shifts_px - np.stack(
        [model.shifts_px(windows.points_px, size_px, band) for band in range(len(group))], axis=1
    )
    gains = []
    for band in range(len(group)):
        others = np.delete(np.arange(len(group)), band)
        parallax = parallax_of(shifts_px[:, others], model.baselines[others], windows.weights[:, others])
        remaining_px = shifts_px[:, band] - parallax[:, None] * model.baselines[band]
        gains.append(_gain_sigma(shifts_px[:, band], remaining_px))
    return float(np.median(gains)) >= _MIN_GAIN_SIGMA


def _common_residuals(group: Sequence[ReliefCandidate]) -> list[Residual[FixedImagePx]]:
    """Return the residuals of all bands in the same windows, in small ones if the residual of any band uses these."""
    centres_px = {tuple(c) for c in group[0].pair.reference.windows.centres_px.tolist()}
    if all(tuple(c) in centres_px for each in group for c in each.warped.residual.centres_px.tolist()):
        return [c.warped.residual for c in group]
    return [c.pair.reference.small_windows.residuals(c.warped.warped) for c in group]


def _far_share(residual: Residual[FixedImagePx]) -> float:
    """Return the share of the measured windows with a shift above _FAR_PX."""
    lengths = np.linalg.norm(residual.shifts_px, axis=1)
    measured = np.isfinite(lengths)
    return float((lengths[measured] > _FAR_PX).mean()) if measured.any() else 0.0


def _gain_sigma(before_px: NDArray[np.float64], after_px: NDArray[np.float64]) -> float:
    """Return `decrease_sigma` of the measured shifts (n, 2); 0 for too few windows."""
    before, after = (np.linalg.norm(s, axis=1) for s in (before_px, after_px))
    measured = np.isfinite(before) & np.isfinite(after)
    return decrease_sigma(before[measured], after[measured]) if measured.sum() >= _MIN_WINDOWS else 0.0


def _model(group: Sequence[ReliefCandidate], windows: WindowShifts) -> PlaneParallax | None:
    """Fit plane + parallax to the windows; None if a band has too few of them or the baselines are not of lenses."""
    if len(windows) == 0 or (windows.weights > 0).sum(axis=0).min() < _MIN_WINDOWS:
        return None
    layout = _layout(group)
    model = fit_plane_parallax(windows, group[0].pair.fixed.size_px, layout)
    return model if model is not None and are_of_lenses(model.baselines, layout) else None


def _layout(group: Sequence[ReliefCandidate]) -> NDArray[np.float64] | None:
    """Return the layouts (bands, 2) of the pairs; None if the tags lack one."""
    layouts = [c.pair.layout for c in group]
    return None if any(layout is None for layout in layouts) else np.array(layouts, float)


@dataclass(frozen=True)
class _Band:
    """One band with its current homography and baseline."""

    candidate: ReliefCandidate
    fixed_to_moving: Matrix
    baseline: tuple[float, float]
    field: DisplacementField | None = None
    """Residual lens distortion; None for the rig's field."""

    @property
    def plane(self) -> PixelMapping:
        """The mapping without parallax."""
        return self.candidate.pair.mapping(self.fixed_to_moving, self.field)

    def view(self) -> View:
        """Return the band as input of dense matching."""
        return View(channel_mean(self.candidate.pair.moving_image), self.plane, self.baseline)

    def parallax(self, relief: Relief) -> Parallax:
        """Return the parallax of the band with its occluded pixels."""
        return Parallax(relief, self.baseline, occluded(relief, self.baseline))

    def mapping(self, relief: Relief, *, with_occlusions: bool = False) -> PixelMapping:
        """Return the mapping with a relief; verification excludes occluded pixels, robust fits do not need to."""
        parallax = self.parallax(relief) if with_occlusions else Parallax(relief, self.baseline)
        return replace(self.plane, parallax=parallax)

    def corrected(self, corners_px: NDArray[np.float64], baseline_change: NDArray[np.float64]) -> "_Band":
        """Apply corrections of the corners (8,) and of the baseline (2,). Raises GeometryError."""
        size_px = self.candidate.pair.fixed.size_px
        matrix = geometry.compose(self.fixed_to_moving, geometry.moving_corners(corners_px, *size_px))
        x, y = np.add(self.baseline, baseline_change).tolist()
        return replace(self, fixed_to_moving=matrix, baseline=(x, y))


@dataclass(frozen=True)
class _Estimate:
    """The relief of a capture, from all bands and from all but one."""

    bands: Sequence[_Band]
    relief: Relief
    without: Mapping[str, Relief]
    """By band, the relief from the other bands."""

    @classmethod
    def of(cls, group: Sequence[ReliefCandidate]) -> "_Estimate | None":
        """Estimate the relief; None if the windows do not determine the baselines."""
        reference = group[0].pair.reference
        initial = [_Band(c, c.warped.mapping.fixed_to_moving, (0.0, 0.0)) for c in group]
        windows = WindowShifts.of([_fit_residual(b, b.plane) for b in initial], [b.plane for b in initial])
        model = _model(group, windows)
        if model is None:
            return None
        try:
            changes = zip(initial, model.corners_px, model.baselines, strict=True)
            bands = [b.corrected(corners_px, baseline) for b, corners_px, baseline in changes]
            low, high = np.percentile(model.parallax_px, _RANGE_PERCENTILES)
            all_bands = range(len(bands))
            for _ in range(_MAX_ROUNDS):
                matching = DenseMatching(reference.grey, [b.view() for b in bands], (float(low), float(high)))
                matched = matching.matched(all_bands)
                bands = [_with_lens_field(b, matched) for b in _refitted(bands, matched)]
                if all(b.field is None for b in bands):
                    break
        except GeometryError:
            return None
        if not are_of_lenses(np.array([b.baseline for b in bands]), _layout(group)):
            return None
        others = [[k for k in all_bands if k != band] for band in all_bands]
        relief, *without = matching.refined([b.view() for b in bands], [all_bands, *others])
        is_reversed = _layout(group) is None and nearer_sign(matched, np.array([b.baseline for b in bands])) < 0
        if is_reversed:
            bands = [replace(b, baseline=(-b.baseline[0], -b.baseline[1])) for b in bands]
            relief, without = relief.negated, [r.negated for r in without]
        names = [b.candidate.pair.name for b in bands]
        return cls(bands, relief, dict(zip(names, without, strict=True)))

    def checked(self, band: _Band) -> "_Checked":
        """Verify a band with the relief; it must pass all checks and be more accurate than its homography alone."""
        candidate = band.candidate
        pair, size_px = candidate.pair, candidate.pair.fixed.size_px
        rejected = _Checked(pair.name, FixedImagePx(math.inf), None)
        mapping = band.mapping(self.relief)
        fit = corner_correction(mapping, _fit_residual(band, mapping), size_px)
        if fit is None:
            return rejected
        try:
            final = band.corrected(fit.mean_px, np.zeros(2))
        except GeometryError:
            return rejected
        without_relief = _held_out_residual(pair, candidate.warped.mapping)
        held_out = _held_out_residual(pair, final.mapping(self.without[pair.name], with_occlusions=True))
        rejected = replace(rejected, p95_px=held_out.p95_px)
        if _is_worse(held_out, without_relief):
            return rejected
        joint = with_corners(candidate.joint, final.fixed_to_moving, fit.covariance_px2)
        parallax = final.parallax(self.relief)
        complete = replace(final.plane, parallax=parallax)
        if WarpedPair(pair, complete, pair.warped_moving(complete), held_out).issues(joint):
            return rejected
        alignment = Alignment(
            complete, size_px, "aligned", (), candidate.seed, joint, held_out,
            candidates={"homography": without_relief.p95_px, "relief": held_out.p95_px},
        )  # fmt: skip
        return _Checked(pair.name, held_out.p95_px, alignment)


@dataclass(frozen=True)
class _Checked:
    """A band after its verification with the relief from the other bands."""

    name: str
    p95_px: FixedImagePx
    """p95 of the shifts of held-out windows."""
    alignment: Alignment[FixedImagePx] | None
    """None if it does not pass."""


def _is_worse(residual: Residual[FixedImagePx], other: Residual[FixedImagePx]) -> bool:
    """Return True if the p95 of a residual is larger, or its median is larger by more than its p95 is smaller.

    If most windows are on the reference plane, the noise of the relief increases the median by some hundredths of a px.
    """
    gain_px = float(other.p95_px) - float(residual.p95_px)
    return not (gain_px >= 0 and float(residual.median_px) - float(other.median_px) <= gain_px)


def _refitted(bands: Sequence[_Band], relief: Relief) -> list[_Band]:
    """Fit plane + parallax again, to shifts measured with a relief, which are more accurate. Raises GeometryError.

    The parallax of the windows is a free parameter: noise of the relief would otherwise shorten the baselines.
    """
    mappings = [b.mapping(relief) for b in bands]
    windows = WindowShifts.of([_fit_residual(*each) for each in zip(bands, mappings, strict=True)], mappings)
    baselines = np.array([b.baseline for b in bands])
    total = windows.plus(relief(windows.centres_px), baselines)
    model = fit_plane_parallax(total, bands[0].candidate.pair.fixed.size_px, baselines)
    if model is None:
        return list(bands)
    return [b.corrected(c, t) for b, c, t in zip(bands, model.corners_px, model.baselines - baselines, strict=True)]


def _with_lens_field(band: _Band, relief: Relief) -> _Band:
    """Fit the residual lens distortion of a band, unless it is calibrated by tags or the rig."""
    pair = band.candidate.pair
    if pair.has_rig or pair.space == "undistorted":
        return band
    result = pair.reference.lens_field.refine(channel_mean(pair.moving_image), band.mapping(relief))
    return replace(band, field=result.field)


def _fit_residual(band: _Band, mapping: PixelMapping) -> Residual[FixedImagePx]:
    pair = band.candidate.pair
    return pair.reference.fit_windows.residuals(pair.warped_moving(mapping))


def _held_out_residual(pair: BandPair, mapping: PixelMapping) -> Residual[FixedImagePx]:
    return pair.reference.held_out_windows.residuals(pair.warped_moving(mapping))
