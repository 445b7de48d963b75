"""Relief of a capture: a candidate for the geometry of all its bands, compared with displacement fields.

The relief of half of the lenses verifies the other half, in windows that took no part in the fit of planes and
baselines. A band that the relief of the others does not explain, as it was exposed at another time or is noisy, gets a
homography and a baseline of its own under that relief, and is predicted by them if they do not pass verification.
Either all bands of the capture use the relief, or none.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from statistics import median_high

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import Candidate
from agalign.capture.decision import decided, predicted_by_windows, without_result
from agalign.capture.warped_pair import WarpedPair
from agalign.errors import GeometryError
from agalign.fit.adjustment import (
    Adjustment,
    BaselinePrior,
    WindowFit,
    WindowShifts,
    adjust,
    are_of_lenses,
    are_on_a_line,
    fit_in_rounds,
    lens_std_px,
    parallax_of,
    shifts_by_corners,
)
from agalign.fit.dense import DenseMatching, View
from agalign.fit.displacement_field import MIN_GAIN_SIGMA, MIN_WINDOWS
from agalign.fit.occlusion import nearer_sign, occluded
from agalign.fit.windows import decrease_sigma
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import MIN_RETRIEVAL, Alignment, JointResult, Residual, Seed
from agalign.values.choices import Geometry, ReliefUse
from agalign.values.image import FloatImage
from agalign.values.issues import OTHER_GEOMETRY
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.checks import BY_PARALLAX, BY_WINDOWS, MAX_ALIAS_PEAK, MAX_SHIFT_PX, alias_peak

_MIN_BANDS = 2
"""Minimum number of moving lenses: a relief is verified with the other lenses."""
_MIN_PARALLAX_PX = 0.3
"""Minimum p95 of the parallax of windows for a relief; windows of flat fields have up to 0.2 px, mostly noise."""
_MIN_OBSERVED_SHARE = 0.75
"""Minimum share of aligned windows for an observation of a rig, which contains no depth edges: 0.79 or more in scenes
with booms and plants at 1 m."""
_MAX_FAR_SHARE = 0.05
"""A relief is also tried if more than this share of the windows has shifts above 1 px (`_far_share`): windows across
depth edges may contain the parallax of neither side, so that the squared shifts do not decrease."""


@dataclass
class ReliefResult:
    """The bands of a capture after the estimation of its relief."""

    alignments: dict[str, Alignment[FixedImagePx]] = field(default_factory=dict)
    """Bands aligned by the relief, by name."""
    others: set[str] = field(default_factory=set)
    """Bands of a capture with a relief that does not align them: their homographies are another geometry."""
    along_a_line: set[str] = field(default_factory=set)
    """Bands with common displacements that neither a relief nor displacement fields must follow."""


def aligned_by_relief(
    candidates: Sequence[Candidate],
    use: ReliefUse,
    *,
    without_result: Sequence[tuple[BandPair, Seed]] = (),
    is_observation: bool = False,
) -> ReliefResult:
    """Align bands by one relief of the capture, with lens shapes where no rig contains the distortion.

    Bands `without_result` of the joint optimisation, and those with another kind of lens model, follow the relief too.
    With `use` "auto" a relief is only estimated if the residuals of the homographies contain common parallax. For an
    observation of the rig, only the homographies matter, and the parallax of windows suffices.
    """
    result = ReliefResult()
    if use == "never":
        return result
    # Along one line, larger common displacements are those of shadows or leaves, not of lenses; a displacement field
    # would follow them too.
    max_line_px = 1.0
    for group in _comparable(candidates):
        if len(group) < _MIN_BANDS:
            continue
        parallax_px, on_a_line = _common_parallax_px(group)
        if on_a_line and parallax_px > max_line_px:
            result.along_a_line |= {c.pair.name for c in group}
        elif use == "always" or parallax_px >= _MIN_PARALLAX_PX:
            if is_observation:
                with suppress(GeometryError):
                    result.alignments |= _observed(group)
                if result.alignments.keys() & {c.pair.name for c in group}:
                    result.others |= {c.pair.name for c in group} - result.alignments.keys()
                continue
            estimate, aligned = _aligned_group(group)
            result.alignments |= aligned
            if estimate is not None:
                others = [*candidates, *(Candidate.at_seed(*one) for one in without_result)]
                result.alignments |= estimate.for_others(others)
                same = [c.pair for c in candidates if c.pair.reference is group[0].pair.reference]
                result.others |= {pair.name for pair in same if not pair.is_coarse} - result.alignments.keys()
    return result


def _comparable(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Group the bands by reference image and space of the homographies.

    Bands without retrieval of held-out patches, with few measured windows or low resolution are excluded.
    """
    groups: dict[tuple[int, str], list[Candidate]] = {}
    for candidate in candidates:
        pair, residual = candidate.pair, candidate.warped.residual
        is_reliable = candidate.joint.retrieval >= MIN_RETRIEVAL and len(residual.measured_px) >= MIN_WINDOWS
        if is_reliable and not pair.is_coarse:
            groups.setdefault((id(pair.reference), pair.space), []).append(candidate)
    return list(groups.values())


def _common_parallax_px(group: Sequence[Candidate]) -> tuple[float, bool]:
    """Return the p95 of the parallax that is common to the bands, 0 if it is not significant, and if the baselines are
    on one line without tags that confirm them.

    It is significant if either many shifts of a band are large, or the parallax from the other bands reduces the shifts
    of the median band significantly.
    """
    residuals, size_px = _common_residuals(group), group[0].pair.fixed.size_px
    if max(_p95_px(residual) for residual in residuals) < _MIN_PARALLAX_PX:
        return 0.0, False
    windows = WindowShifts.of(residuals, [c.warped.mapping for c in group])
    consistent = _consistent(windows, group)
    if consistent is None:
        return 0.0, False
    bands, model = consistent
    far_share = max(_far_share(residuals[band]) for band in bands)
    if far_share <= _MAX_FAR_SHARE and _gain_by_others_sigma(windows.of_bands(bands), model, size_px) < MIN_GAIN_SIGMA:
        return 0.0, False
    parallax_px = float(np.percentile(np.abs(model.parallax_px), 95))
    return parallax_px, _layout([group[band] for band in bands]) is None and are_on_a_line(model.baselines)


def _gain_by_others_sigma(windows: WindowShifts, model: Adjustment, size_px: tuple[int, int]) -> float:
    """Return the decrease of the squared shifts of the median band by the parallax from the others, in sigma."""
    shifts_px = windows.shifts_px - shifts_by_corners(model, windows.points_px, size_px)
    bands, gains = np.arange(shifts_px.shape[1]), []
    for band in bands:
        others = np.delete(bands, band)
        parallax = parallax_of(shifts_px[:, others], model.baselines[others], windows.weights[:, others])
        after_px = shifts_px[:, band] - parallax[:, None] * model.baselines[band]
        before, after = (np.linalg.norm(s, axis=1) for s in (shifts_px[:, band], after_px))
        measured = np.isfinite(before) & np.isfinite(after)
        enough = measured.sum() >= MIN_WINDOWS
        gains.append(decrease_sigma(before[measured], after[measured]) if enough else 0.0)
    return float(np.median(gains))


def _common_residuals(group: Sequence[Candidate]) -> list[Residual[FixedImagePx]]:
    """Return the residuals of all bands in the same windows: large ones if any band is blurred, or small ones if the
    residual of any band uses these.
    """
    reference = group[0].pair.reference
    if any(c.pair.is_blurred for c in group):
        return [reference.large_windows.residuals(c.warped.warped) for c in group]
    if all(c.warped.windows is reference.windows for c in group):
        return [c.warped.residual for c in group]
    return [reference.small_windows.residuals(c.warped.warped) for c in group]


def _p95_px(residual: Residual[FixedImagePx]) -> float:
    """Return the p95 of the lengths of the measured shifts, 0 without any: robust, as a wrong peak is no parallax."""
    return float(residual.p95_px) if len(residual.lengths_px) else 0.0


def _far_share(residual: Residual[FixedImagePx]) -> float:
    """Return the share of the measured windows with a shift above 1 px."""
    return float((residual.lengths_px > MAX_SHIFT_PX).mean()) if len(residual.lengths_px) else 0.0


def _layout(group: Sequence[Candidate]) -> NDArray[np.float64] | None:
    """Return the layouts (bands, 2) of bands; None if the tags lack one."""
    layouts = [candidate.pair.layout for candidate in group]
    return None if any(layout is None for layout in layouts) else np.array(layouts, float)


def _consistent(
    windows: WindowShifts, group: Sequence[Candidate], lens_std: NDArray[np.float64] | None = None
) -> tuple[list[int], Adjustment] | None:
    """Adjust the model to the bands with common parallax; return their indices and the model, or None.

    A band that the parallax of the others does not explain is left out, one after another.
    """
    size_px = group[0].pair.fixed.size_px
    # Residual of a band relative to that of the others: up to 1.4 for bands of the same time, 2.4 for a photograph of
    # another time. Residuals below the minimum are accepted anyway.
    max_scale_ratio, min_foreign_px = 2.0, 0.4

    def adjusted(bands: Sequence[int], lens_std: NDArray[np.float64] | None) -> Adjustment | None:
        layout, some = _layout([group[band] for band in bands]), windows.of_bands(bands)
        model = adjust(some, size_px, layout, lens_std) if some.are_enough(MIN_WINDOWS) else None
        return model if model is not None and are_of_lenses(model.baselines, layout) else None

    def median_scale_px(bands: Sequence[int]) -> float:
        model = adjusted(bands, None)
        return math.inf if model is None else float(np.median(model.scales_px))

    kept = list(range(windows.shifts_px.shape[1]))
    model = adjusted(kept, lens_std)
    while len(kept) > _MIN_BANDS:
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


@dataclass(frozen=True)
class _Band:
    """One band with the mapping of its reference plane and its baseline."""

    candidate: Candidate
    plane: PixelMapping
    baseline: tuple[float, float] = (0.0, 0.0)
    covariance_px2: NDArray[np.float64] | None = None
    """(8, 8) of the corners of the plane; None before it is fitted."""

    @property
    def name(self) -> str:
        """Name of the pair."""
        return self.candidate.pair.name

    def mapping(self, relief: Relief, *, with_occlusions: bool = False) -> PixelMapping:
        """Return the mapping with a relief; verification excludes occluded pixels, robust fits do not need to."""
        hidden = occluded(relief, self.baseline) if with_occlusions else None
        return self.plane.with_parallax(Parallax(relief, self.baseline, hidden))

    def fitted(self, fit: WindowFit) -> "_Band":
        """Apply a fit to windows. Raises GeometryError."""
        x, y = self.baseline if fit.baseline is None else fit.baseline.tolist()
        return replace(
            self, plane=fit.applied_to(self.plane), baseline=(x, y), covariance_px2=fit.covariance_px2[:8, :8]
        )

    def joint(self) -> JointResult[FixedImagePx]:
        """Return the result with the homography of the plane."""
        assert self.covariance_px2 is not None
        return self.candidate.joint.with_homography(self.plane.fixed_to_moving, self.covariance_px2)


def _observed(group: Sequence[Candidate]) -> dict[str, Alignment[FixedImagePx]]:
    """Align a group by the planes of its bands and the parallax of windows, without a relief of every pixel.

    The parallax of a held-out window is that by the other bands. Empty if no parallax or the homographies alone explain
    the windows better. Raises GeometryError.
    """
    bands, reference = [_Band(c, c.warped.mapping) for c in group], group[0].pair.reference
    rounds, model = 2, None  # large shifts are measured in steps
    for _ in range(rounds):
        consistent = _consistent(_window_shifts(bands), [b.candidate for b in bands])
        if consistent is None:
            return {}
        kept, model = consistent
        bands = [bands[k].fitted(fit) for k, fit in zip(kept, model.fits, strict=True)]
    assert model is not None
    if _layout([b.candidate for b in bands]) is None and are_on_a_line(model.baselines):
        return {}
    warped = [band.candidate.pair.warped_moving(band.plane) for band in bands]
    residuals = [reference.held_out_windows.residuals(image) for image in warped]
    windows, checked = WindowShifts.of(residuals, [band.plane for band in bands]), []
    if not windows.are_enough(MIN_WINDOWS):
        return {}
    relief = windows.relief(parallax_of(windows.shifts_px, model.baselines, windows.weights), reference.grey.size_px)
    for number, band in enumerate(bands):
        others = np.delete(np.arange(len(bands)), number)
        by_others_px = parallax_of(windows.shifts_px[:, others], model.baselines[others], windows.weights[:, others])
        shifts_px = windows.shifts_of(residuals[number], by_others_px[:, None] * model.baselines[number])
        held_out = residuals[number].with_shifts(residuals[number].shifts_px - shifts_px)
        candidate, plane = band.candidate, band.candidate.held_out_residual(band.candidate.warped.mapping)
        joint = band.joint()
        # Planes of different depth resemble a repetition in images without relief.
        mapping = band.mapping(relief)
        image = candidate.pair.warped_moving(mapping)
        verified = WarpedPair(candidate.pair, mapping, image, reference.held_out_windows, held_out)
        # A window across a depth edge contains the parallax of neither side.
        issues = [issue for issue in verified.issues(joint) if issue.kind not in BY_PARALLAX]
        aligned_share = float((held_out.lengths_px <= MAX_SHIFT_PX * candidate.pair.file_pixel_size_px).mean())
        without = without_result(candidate.pair, candidate.seed)
        alignment = decided(replace(without, mapping=mapping, joint=joint, residual=held_out))
        is_aligned = not issues and aligned_share >= _MIN_OBSERVED_SHARE
        checked.append(_Checked(band.name, plane, held_out, alignment if is_aligned else None))
    return {c.name: c.alignment for c in checked if c.alignment is not None} if _is_chosen(checked) else {}


def _aligned_group(group: Sequence[Candidate]) -> "tuple[_Estimate | None, dict[str, Alignment[FixedImagePx]]]":
    """Return the relief of a group and the bands that it aligns; (None, {}) if another geometry explains the capture
    better.
    """
    try:
        estimate = _Estimate.of(group)
        if estimate is None:
            return None, {}
        checked = [estimate.checked(band) for band in estimate.bands]
        if not _is_chosen(checked):
            return None, {}
    except GeometryError:
        return None, {}
    return estimate, {c.name: c.alignment for c in checked if c.alignment is not None}


@dataclass(frozen=True)
class _Estimate:
    """The relief of a capture, from all bands and from some of them."""

    bands: Sequence[_Band]
    relief: Relief
    others: Sequence[Relief]
    """From the bands of `_verifying`, which do not contain the bands that they verify."""

    @classmethod
    def of(cls, group: Sequence[Candidate]) -> "_Estimate | None":
        """Estimate the relief from bands with common parallax; None if the windows do not determine the baselines.

        Raises GeometryError.
        """
        planes, size_px = [_Band(c, c.warped.mapping) for c in group], group[0].pair.fixed.size_px
        lens_std = None if any(c.pair.has_rig for c in group) else _lens_std_px(group[0].pair)
        consistent = _consistent(_window_shifts(planes), group, lens_std)
        if consistent is None:
            return None
        kept, model = consistent
        layout = _layout([group[k] for k in kept])
        bands = [planes[k].fitted(fit) for k, fit in zip(kept, model.fits, strict=True)]
        low, high = np.percentile(model.parallax_px, (1.0, 99.0)).tolist()  # values beyond are wrong peaks
        matching = DenseMatching(group[0].pair.reference.grey, _views(bands), (low, high))
        matched = matching.matched(range(len(bands)))
        # The parallax of the windows is a free parameter: noise of the relief would otherwise shorten the baselines.
        baselines = np.array([b.baseline for b in bands])
        windows = _window_shifts(bands, matched, with_lens_shapes=lens_std is not None)
        again = adjust(windows, size_px, baselines, lens_std)
        if again is not None:
            bands = [band.fitted(fit) for band, fit in zip(bands, again.fits, strict=True)]
        baselines = np.array([b.baseline for b in bands])
        if not are_of_lenses(baselines, layout) or (layout is None and are_on_a_line(baselines)):
            return None
        selections = [range(len(bands)), *_verifying(range(len(bands)))]
        relief, *others = matching.refined(_views(bands), selections)
        result = cls(bands, replace(relief, std_px=_std_px(others)), others)
        return result.negated if layout is None and nearer_sign(matched, baselines) < 0 else result

    @property
    def baselines(self) -> NDArray[np.float64]:
        """(bands, 2) t_b."""
        return np.array([band.baseline for band in self.bands])

    @property
    def negated(self) -> "_Estimate":
        """The estimate with the opposite sign of reliefs and baselines, which has the same parallax."""
        bands = [replace(b, baseline=(-b.baseline[0], -b.baseline[1])) for b in self.bands]
        return replace(self, bands=bands, relief=self.relief.negated, others=[r.negated for r in self.others])

    def verifying(self, band: _Band) -> Relief:
        """Return the relief of other bands than this one."""
        return self.others[self.bands.index(band) % len(self.others)] if band in self.bands else self.relief

    def fitted(self, candidate: Candidate) -> _Band | None:
        """Fit homography and baseline of a band under the relief of the others; None if too few windows are measured.

        The layout of the lenses, scaled to the baselines of the others, is the prior of the baseline. Raises
        GeometryError.
        """
        prior, layout = BaselinePrior(), _layout([candidate, *(b.candidate for b in self.bands)])
        if layout is not None:
            own, others = layout[0], layout[1:]
            layout_std = 0.3  # of lens positions without tags, which deviate by up to 0.1 of the longest baseline
            x, y = own * float((others * self.baselines).sum() / max((others**2).sum(), 1e-12))
            prior = BaselinePrior((x, y), layout_std)
        band = _Band(candidate, candidate.warped.mapping, prior.mean)

        def measured(mapping: PixelMapping) -> Residual[FixedImagePx]:
            return candidate.fit_residual(mapping)

        start, size_px = band.mapping(self.relief), candidate.pair.fixed.size_px
        if len(measured(start).measured_px) < MIN_WINDOWS:
            return None
        fitted = fit_in_rounds(start, measured, size_px, lens_std_px=_lens_std_px(candidate.pair), baseline=prior)
        if fitted is None or fitted[0].parallax is None:
            return None
        baseline, covariance_px2 = fitted[0].parallax.baseline, fitted[1].covariance_px2[:8, :8]
        return _Band(candidate, fitted[0].of_the_plane, baseline, covariance_px2)

    def for_others(self, candidates: Sequence[Candidate]) -> dict[str, Alignment[FixedImagePx]]:
        """Align or predict bands of the same reference where windows allow it, except those of the estimate: a relief
        does not verify a band that it is estimated from.
        """
        names, reference = {band.name for band in self.bands}, self.bands[0].candidate.pair.reference
        result: dict[str, Alignment[FixedImagePx]] = {}
        for candidate in candidates:
            pair = candidate.pair
            if pair.name in names or pair.is_coarse or pair.reference is not reference:
                continue
            with suppress(GeometryError):
                band = self.fitted(candidate)
                alignment = None if band is None else self.checked(band).alignment or self.predicted(band)
                result |= {} if alignment is None else {pair.name: alignment}
        return result

    def predicted(self, band: _Band) -> Alignment[FixedImagePx] | None:
        """Predict a band that does not pass verification; None if half of the held-out windows are not aligned, or if
        the scene repeats.
        """
        candidate, pair = band.candidate, band.candidate.pair
        mapping = band.mapping(self.relief, with_occlusions=True)
        warped = WarpedPair.of(pair, mapping, pair.reference.held_out_windows)
        residual = warped.residual
        is_known = len(residual.measured_px) >= MIN_WINDOWS
        is_known &= residual.median_px <= MAX_SHIFT_PX * pair.file_pixel_size_px
        if not is_known or alias_peak(*warped.reduced_spectra()).ratio > MAX_ALIAS_PEAK:
            return None
        joint = None if candidate.joint.recipe == BY_WINDOWS else candidate.joint
        without = without_result(pair, candidate.seed)
        by_relief = replace(without, mapping=mapping, joint=joint, residual=residual)
        return predicted_by_windows(by_relief, pair, OTHER_GEOMETRY)

    def checked(self, band: _Band) -> "_Checked":
        """Verify a band with the relief from other bands. Raises GeometryError."""
        candidate, pair = band.candidate, band.candidate.pair
        plane = candidate.held_out_residual(candidate.warped.mapping)
        complete = band.mapping(self.relief, with_occlusions=True)
        verifying = band.mapping(self.verifying(band), with_occlusions=True)
        held_out = candidate.held_out_residual(verifying)
        joint = band.joint()
        warped, windows = pair.warped_moving(complete), pair.reference.held_out_windows
        if WarpedPair(pair, complete, warped, windows, held_out).issues(joint):
            return _Checked(pair.name, plane, held_out)
        kind: Geometry = "relief" if complete.field is None else "relief and field"
        candidates = {"homography": plane.p95_px, kind: held_out.p95_px}
        without = without_result(pair, candidate.seed)
        aligned = replace(without, mapping=complete, joint=joint, residual=held_out, candidates=candidates)
        return _Checked(pair.name, plane, held_out, decided(aligned))


@dataclass(frozen=True)
class _Checked:
    """A band after its verification with the relief from other bands."""

    name: str
    plane: Residual[FixedImagePx]
    """Residual of held-out windows by the homography alone."""
    held_out: Residual[FixedImagePx]
    """The same with the relief."""
    alignment: Alignment[FixedImagePx] | None = None
    """None if it does not pass."""


def _lens_std_px(pair: BandPair) -> NDArray[np.float64] | None:
    """Return the standard deviations (4,) of the lens shapes of a pair; None if the rig contains its distortion."""
    return None if pair.has_rig else lens_std_px(pair.fixed.size_px, calibrated=pair.space == "undistorted")


def _verifying(bands: Sequence[int]) -> list[list[int]]:
    """Return lists of bands: the relief of list i verifies the bands i, i + n and so on, for n lists.

    With few bands all others, else the bands with odd and those with even index: two reliefs instead of one for
    each band.
    """
    max_left_out_bands = 4  # one at a time: the relief of one or two bands is too noisy
    if len(bands) <= max_left_out_bands:
        return [[b for b in bands if b != band] for band in bands]
    return [[b for b in bands if b % 2 != parity] for parity in (0, 1)]


def _std_px(reliefs: Sequence[Relief]) -> FloatImage:
    """Return the standard error (height, width) of a relief from those of n selections of its bands.

    It is the delete-a-group jackknife, sqrt((n - 1) / n sum |z_i - mean|^2), as RMS over the surroundings: reliefs from
    different bands differ at depth edges and in areas without texture.
    """
    surroundings_px = 17  # the distance of the nodes of an error map
    values = np.stack([relief.parallax_px for relief in reliefs])
    square = (len(values) - 1) * np.square(values - values.mean(axis=0)).mean(axis=0)
    return np.asarray(np.sqrt(cv2.blur(square, (surroundings_px, surroundings_px))))


def _is_chosen(checked: Sequence[_Checked]) -> bool:
    """Return True if the relief explains the held-out windows of half of the bands better than the homographies.

    If most windows are on the reference plane, the noise of the relief increases the median by some hundredths of a px.
    """
    gains_px = []
    for each in checked:
        if each.alignment is None:
            gains_px.append(-math.inf)
            continue
        gain_px = float(each.plane.p95_px) - float(each.held_out.p95_px)
        gains_px.append(gain_px - max(0.0, float(each.held_out.median_px) - float(each.plane.median_px)))
    return median_high(gains_px) >= 0


def _window_shifts(
    bands: Sequence[_Band], relief: Relief | None = None, *, with_lens_shapes: bool = False
) -> WindowShifts:
    """Measure the windows of the fit with the planes of the bands, or with a relief."""
    mappings = [b.plane if relief is None else b.mapping(relief) for b in bands]
    residuals = [b.candidate.fit_residual(m) for b, m in zip(bands, mappings, strict=True)]
    return WindowShifts.of(residuals, mappings, with_lens_shapes=with_lens_shapes)


def _views(bands: Sequence[_Band]) -> list[View]:
    """Return the bands as input of dense matching."""
    return [View(channel_mean(b.candidate.pair.moving_image), b.plane, b.baseline) for b in bands]
