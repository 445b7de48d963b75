"""One relief for all bands of a capture: when it is tried, its estimation, and the verification of every band.

No pixel of a band that its displacement was fitted on takes part in its verification. The band's homography and
baseline are fitted in windows inside the black fields of a chessboard. The band is verified in larger windows inside
the white fields, under the relief that the OTHER bands show: where that predicts the band, the relief, the baseline and
the homography are right. What is written uses the relief of all bands, which is better still.
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
    fit_plane_parallax,
    parallax_of,
)
from agalign.values import geometry
from agalign.values.alignment import MIN_RETRIEVAL, Alignment, DisplacementField, JointResult, Residual, Seed
from agalign.values.choices import ReliefUse
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.relief import Parallax, Relief

_MIN_BANDS = 2
"""Moving lenses without which no relief is estimated: one has no other to verify it."""
_MIN_WINDOWS = 24
"""Measured windows, in each band, without which neither the test for parallax nor a fit is made."""
_MIN_PARALLAX_PX = 0.3
"""95th percentile of the parallax of windows below which a homography is enough: larger windows of flat fields show up
to 0.2 px, mostly noise."""
_MIN_GAIN_SIGMA = 4.0
"""Fall of the squared shifts of each band under the parallax of the others, in standard errors, from which a scene has
relief: chance stays below 3."""
_FAR_PX, _MAX_FAR_SHARE = 1.0, 0.05
"""More windows than this, farther off than a px, are reason enough to try a relief: windows across edges may show the
parallax of neither side, and no gain."""
_MAX_ROUNDS = 2
"""Where lenses leave something that no rig knows, the first relief contains a part of it, and is estimated again."""
_MAX_LEFT_OUT = 2
"""Bands that are left out of a relief, one after the other: each costs the time of an estimate."""
_RANGE_PERCENTILES = (1.0, 99.0)
"""Of the windows' parallax: beyond are wrong peaks."""


@dataclass(frozen=True)
class ReliefCandidate:
    """A band with a result of the joint optimisation, and the residual of its windows."""

    pair: BandPair
    seed: Seed
    joint: JointResult[FixedImagePx]
    warped: WarpedPair


def aligned_by_relief(candidates: Sequence[ReliefCandidate], use: ReliefUse) -> dict[str, Alignment[FixedImagePx]]:
    """The bands that are aligned by one relief of the capture, by name; none where none is needed or found."""
    if use == "never":
        return {}
    result: dict[str, Alignment[FixedImagePx]] = {}
    for group in _comparable(candidates):
        if len(group) >= _MIN_BANDS and (use == "always" or shows_relief(group)):
            result |= _aligned_together(group)
    return result


def _aligned_together(group: Sequence[ReliefCandidate]) -> dict[str, Alignment[FixedImagePx]]:
    """The bands of one group by their relief, which is estimated again without a band that it does not explain: its
    votes spoil the relief of the others.
    """
    result: dict[str, Alignment[FixedImagePx]] = {}
    for _ in range(_MAX_LEFT_OUT + 1):
        estimate = _Estimate.of(group)
        if estimate is None:
            break
        checked = [estimate.checked(band) for band in estimate.bands]
        together = {c.name: c.alignment for c in checked if c.alignment is not None}
        if len(together) < len(result):
            break
        result = together
        worst = max(checked, key=lambda c: (c.alignment is None, c.p95_px))
        group = [c for c in group if c.pair.name != worst.name]
        if worst.alignment is not None or len(group) < _MIN_BANDS:
            break
    return result


def _comparable(candidates: Sequence[ReliefCandidate]) -> list[list[ReliefCandidate]]:
    """Groups of bands with homographies between the same pixels of the same reference image.

    A band that shows something else is left out, so that it does not keep the others from a relief.
    """
    groups: dict[tuple[int, str], list[ReliefCandidate]] = {}
    for candidate in candidates:
        pair, residual = candidate.pair, candidate.warped.residual
        recognised = candidate.joint.retrieval >= MIN_RETRIEVAL and len(residual.measured_px) >= _MIN_WINDOWS
        if recognised and not pair.is_coarse:
            groups.setdefault((id(pair.reference), pair.space), []).append(candidate)
    return list(groups.values())


def shows_relief(group: Sequence[ReliefCandidate]) -> bool:
    """True where the windows under the homographies show parallax, and are far off, or agree on it band by band."""
    windows = WindowShifts.of(_common_residuals(group), [c.warped.mapping for c in group])
    model = _model(group, windows)
    if model is None or np.percentile(np.abs(model.parallax_px), 95) < _MIN_PARALLAX_PX:
        return False
    if max(_far_share(c.warped.residual) for c in group) > _MAX_FAR_SHARE:
        return True
    size_px = group[0].pair.fixed.size_px
    beyond = windows.shifts_px - np.stack(
        [model.shifts_px(windows.points_px, size_px, band) for band in range(len(group))], axis=1
    )
    gains = []
    for band in range(len(group)):
        others = np.delete(np.arange(len(group)), band)
        parallax = parallax_of(beyond[:, others], model.baselines[others], windows.weights[:, others])
        gains.append(_gain_sigma(beyond[:, band], beyond[:, band] - parallax[:, None] * model.baselines[band]))
    return float(np.median(gains)) >= _MIN_GAIN_SIGMA


def _common_residuals(group: Sequence[ReliefCandidate]) -> list[Residual[FixedImagePx]]:
    """The residuals in windows that all bands share: in small ones where some band was measured in those."""
    usual_px = {tuple(c) for c in group[0].pair.reference.windows.centres_px.tolist()}
    if all(tuple(c) in usual_px for each in group for c in each.warped.residual.centres_px.tolist()):
        return [c.warped.residual for c in group]
    return [c.pair.reference.small_windows.residuals(c.warped.warped) for c in group]


def _far_share(residual: Residual[FixedImagePx]) -> float:
    """Share of the measured windows with a shift of more than a px."""
    lengths = np.linalg.norm(residual.shifts_px, axis=1)
    measured = np.isfinite(lengths)
    return float((lengths[measured] > _FAR_PX).mean()) if measured.any() else 0.0


def _gain_sigma(before_px: NDArray[np.float64], after_px: NDArray[np.float64]) -> float:
    """Mean fall of squared shifts (n, 2) in standard errors; a length counts up to twice the 95th percentile."""
    before, after = (np.linalg.norm(s, axis=1) for s in (before_px, after_px))
    known = np.isfinite(before) & np.isfinite(after)
    if known.sum() < _MIN_WINDOWS:
        return 0.0
    limit = 2 * np.percentile(before[known], 95)
    fall = np.minimum(before[known], limit) ** 2 - np.minimum(after[known], limit) ** 2
    return float(fall.mean() / max(fall.std() / np.sqrt(len(fall)), 1e-12))


def _model(group: Sequence[ReliefCandidate], windows: WindowShifts) -> PlaneParallax | None:
    if len(windows) == 0 or (windows.weights > 0).sum(axis=0).min() < _MIN_WINDOWS:
        return None
    layouts = [c.pair.layout for c in group]
    known = all(layout is not None for layout in layouts)
    return fit_plane_parallax(windows, group[0].pair.fixed.size_px, np.array(layouts, float) if known else None)


@dataclass(frozen=True)
class _Band:
    """One band in the making."""

    candidate: ReliefCandidate
    fixed_to_moving: Matrix
    baseline: tuple[float, float]
    field: DisplacementField | None = None
    """What the lenses leave; None is the rig's."""

    @property
    def plane(self) -> PixelMapping:
        return self.candidate.pair.mapping(self.fixed_to_moving, self.field)

    def view(self) -> View:
        return View(channel_mean(self.candidate.pair.moving_image), self.plane, self.baseline)

    def parallax(self, relief: Relief) -> Parallax:
        """With the pixels that the relief occludes."""
        return Parallax(relief, self.baseline, occluded(relief, self.baseline))

    def under(self, relief: Relief, *, with_hidden: bool = False) -> PixelMapping:
        """Robust fits need no occlusions; verification leaves them out."""
        parallax = self.parallax(relief) if with_hidden else Parallax(relief, self.baseline)
        return replace(self.plane, parallax=parallax)

    def corrected(self, corners_px: NDArray[np.float64], baseline_change: NDArray[np.float64]) -> "_Band":
        """Raises GeometryError."""
        size_px = self.candidate.pair.fixed.size_px
        matrix = geometry.compose(self.fixed_to_moving, geometry.moving_corners(corners_px, *size_px))
        x, y = np.add(self.baseline, baseline_change).tolist()
        return replace(self, fixed_to_moving=matrix, baseline=(x, y))


@dataclass(frozen=True)
class _Estimate:
    """The relief of a capture and of each band's others."""

    bands: Sequence[_Band]
    relief: Relief
    without: Mapping[str, Relief]
    """By band: the relief that the others show."""

    @classmethod
    def of(cls, group: Sequence[ReliefCandidate]) -> "_Estimate | None":
        """None where the windows do not determine the baselines."""
        reference = group[0].pair.reference
        start = [_Band(c, c.warped.mapping.fixed_to_moving, (0.0, 0.0)) for c in group]
        windows = WindowShifts.of([_fit_residual(b, b.plane) for b in start], [b.plane for b in start])
        model = _model(group, windows)
        if model is None:
            return None
        try:
            bands = [b.corrected(*change) for b, *change in zip(start, model.corners_px, model.baselines, strict=True)]
            low, high = np.percentile(model.parallax_px, _RANGE_PERCENTILES)
            everything = range(len(bands))
            for _ in range(_MAX_ROUNDS):
                matching = DenseMatching(reference.grey, [b.view() for b in bands], (float(low), float(high)))
                matched = matching.matched(everything)
                bands = [_with_lens_field(b, matched) for b in _refitted(bands, matched)]
                if all(b.field is None for b in bands):
                    break
        except GeometryError:
            return None
        others = [[k for k in everything if k != band] for band in everything]
        relief, *without = matching.refined([b.view() for b in bands], [everything, *others])
        is_reversed = (
            any(c.pair.layout is None for c in group)
            and nearer_sign(matched, np.array([b.baseline for b in bands])) < 0
        )
        if is_reversed:
            bands = [replace(b, baseline=(-b.baseline[0], -b.baseline[1])) for b in bands]
            relief, without = relief.negated, [r.negated for r in without]
        names = [b.candidate.pair.name for b in bands]
        return cls(bands, relief, dict(zip(names, without, strict=True)))

    def checked(self, band: _Band) -> "_Checked":
        """The band under the relief, verified: right, and better than by its homography alone."""
        candidate = band.candidate
        pair, size_px = candidate.pair, candidate.pair.fixed.size_px
        rejected = _Checked(pair.name, FixedImagePx(math.inf), None)
        mapping = band.under(self.relief)
        fit = corner_correction(mapping, _fit_residual(band, mapping), size_px)
        if fit is None:
            return rejected
        try:
            final = band.corrected(fit.mean_px, np.zeros(2))
        except GeometryError:
            return rejected
        plane_px = _held_out_residual(pair, candidate.warped.mapping)
        held_out = _held_out_residual(pair, final.under(self.without[pair.name], with_hidden=True))
        rejected = replace(rejected, p95_px=held_out.p95_px)
        if _worse(held_out, plane_px):
            return rejected
        joint = with_corners(candidate.joint, final.fixed_to_moving, fit.covariance_px2)
        parallax = final.parallax(self.relief)
        complete = replace(final.plane, parallax=parallax)
        if WarpedPair(pair, complete, pair.warped_moving(complete), held_out).issues(joint):
            return rejected
        alignment = Alignment(
            final.fixed_to_moving, pair.space, "aligned", (), candidate.seed, joint, held_out, 0.0,
            field=final.field or pair.field, parallax=parallax,
        )  # fmt: skip
        return _Checked(pair.name, held_out.p95_px, alignment)


@dataclass(frozen=True)
class _Checked:
    """A band after its verification under the relief of the others."""

    name: str
    p95_px: FixedImagePx
    """Of the shifts of the windows held out."""
    alignment: Alignment[FixedImagePx] | None
    """None where it does not pass."""


def _worse(one: Residual[FixedImagePx], other: Residual[FixedImagePx]) -> bool:
    """True where the first one is worse at the 95th percentile, or loses more in the median than it gains there.

    Where most windows are on the reference plane, the noise of a relief costs some hundredths of a px in the median.
    """
    gain_px = float(other.p95_px) - float(one.p95_px)
    return not (gain_px >= 0 and float(one.median_px) - float(other.median_px) <= gain_px)


def _refitted(bands: Sequence[_Band], relief: Relief) -> list[_Band]:
    """The bands with plane + parallax fitted again, to windows that a relief makes sharper. Raises GeometryError.

    The parallax of each window stays free: a fit to the relief's own would shorten the baselines by its noise.
    """
    mappings = [b.under(relief) for b in bands]
    windows = WindowShifts.of([_fit_residual(*each) for each in zip(bands, mappings, strict=True)], mappings)
    baselines = np.array([b.baseline for b in bands])
    whole = windows.plus(relief(windows.centres_px), baselines)
    model = fit_plane_parallax(whole, bands[0].candidate.pair.fixed.size_px, baselines)
    if model is None:
        return list(bands)
    return [b.corrected(c, t) for b, c, t in zip(bands, model.corners_px, model.baselines - baselines, strict=True)]


def _with_lens_field(band: _Band, relief: Relief) -> _Band:
    """The band with a smooth field of what its lens leaves under a relief, unless tags or the rig calibrate it."""
    pair = band.candidate.pair
    if pair.is_known_to_a_rig or pair.space == "undistorted":
        return band
    result = pair.reference.lens_field.refine(channel_mean(pair.moving_image), band.under(relief))
    return replace(band, field=result.field)


def _fit_residual(band: _Band, mapping: PixelMapping) -> Residual[FixedImagePx]:
    pair = band.candidate.pair
    return pair.reference.fit_windows.residuals(pair.warped_moving(mapping))


def _held_out_residual(pair: BandPair, mapping: PixelMapping) -> Residual[FixedImagePx]:
    return pair.reference.held_out_windows.residuals(pair.warped_moving(mapping))
