"""Candidates under the relief of a capture, a geometry of all its bands that is compared with their homographies.

It is estimated if the residuals of the homographies have parallax in common. A relief that was estimated without a
band verifies the band, in windows that took no part in the fit of planes and baselines: with few bands the relief of
all others, else that of half of the bands. A band that the relief of the others does not explain, as it was exposed at
another time or is noisy, gets a homography and a baseline of its own under that relief. If a relief is used, a band
with the same reference image that does not follow it is `predicted`; bands of much lower resolution have another one.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import cycle

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.capture.candidate import Candidate, RefinedBand, mapping_error
from agalign.capture.common_parallax import (
    MIN_BANDS,
    MIN_PARALLAX_PX,
    common_parallax_px,
    consistent_bands,
    layout_of,
    parallax_groups,
)
from agalign.capture.warped_pair import WarpedPair
from agalign.errors import GeometryError
from agalign.fit.adjustment import WindowShifts, adjust, are_of_lenses, are_on_a_line, parallax_of
from agalign.fit.dense import DenseMatching, View, nearer_sign
from agalign.fit.displacement_field import MIN_WINDOWS
from agalign.fit.window_fit import BaselinePrior, WindowFit, fit_in_rounds
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import BY_WINDOWS, JointResult
from agalign.values.choices import Geometry, ReliefUse
from agalign.values.image import FloatImage
from agalign.values.issues import PREDICTED_WITH
from agalign.values.lens_shapes import CORNERS
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import RELIEF_STEP, Parallax, Relief
from agalign.values.residual import Residual, decrease_in_standard_errors, lengths_in_common_px
from agalign.verify.checks import MAX_SHIFT_PX

_MIN_OBSERVED_SHARE = 0.75
"""Minimum share of aligned windows for an observation of a rig, which contains no depth edges: 0.79 or more in scenes
with booms and plants at 1 m."""

UnderRelief = Mapping[str, Candidate]
"""The candidates of the bands with one reference image under one relief, by band."""


def by_relief(
    bands: Sequence[RefinedBand], use: ReliefUse, *, is_observation: bool = False
) -> tuple[list[UnderRelief], set[str]]:
    """Return the candidates under the reliefs that fit half of the bands better than their homographies, by held-out
    windows, with lens shapes where no rig contains the distortion.

    Bands with different kinds of lens models determine a relief each. Also return the names of bands with common
    displacements along a line, which neither a relief nor displacement fields must follow.
    Bands without a result, and those with another kind of lens model, follow the relief too.
    With `use` "auto" a relief is only estimated if the residuals of the homographies contain common parallax. For an
    observation of the rig, only the homographies matter, and the parallax of windows suffices.
    """
    reliefs: list[UnderRelief] = []
    along_a_line: set[str] = set()
    if use == "never":
        return reliefs, along_a_line
    # Along one line, larger common displacements are those of shadows or leaves, not of lenses; a displacement field
    # would follow them too.
    max_line_px = 1.0
    with_relief: list[list[RefinedBand]] = []
    for group in parallax_groups(bands):
        if len(group) < MIN_BANDS:
            continue
        parallax_px, on_a_line = common_parallax_px(group)
        if on_a_line and parallax_px > max_line_px:
            along_a_line |= {band.pair.name for band in group}
        elif use == "always" or parallax_px >= MIN_PARALLAX_PX:
            with_relief.append(group)
    others = [band for band in bands if band.pair.name not in along_a_line]
    for group in with_relief:
        with suppress(GeometryError):
            under = _observed(group) if is_observation else _of_group(group, others)
            reliefs += [under] if under else []
    return reliefs, along_a_line


@dataclass(frozen=True)
class _Band:
    """One band with the mapping of its reference plane and its baseline."""

    refined: RefinedBand
    plane: PixelMapping
    baseline: tuple[float, float] = (0.0, 0.0)
    covariance_px2: NDArray[np.float64] | None = None
    """(8, 8) of the corners of the plane, or (12, 12) with the lens shapes; None before it is fitted."""
    baseline_std: float = 0.0
    """Standard error of the fitted baseline, px per px of parallax."""

    @property
    def name(self) -> str:
        """Name of the pair."""
        return self.refined.pair.name

    def mapping(self, relief: Relief, *, with_occlusions: bool = False) -> PixelMapping:
        """Return the mapping with a relief; verification excludes occluded pixels, robust fits do not need to."""
        parallax = Parallax(relief, self.baseline)
        return self.plane.with_parallax(parallax.with_occlusions() if with_occlusions else parallax)

    def fitted(self, fit: WindowFit) -> "_Band":
        """Apply a fit to windows. Raises GeometryError."""
        assert fit.baseline is not None
        x, y = fit.baseline.tolist()
        plane = fit.applied_to(self.plane)
        return _Band(self.refined, plane, (x, y), fit.covariance_px2, fit.baseline_std)

    @property
    def joint(self) -> JointResult:
        """The result with the homography of the plane, which is fitted to windows and verified with others."""
        assert self.covariance_px2 is not None
        joint = replace(self.refined.joint, recipe=BY_WINDOWS)
        return joint.with_homography(self.plane.fixed_to_moving, self.covariance_px2[:CORNERS, :CORNERS])

    @cached_property
    def by_homography(self) -> Residual:
        """The residual of the held-out windows under the homography of the descriptors; that of the MAP estimate is
        fitted to windows that share pixels with them.
        """
        return self.refined.pair.reference.relief_check_windows.residuals(self.refined.warped.warped)

    def held_out(self, relief: Relief) -> WarpedPair:
        """Measure the windows that take no part in the fit, with a relief of other bands."""
        pair = self.refined.pair
        return WarpedPair.of(pair, self.mapping(relief, with_occlusions=True), pair.reference.relief_check_windows)

    def candidate(self, mapping: PixelMapping, held_out: WarpedPair) -> Candidate:
        """Return the candidate by a mapping with a relief; its windows are held out, under a relief of other bands."""
        kind: Geometry = "relief" if mapping.field is None else "relief and field"
        p95_px: dict[Geometry, float] = {"homography": self.by_homography.p95_px, kind: held_out.residual.p95_px}
        pair, residual = self.refined.pair, held_out.residual
        assert self.covariance_px2 is not None
        error = mapping_error(pair, mapping, self.covariance_px2, residual, self.plane.field, self.baseline_std)
        return Candidate(pair, mapping, error, residual, self.joint, held_out, held_out_p95_px=p95_px)


def _observed(group: Sequence[RefinedBand]) -> UnderRelief:
    """Align a group by the planes of its bands and the parallax of windows, without a relief of every pixel.

    The parallax of a held-out window is that by the other bands. Empty without parallax, or if homographies fit as
    well. Raises GeometryError.
    """
    bands, reference = [_Band(b, b.warped.mapping) for b in group], group[0].pair.reference
    rounds, model = 2, None  # large shifts are measured in steps
    for _ in range(rounds):
        consistent = consistent_bands(_window_shifts(bands), [b.refined for b in bands])
        if consistent is None:
            return {}
        kept, model = consistent
        bands = [bands[k].fitted(fit) for k, fit in zip(kept, model.fits, strict=True)]
    assert model is not None
    if layout_of([b.refined.pair for b in bands]) is None and are_on_a_line(model.baselines):
        return {}
    warped = [band.refined.pair.warped_moving(band.plane) for band in bands]
    residuals = [reference.relief_check_windows.residuals(image) for image in warped]
    windows, result = WindowShifts.of(residuals, [band.plane for band in bands]), dict[str, Candidate]()
    if not windows.are_enough(MIN_WINDOWS):
        return {}
    relief = windows.relief(parallax_of(windows.shifts_px, model.baselines, windows.weights), reference.grey.size_px)
    for number, band in enumerate(bands):
        others = np.delete(np.arange(len(bands)), number)
        by_others_px = parallax_of(windows.shifts_px[:, others], model.baselines[others], windows.weights[:, others])
        shifts_px = windows.shifts_of(residuals[number], by_others_px[:, None] * model.baselines[number])
        held_out = residuals[number].with_shifts(residuals[number].shifts_px - shifts_px)
        pair, mapping = band.refined.pair, band.mapping(relief)
        # Planes of different depth resemble a repetition in images without relief.
        verified = WarpedPair(pair, mapping, pair.warped_moving(mapping), reference.relief_check_windows, held_out)
        candidate = band.candidate(mapping, verified)
        # A window across a depth edge contains the parallax of neither side, and may contain other plants.
        issues = [issue for issue in (*candidate.issues, *verified.issues) if issue.kind not in PREDICTED_WITH]
        aligned_share = float((held_out.lengths_px <= MAX_SHIFT_PX * pair.file_pixel_size_px).mean())
        if not issues and aligned_share >= _MIN_OBSERVED_SHARE:
            result[band.name] = replace(candidate, given_issues=())
    return result if _is_relief_accepted(bands, result) else {}


def _of_group(group: Sequence[RefinedBand], others: Sequence[RefinedBand]) -> UnderRelief:
    """Return the candidates of a group under its relief, and those of the other bands.

    Empty without a relief, or if homographies fit as well. Raises GeometryError.
    """
    estimate = _Estimate.of(group)
    if estimate is None:
        return {}
    held_out = [
        band.held_out(verifying)
        for band, verifying in zip(estimate.bands, cycle(estimate.verifying_reliefs), strict=False)
    ]
    estimate = estimate.with_std_px(held_out)
    result = estimate.accepted_candidates(zip(estimate.bands, held_out, strict=True))
    if not _is_relief_accepted(estimate.bands, result):
        return {}
    result |= estimate.of_other_bands(others)
    if any(band.pair.is_lens_known for band in group):
        return result
    return {name: _with_field_on_relief(candidate) for name, candidate in result.items()}


@dataclass(frozen=True)
class _Estimate:
    """The relief of a capture, from all bands and from some of them."""

    bands: Sequence[_Band]
    relief: Relief
    verifying_reliefs: Sequence[Relief]
    """From the bands of `_verifying`: relief i of n verifies the bands i, i + n and so on."""

    @classmethod
    def of(cls, group: Sequence[RefinedBand]) -> "_Estimate | None":
        """Estimate the relief from bands with common parallax; None if their windows determine no baselines of lenses.

        Raises GeometryError.
        """
        planes, size_px = [_Band(b, b.warped.mapping) for b in group], group[0].pair.fixed.size_px
        lens_std = None if any(b.pair.is_lens_known for b in group) else group[0].pair.unknown_lens_std_px
        consistent = consistent_bands(_window_shifts(planes), group, lens_std)
        if consistent is None:
            return None
        kept, model = consistent
        layout = layout_of([group[k].pair for k in kept])
        bands = [planes[k].fitted(fit) for k, fit in zip(kept, model.fits, strict=True)]
        max_rounds = 3
        for _ in range(max_rounds):
            low, high = np.percentile(model.parallax_px, (1.0, 99.0)).tolist()  # values beyond are wrong peaks
            grey, is_known = group[0].pair.reference.grey, layout is not None
            matching = DenseMatching(grey, _views(bands), (low, high), is_sign_known=is_known)
            matched = matching.matched(range(len(bands)))
            # The parallax of the windows is free: noise of the relief would otherwise shorten the baselines.
            windows = _window_shifts(bands, matched, with_lens_shapes=lens_std is not None)
            again = adjust(windows, size_px, _baselines(bands), lens_std)
            if again is None:
                break
            model, bands = again, [band.fitted(fit) for band, fit in zip(bands, again.fits, strict=True)]
            # A relief is relative to the planes: the refinement does not follow them farther.
            if max(fit.max_px for fit in model.fits) <= matching.refined_px:
                break
        baselines = _baselines(bands)
        if not are_of_lenses(baselines, layout) or (layout is None and are_on_a_line(baselines)):
            return None
        selections = [range(len(bands)), *_verifying(range(len(bands)))]
        relief, *verifying_reliefs = matching.refined(_views(bands), selections)
        result = cls(bands, relief, verifying_reliefs)
        return result.negated if layout is None and nearer_sign(matched, baselines) < 0 else result

    @property
    def negated(self) -> "_Estimate":
        """The estimate with the opposite sign of reliefs and baselines, which has the same parallax."""
        bands = [replace(b, baseline=(-b.baseline[0], -b.baseline[1])) for b in self.bands]
        return replace(
            self, bands=bands, relief=self.relief.negated, verifying_reliefs=[r.negated for r in self.verifying_reliefs]
        )

    def with_std_px(self, held_out: Sequence[WarpedPair]) -> "_Estimate":
        """Return the estimate with the standard error of its relief, given the held-out windows of its bands.

        Where the bands disagree by more than the windows do, the difference of the reliefs says little: nine of ten
        windows where it is above 2 px have shifts below 4 px, and two of three below 1 px (a bench with plants, boxes
        and a boom). The p95 of the windows, by the baselines, is the largest standard error.
        """
        lengths = np.linalg.norm(_baselines(self.bands), axis=1)
        p95_px = [warped.residual.p95_px for warped in held_out]
        max_std_px = max(RELIEF_STEP, float(np.median(p95_px / np.maximum(lengths, 1e-6))))
        return replace(self, relief=replace(self.relief, std_px=_std_px(self.verifying_reliefs, max_std_px)))

    def band_under_relief(self, band: RefinedBand) -> _Band | None:
        """Fit homography and baseline of a band under the relief of the others; None if its windows determine none.

        The layout of the lenses, scaled to the baselines of the others, is the prior of the baseline. Raises
        GeometryError.
        """
        prior, layout = BaselinePrior(), layout_of([band.pair, *(b.refined.pair for b in self.bands)])
        if layout is not None:
            own, others, baselines = layout[0], layout[1:], _baselines(self.bands)
            layout_std = 0.3  # of lens positions without tags, which deviate by up to 0.1 of the longest baseline
            x, y = own * float((others * baselines).sum() / max((others**2).sum(), 1e-12))
            prior = BaselinePrior((x, y), layout_std)
        start = _Band(band, band.warped.mapping, prior.mean).mapping(self.relief)
        fit_residual = partial(_fit_residual, band)
        if len(fit_residual(start).measured_px) < MIN_WINDOWS:
            return None
        size_px, lens_std = band.pair.fixed.size_px, band.pair.unknown_lens_std_px
        fitted = fit_in_rounds(start, fit_residual, size_px, lens_std_px=lens_std, baseline=prior)
        if fitted is None or fitted[0].parallax is None:
            return None
        plane, fit = fitted[0].without_parallax, fitted[1]
        return _Band(band, plane, fitted[0].parallax.baseline, fit.covariance_px2, fit.baseline_std)

    def of_other_bands(self, others: Sequence[RefinedBand]) -> dict[str, Candidate]:
        """Return the candidates of bands of the same reference where windows allow it, except those of the estimate: a
        relief does not verify a band that it is estimated from.
        """
        names, reference = {band.name for band in self.bands}, self.bands[0].refined.pair.reference
        under: list[tuple[_Band, WarpedPair]] = []
        for other in others:
            pair = other.pair
            if pair.name in names or pair.is_coarse or pair.reference is not reference:
                continue
            with suppress(GeometryError):
                band = self.band_under_relief(other)
                under += [] if band is None else [(band, band.held_out(self.relief))]
        return self.accepted_candidates(under)

    def accepted_candidates(self, bands: Iterable[tuple[_Band, WarpedPair]]) -> dict[str, Candidate]:
        """Return the candidates of bands by the relief of all bands, given the held-out windows of each.

        One with issues is left out if it may not predict, its windows are few, or half of them are not aligned.
        """
        result: dict[str, Candidate] = {}
        for band, held_out in bands:
            candidate = band.candidate(band.mapping(self.relief, with_occlusions=True), held_out)
            residual = candidate.residual
            is_known = len(residual.measured_px) >= MIN_WINDOWS
            is_known &= residual.median_px <= MAX_SHIFT_PX * candidate.pair.file_pixel_size_px
            if not candidate.issues or (is_known and candidate.may_predict):
                result[band.name] = candidate
        return result


def _with_field_on_relief(candidate: Candidate) -> Candidate:
    """Add the displacement field that its relief and lens shapes leave, if held-out windows confirm it: those of the
    field have to pass the checks too, unless the candidate does not pass without it.
    """
    pair, mapping = candidate.pair, candidate.mapping
    displacement = pair.reference.displacement_field.refine(channel_mean(pair.moving_image), mapping)
    if displacement is None or displacement.field is None:
        return candidate
    with_field = replace(mapping, field=displacement.field)
    covariance_px2, baseline_std = candidate.error.covariance_px2, candidate.error.baseline_std
    assert covariance_px2 is not None
    error = mapping_error(pair, with_field, covariance_px2, candidate.residual, mapping.field, baseline_std)
    p95_px = {**candidate.held_out_p95_px, "relief and field": displacement.held_out.p95_px}
    of_field = displacement.held_out
    result = replace(candidate, mapping=with_field, error=error, other_residual=of_field, held_out_p95_px=p95_px)
    return candidate if result.issues and not candidate.issues else result


def _is_relief_accepted(bands: Sequence[_Band], result: Mapping[str, Candidate]) -> bool:
    """Return True if held-out windows of half of the bands fit a relief better than a homography.

    A band that it predicts counts only if a homography cannot align it: fields follow small parallax better.
    """

    def is_better(band: _Band) -> bool:
        candidate, plane = result.get(band.name), band.by_homography
        if candidate is None or (candidate.issues and plane.p95_px <= MAX_SHIFT_PX * candidate.pair.file_pixel_size_px):
            return False
        return _decreases_shifts(plane, candidate.residual)

    return 2 * sum(map(is_better, bands)) >= len(bands)


def _decreases_shifts(plane: Residual, relief: Residual) -> bool:
    """Return True if a relief decreases the p95 of held-out windows by more than it increases their median, and their
    shifts by more than by chance, in the windows that both have measured.

    If most windows are on the reference plane, the noise of the relief increases the median by some hundredths of a px.
    """
    # Standard errors: at most 3.0 in flat scenes with noise, at least 5.4 with boxes, booms, trees and leaves. The p95
    # alone is that of wrong peaks where images are noisy.
    min_decrease = 4.0
    before_px, after_px = lengths_in_common_px(plane, relief)
    if not len(before_px):
        return False
    median_increase_px, p95_increase_px = np.percentile(after_px, (50, 95)) - np.percentile(before_px, (50, 95))
    is_smaller = bool(-p95_increase_px >= max(0.0, median_increase_px))
    return is_smaller and decrease_in_standard_errors(plane, relief) >= min_decrease


def _verifying(bands: Sequence[int]) -> list[list[int]]:
    """Return lists of bands: the relief of list i verifies the bands i, i + n and so on, for n lists.

    With few bands all others, else the bands with odd and those with even index: two reliefs instead of one for
    each band.
    """
    max_left_out_bands = 4  # one at a time: the relief of one or two bands is too noisy
    if len(bands) <= max_left_out_bands:
        return [[b for b in bands if b != band] for band in bands]
    return [[b for b in bands if b % 2 != parity] for parity in (0, 1)]


def _std_px(reliefs: Sequence[Relief], max_std_px: float) -> FloatImage:
    """Return the standard error (height, width) of a relief from those of n selections of its bands.

    It is the delete-a-group jackknife, sqrt((n - 1) / n sum |z_i - mean|^2), as the median over the surroundings:
    reliefs from different bands differ at depth edges and in areas without texture, by values that single pixels do not
    have in common. It approaches `max_std_px`, as the harmonic sum of both variances.

    The squares have a chi-squared distribution with n - 1 degrees of freedom: their median is smaller than their mean,
    the more so the fewer reliefs there are. The result is scaled to the median that four reliefs have: with it, 0.71 of
    the windows of a bench with plants and a boom, and 0.77 of those of bananas, are within the expected error, and 0.95
    within twice it.
    """
    surroundings_px = 17  # about the distance of the nodes of an error map (NODES_PX), and odd
    values = np.stack([relief.parallax_px for relief in reliefs])
    freedom, of_four = len(values) - 1, 3
    median_of_mean = [(1 - 2 / (9 * k)) ** 3 for k in (of_four, freedom)]  # Wilson and Hilferty (1931)
    variance_px2 = median_of_mean[0] / median_of_mean[1] * np.square(values - values.mean(axis=0)).mean(axis=0)
    std_px = np.sqrt(freedom * variance_px2)
    # The median of bytes is fast; a byte is a step of 3.5 %, and the median does not depend on the scale.
    least_px, steps_per_octave = RELIEF_STEP, 20
    octaves = np.log2(np.maximum(std_px, least_px) / least_px)
    median = cv2.medianBlur(np.clip(octaves * steps_per_octave, 0, 255).astype(np.uint8), surroundings_px)
    median_px = least_px * np.exp2(median.astype(np.float32) / steps_per_octave)
    return np.asarray(median_px / np.sqrt(1 + np.square(median_px / max_std_px)), np.float32)


def _fit_residual(band: RefinedBand, mapping: PixelMapping) -> Residual:
    """Measure the windows of the fit with a mapping."""
    return band.pair.reference.relief_fit_windows.residuals(band.warped_moving(mapping))


def _window_shifts(
    bands: Sequence[_Band], relief: Relief | None = None, *, with_lens_shapes: bool = False
) -> WindowShifts:
    """Measure the windows of the fit with the planes of the bands, or with a relief."""
    mappings = [b.plane if relief is None else b.mapping(relief) for b in bands]
    residuals = [_fit_residual(b.refined, m) for b, m in zip(bands, mappings, strict=True)]
    return WindowShifts.of(residuals, mappings, with_lens_shapes=with_lens_shapes)


def _baselines(bands: Sequence[_Band]) -> NDArray[np.float64]:
    """Return (bands, 2) t_b."""
    return np.array([band.baseline for band in bands])


def _views(bands: Sequence[_Band]) -> list[View]:
    """Return the bands as input of dense matching."""
    return [View(channel_mean(b.refined.pair.moving_image), b.plane, b.baseline) for b in bands]
