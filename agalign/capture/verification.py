"""Verification of a pair on the warped images: status and issues of its alignment."""

from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.pixels.band_resampling import channel_mean, shrink
from agalign.pixels.structure import Field, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Prediction, Residual, Seed
from agalign.values.choices import Geometry, ReliefUse, SeedKind
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue, IssueKind
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx, PixelScale
from agalign.verify.checks import CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX, Evidence, is_unchanged, issues_of, status_of
from agalign.verify.displacement_field import DisplacementResult
from agalign.verify.extrapolation import points_in_frame, unobserved_quarters
from agalign.verify.residuals import FixedWindows, residual_under

_PARALLAX_ISSUES = frozenset({CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX})
"""Issues caused by parallax, which a displacement field may remove."""


def without_result(pair: BandPair, seed: Seed, issue: Issue) -> Alignment[FixedImagePx]:
    """Return a failed alignment without a result."""
    return Alignment(pair.mapping(seed.fixed_to_moving), pair.fixed.size_px, "failed", (issue,), seed)


@dataclass(frozen=True)
class WarpedPair:
    """A pair with the warped moving image and the residual of its windows."""

    pair: BandPair
    mapping: PixelMapping
    warped: Raster
    """The moving image, one channel, on the grid of the reference."""
    windows: FixedWindows
    residual: Residual[FixedImagePx]
    """Of these windows."""

    @classmethod
    def of(cls, pair: BandPair, mapping: PixelMapping, windows: FixedWindows | None = None) -> "WarpedPair":
        """Warp the moving image and measure the residual of `windows`.

        By default these are those of the pair, or small ones if these cover more quarters of the overlap. A fit and its
        verification must use the same windows: those of two grids share pixels, whatever their colours.
        """
        warped = pair.warped_moving(mapping)
        if windows is not None:
            return cls(pair, mapping, warped, windows, windows.residuals(warped))
        usual, size_px = cls(pair, mapping, warped, pair.windows, pair.windows.residuals(warped)), pair.fixed.size_px
        in_frame_px = points_in_frame(mapping, size_px, pair.moving_image.size_px)
        if not unobserved_quarters(usual.residual.centres_px, size_px, in_frame_px):
            return usual
        small = pair.reference.small_windows
        smaller = replace(usual, windows=small, residual=small.residuals(warped))
        counts = [len(unobserved_quarters(p.residual.measured_px, size_px, in_frame_px)) for p in (usual, smaller)]
        return smaller if counts[1] < counts[0] else usual

    def with_mapping(self, mapping: PixelMapping) -> "WarpedPair":
        """Return the pair with another mapping; the residual is that of the same windows.

        It is converted if the mappings are nearly equal, else measured.
        """
        if mapping.field is self.mapping.field:
            corners = geometry.corners(*self.pair.fixed.size_px)
            difference_px = float(np.linalg.norm(mapping(corners) - self.mapping(corners), axis=1).max())
            # The error of the conversion is then about 0.01 px, because interpolation changes shifts by 0.1 to 0.25 of
            # their distance from whole pixels.
            max_converted_px = 0.15
            if difference_px <= max_converted_px:
                return replace(self, mapping=mapping, residual=residual_under(self.residual, self.mapping, mapping))
        return WarpedPair.of(self.pair, mapping, self.windows)

    def is_better_than(self, other: "WarpedPair") -> bool:
        """Return True if the median shift, divided by the coverage, is smaller in the same windows."""
        compared = other if other.windows is self.windows else WarpedPair.of(other.pair, other.mapping, self.windows)
        own, others = (r.median_px / max(r.coverage, 1e-6) for r in (self.residual, compared.residual))
        return own < others

    def cross_validated(self, by_halves: tuple[Matrix, Matrix]) -> "WarpedPair":
        """Return the pair with the residual of each window under a mapping that was estimated without it.

        `by_halves` are homographies estimated from the black and from the white windows of a chessboard.
        """
        by_black_px, by_white_px = (
            residual_under(self.residual, self.mapping, replace(self.mapping, fixed_to_moving=matrix)).shifts_px
            for matrix in by_halves
        )
        shifts_px = np.where(self.residual.is_black[:, None], by_white_px, by_black_px)
        return replace(self, residual=self.residual.with_shifts(shifts_px))

    @property
    def reduced_scale(self) -> PixelScale:
        """(x, y) of the reduced images relative to the fixed image."""
        return self.pair.reference.seed_scale

    def reduced_spectra(self) -> tuple[Field, Field]:
        """Windowed spectra (height, width) of the structures of the reduced fixed and moving images."""
        small = shrink(self.warped, self.pair.reference.seed_size_px)
        return self.pair.reference.seed_spectrum, windowed_spectra(structure_field(small))

    def is_expected(self, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """Return True if the mapping shifted by (x, y), px of the fixed image, agrees with a candidate of the pair."""
        return self.pair.is_expected(self.mapping.fixed_to_moving, shift_px)

    def issues(self, joint: JointResult[FixedImagePx]) -> tuple[Issue, ...]:
        """Return the issues of the result with this mapping."""
        pair = self.pair
        size_px, pixel_px = pair.fixed.size_px, pair.file_pixel_size_px
        return issues_of(Evidence(joint, self.residual, size_px, images=self, file_pixel_size_px=pixel_px))


def verified(
    pair: BandPair,
    seed: Seed,
    result: JointResult[FixedImagePx] | Issue,
    use: ReliefUse,
    warped_pair: WarpedPair | None = None,
    by_halves: tuple[Matrix, Matrix] | None = None,
) -> Alignment[FixedImagePx]:
    """Verify a result; return its alignment with status, px of the images. With issues it has the mapping of the seed.

    `use` is "never" for no displacement field. `warped_pair` is the pair with a mapping close to the result's, if
    available; it avoids measuring again. `by_halves` are homographies from half of the windows (`cross_validated`).
    """
    if isinstance(result, Issue):
        return at_seed(pair, seed, (result,))
    joint = _unchanged_if_aligned(result, pair)
    mapping = pair.mapping(joint.fixed_to_moving)
    warped_pair = WarpedPair.of(pair, mapping) if warped_pair is None else warped_pair.with_mapping(mapping)
    if by_halves is not None and joint is result:
        warped_pair = warped_pair.cross_validated(by_halves)
    warped_pair, issues, displacement = _verified(warped_pair, joint, use)
    candidates: dict[Geometry, FixedImagePx] = {}
    if displacement is not None:
        candidates = {"homography": displacement.before_p95_px, "field": displacement.after_p95_px}
    if issues and (displacement is None or displacement.field is None):
        return replace(at_seed(pair, seed, issues), joint=joint, candidates=candidates)
    size_px, residual = pair.fixed.size_px, warped_pair.residual
    alignment = Alignment(warped_pair.mapping, size_px, "aligned", issues, seed, joint, residual, candidates=candidates)
    return predicted_by_windows(alignment, pair) if issues else alignment


def at_seed(
    pair: BandPair, seed: Seed, issues: tuple[Issue, ...], *, seed_only: bool = False
) -> Alignment[FixedImagePx]:
    """Return an alignment with the mapping of the seed, which is usable if it is trusted or with `seed_only`."""
    mapping = pair.mapping(seed.fixed_to_moving)
    residual, is_usable = WarpedPair.of(pair, mapping).residual, seed.trusted or seed_only
    status = status_of(issues, residual, seed=is_usable)
    if is_usable and status == "failed":
        issues = (*issues, Issue(SEED_DOES_NOT_FIT))
    return Alignment(mapping, pair.fixed.size_px, status, issues, seed, residual=residual)


def predicted_by_windows(
    alignment: Alignment[FixedImagePx], pair: BandPair, reason: IssueKind | None = None
) -> Alignment[FixedImagePx]:
    """Return as `predicted` an alignment that its windows do not confirm, or another geometry than that of its capture.

    The standard error is the RMS of the shifts of these windows.
    """
    assert alignment.residual is not None
    lengths = np.linalg.norm(alignment.residual.shifts_px, axis=1)
    std_px = FixedImagePx(np.sqrt(np.nanmean(lengths**2)))
    matrix = alignment.fixed_to_moving
    prediction = Prediction(pair.scales.between_files(matrix), "windows", pair.in_moving_file_px(std_px, matrix))
    issues = alignment.issues if reason is None else (Issue(reason), *alignment.issues)
    return replace(alignment, status="predicted", issues=issues, prediction=prediction)


def _verified(
    plane: WarpedPair, joint: JointResult[FixedImagePx], use: ReliefUse
) -> tuple[WarpedPair, tuple[Issue, ...], DisplacementResult | None]:
    """Return the pair, with a displacement field if one is accepted, its issues, and the result of the field fit.

    With a field, the residual is that of held-out windows. The field is not accepted with issues that it cannot remove,
    nor with any if the pair has none without it.
    """
    pair, issues = plane.pair, plane.issues(joint)
    if not _needs_field(use, issues, has_rig=pair.has_rig):
        return plane, issues, None
    displacement = pair.reference.displacement_field.refine(channel_mean(pair.moving_image), plane.mapping)
    if displacement.field is not None:
        displaced = WarpedPair.of(pair, replace(plane.mapping, field=displacement.field), plane.windows)
        held_out = displaced if displacement.held_out is None else replace(displaced, residual=displacement.held_out)
        # All checks run again, those of windows on all windows and on the held-out ones.
        remaining = held_out.issues(joint)
        by_parallax = all(issue.kind in _PARALLAX_ISSUES for issue in remaining)
        if not displaced.issues(joint) and by_parallax and (issues or not remaining):
            return held_out, remaining, displacement
    return plane, issues, replace(displacement, field=None)


def _needs_field(use: ReliefUse, issues: tuple[Issue, ...], *, has_rig: bool) -> bool:
    """Return True if a displacement field is fitted for a result with these issues.

    With `auto`, it is fitted if all issues may be caused by parallax, and without issues if no rig contains the
    residual lens distortion.
    """
    only_parallax = all(issue.kind in _PARALLAX_ISSUES for issue in issues)
    return only_parallax and (use == "always" or (use == "auto" and (bool(issues) or not has_rig)))


def with_metrics(
    alignment: Alignment[FixedImagePx], pair: BandPair, *, with_ties: bool = False
) -> Alignment[FixedImagePx]:
    """Return the alignment with similarity metrics before (image borders overlaid) and after alignment.

    `with_ties` also measures windows under the final mapping: small ones if parallax varies within large ones.
    """
    similarity = pair.reference.similarity
    before = pair.warped_moving(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    after = pair.warped_moving(alignment.mapping)
    windows = pair.windows if alignment.mapping.parallax is None else pair.reference.tie_windows
    ties = windows.residuals(after) if with_ties else None
    return replace(alignment, before=similarity.to(before), after=similarity.to(after), ties=ties)


def _unchanged_if_aligned(joint: JointResult[FixedImagePx], pair: BandPair) -> JointResult[FixedImagePx]:
    """Replace the mapping by the one given by the files if it does not differ significantly.

    Input that is aligned already is returned unchanged instead of resampled by a small shift.
    """
    kinds: tuple[SeedKind, ...] = ("geo", "identity")
    for given in (pair.candidates[kind] for kind in kinds if kind in pair.candidates):
        if pair.mapping(given).is_curved:
            continue  # with lens distortion the files are not aligned
        if is_unchanged(joint, given, pair.fixed.size_px, max(pair.scales.fixed)):
            return replace(joint, fixed_to_moving=given)
    return joint
