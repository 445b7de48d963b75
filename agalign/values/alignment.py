"""Results of aligning a band pair, and their uncertainty."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Generic, cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from agalign.values import geometry
from agalign.values.choices import ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue, explanation, sentence
from agalign.values.pixel_units import (
    SAME_PIXELS,
    FixedFilePx,
    FixedImagePx,
    FixedPx,
    MovingFilePx,
    PixelScale,
)
from agalign.values.relief import Parallax

MIN_RETRIEVAL = 0.2
"""Minimum held-out retrieval: below it psi is not updated and no result is accepted. Chance is below 0.01; unrelated
images reach 0.05."""
MIN_TIMES_CHANCE = 5.0
"""The same limit as a multiple of chance, which is high where few keypoints can be drawn."""


@dataclass(frozen=True)
class Seed:
    """Initial alignment, with the correlation of the images under it."""

    kind: SeedKind
    fixed_to_moving: Matrix
    score: float
    """Height of the correlation at this mapping, in standard deviations; candidates are compared by it."""
    peak_sigma: float = 0.0
    """Height of the correlation peak above its surroundings, in standard deviations."""
    runner_up_sigma: float = 0.0
    """The same for the second highest separate peak."""
    trusted: bool = False
    """The images confirm that it is accurate to a few pixels."""


@dataclass(frozen=True)
class JointResult(Generic[FixedPx]):
    """The result of the joint optimisation, on the grid of the images or of the files (`FixedPx`)."""

    fixed_to_moving: Matrix
    loss: float
    retrieval: float
    """Share of held-out patches with the corresponding patch as nearest descriptor in the other image."""
    chance: float
    """The retrieval that guessing would give."""
    iterations: int
    levels: tuple[float, ...]
    """Resolutions of the image pyramid, coarse to fine; 1 is full."""
    recipe: str
    model_family: ModelFamily
    last_step_px: float
    corner_std_xy_px: tuple[tuple[float, float], ...]
    """Standard deviations along x and y of the mapping at the corners of the reference, clockwise from the top left,
    px of the reference: from the curvature at the solution and the scatter of the patches."""
    corner_covariance_px2: NDArray[np.float64] | None = None
    """(8, 8) of (x, y) of those corners, for a homography whatever the family; None where it is not known."""

    @property
    def corner_std_px(self) -> FixedPx:
        """Standard error of the mapping at the least certain corner: root mean square over both axes together."""
        return cast(FixedPx, max(math.hypot(*std) for std in self.corner_std_xy_px))

    def in_file_px(self: "JointResult[FixedImagePx]", scales: "PairScales") -> "JointResult[FixedFilePx]":
        """The same between the files."""
        up = scales.fixed.inverse
        per_axis = np.outer(np.tile(up, 4), np.tile(up, 4))
        covariance = None if self.corner_covariance_px2 is None else self.corner_covariance_px2 * per_axis
        return JointResult(
            scales.between_files(self.fixed_to_moving), self.loss, self.retrieval, self.chance, self.iterations,
            self.levels, self.recipe, self.model_family, self.last_step_px * up.mean,
            tuple((x * up.x, y * up.y) for x, y in self.corner_std_xy_px), covariance,
        )  # fmt: skip


@dataclass(frozen=True)
class RefinedPair:
    """The seed of a pair and its mapping refined by a flight's network, from the images of this pair alone."""

    seed: Seed
    result: JointResult[FixedImagePx]
    sizes_px: tuple[tuple[int, int], tuple[int, int]]
    """(width, height) of the fixed and the moving image."""


@dataclass(frozen=True)
class Residual(Generic[FixedPx]):
    """Shifts of windows that remain after alignment, measured independently of the estimation, on the fixed grid."""

    centres_px: NDArray[np.float64]
    """(n, 2) centres of the windows."""
    shifts_px: NDArray[np.float64]
    """(n, 2) position of the moving band's structure minus that of the reference's; nan where not measured."""
    median_px: FixedPx
    p95_px: FixedPx
    coverage: float
    """Share of the textured windows in which a shift could be measured."""
    peaks_sigma: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.empty(0))
    """(n,) height of the correlation peak of each window, in standard deviations; the error of a shift is inversely
    proportional to its square."""

    @classmethod
    def of(
        cls, centres_px: NDArray[np.float64], shifts_px: NDArray[np.float64], peaks_sigma: NDArray[np.float64]
    ) -> "Residual[FixedPx]":
        """Return the statistics of shifts (n, 2) with correlation peaks (n,) in standard deviations."""
        measured = np.isfinite(shifts_px[:, 0])
        length = np.linalg.norm(shifts_px[measured], axis=1)
        median, p95 = np.percentile(length, (50, 95)) if len(length) else (np.inf, np.inf)
        coverage = float(measured.mean()) if len(measured) else 0.0
        return cls(
            centres_px, shifts_px, cast(FixedPx, float(median)), cast(FixedPx, float(p95)), coverage, peaks_sigma
        )

    @property
    def measured_px(self) -> NDArray[np.float64]:
        """(m, 2) centres of the windows in which a shift was measured."""
        return self.centres_px[np.isfinite(self.shifts_px[:, 0])]

    def is_better_than(self, other: "Residual[FixedPx]") -> bool:
        """True if the median shift, divided by the coverage, is smaller."""
        return self.median_px / max(self.coverage, 1e-6) < other.median_px / max(other.coverage, 1e-6)

    def in_file_px(self: "Residual[FixedImagePx]", scales: "PairScales") -> "Residual[FixedFilePx]":
        """The same on the grid of the reference band's file."""
        up = scales.fixed.inverse
        return Residual[FixedFilePx].of(
            up.positions(self.centres_px), up.displacements(self.shifts_px), self.peaks_sigma
        )


@dataclass(frozen=True)
class DisplacementField:
    """A smooth field of displacements on an image, px, by its values on a lattice."""

    step_px: float
    """Distance of the lattice's nodes, px of the image that it was made for."""
    displacements_px: NDArray[np.float64]
    """(rows, columns, 2), px of that image; the first node is the centre of its top-left pixel."""
    scale: PixelScale = SAME_PIXELS
    """Size of that image relative to the one on which the field is evaluated."""

    def __call__(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """The displacement (..., 2) at points (..., 2), by cubic splines; outside the lattice that of its edge."""
        points = np.asarray(points_px)
        on_lattice = points if self.scale == SAME_PIXELS else self.scale.positions(points)
        at = on_lattice.reshape(-1, 2)[:, ::-1].T / self.step_px
        planes = np.moveaxis(self.displacements_px, -1, 0)
        values = [map_coordinates(plane, at, order=3, mode="nearest") for plane in planes]
        return self.scale.inverse.displacements(np.stack(values, axis=-1).reshape(points.shape))

    def rescaled(self, scale: PixelScale) -> "DisplacementField":
        """The same on an image that is resized by `scale`."""
        return replace(self, scale=self.scale.over(scale))

    def on_lattice(self, step_px: float, size_px: tuple[int, int]) -> "DisplacementField":
        """The same by its values on another lattice, which covers an image (width, height)."""
        columns, rows = (math.ceil(n / step_px) + 1 for n in size_px)
        nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64) * step_px
        return DisplacementField(float(step_px), self(nodes))

    def plus(self, other: "DisplacementField") -> "DisplacementField":
        """The sum of two fields on one lattice: x -> d(x) + other(x)."""
        return DisplacementField(self.step_px, self.displacements_px + other.displacements_px)


@dataclass(frozen=True)
class DisplacementResult(Generic[FixedPx]):
    """A displacement field, and its effect on the residual of held-out windows; no field if it does not reduce it."""

    field: DisplacementField | None
    before_p95_px: FixedPx
    after_p95_px: FixedPx
    held_out: "Residual[FixedPx] | None" = None
    """Residual of held-out windows: each field is fitted without the window and those that overlap it."""

    def in_file_px(self: "DisplacementResult[FixedImagePx]", scales: "PairScales") -> "DisplacementResult[FixedFilePx]":
        """The same on the grid of the reference band's file."""
        up = scales.fixed.inverse
        field = None if self.field is None else self.field.rescaled(up)
        before, after = (FixedFilePx(p95 * up.mean) for p95 in (self.before_p95_px, self.after_p95_px))
        return DisplacementResult(
            field, before, after, None if self.held_out is None else self.held_out.in_file_px(scales)
        )


@dataclass(frozen=True)
class PairScales:
    """The sizes of the two images of a band pair, each relative to its file."""

    fixed: PixelScale = SAME_PIXELS
    moving: PixelScale = SAME_PIXELS

    def between_files(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the images as one between their files."""
        return geometry.rescale(fixed_to_moving, self.fixed.inverse, self.moving.inverse)

    def between_images(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the files as one between the images."""
        return geometry.rescale(fixed_to_moving, self.fixed, self.moving)


SAME_SCALES = PairScales()
"""Both images have the pixels of their files."""

_SOURCES: dict[PredictionSource, str] = {
    "bands": "the capture's other bands", "neighbours": "the captures around it", "flight": "the flight's mean",
    "windows": "windows in the image",
}  # fmt: skip


@dataclass(frozen=True)
class Prediction:
    """Mapping of a band by the rig of the flight, or by extrapolation."""

    fixed_to_moving: Matrix
    """Between the files; between undistorted pixels if the mappings of the rig are."""
    source: PredictionSource
    """Other bands of the capture, neighbouring captures, mean of the flight, or windows in the rest of the image."""
    std_px: MovingFilePx
    """Standard error: root mean square over the image."""
    off_px: MovingFilePx | None = None
    """Root mean square distance from the band's own alignment; None if there is none."""
    covariance_px2: NDArray[np.float64] | None = None
    """(12, 12) of an extrapolated mapping, over the corners and the lens shapes (`verify.lens_shapes`), px of the
    reference's file; None for a rig's."""


@dataclass(frozen=True)
class Alignment(Generic[FixedPx]):
    """Mapping of one band pair, between the images or between the files, and how it was estimated and verified."""

    fixed_to_moving: Matrix
    """Between undistorted pixels if both lenses are known, else between raw pixels."""
    space: Space
    status: PairStatus
    issues: tuple[Issue, ...]
    """Reasons against accepting the alignment, the most important first; empty if it is `aligned`."""
    seed: Seed
    joint: JointResult[FixedPx] | None
    residual: Residual[FixedPx] | None
    seconds: float
    before: Mapping[str, float] = dataclasses.field(default_factory=dict)
    after: Mapping[str, float] = dataclasses.field(default_factory=dict)
    local: DisplacementResult[FixedPx] | None = None
    """Displacement field of this band alone and its gain; None if none was tried."""
    field: DisplacementField | None = None
    """Displacements of rig and capture in raw px of the reference, applied before the homography."""
    parallax: Parallax | None = None
    """The capture's relief, which displaces undistorted px of the reference along the band's baseline."""
    prediction: Prediction | None = None
    """Prediction by the rig of the flight; None without a rig."""

    def in_file_px(self: "Alignment[FixedImagePx]", scales: "PairScales") -> "Alignment[FixedFilePx]":
        """The same between the files of the two bands."""
        up = scales.fixed.inverse
        return Alignment(
            scales.between_files(self.fixed_to_moving), self.space, self.status, self.issues,
            replace(self.seed, fixed_to_moving=scales.between_files(self.seed.fixed_to_moving)),
            None if self.joint is None else self.joint.in_file_px(scales),
            None if self.residual is None else self.residual.in_file_px(scales),
            self.seconds, self.before, self.after,
            None if self.local is None else self.local.in_file_px(scales),
            None if self.field is None else self.field.rescaled(up),
            None if self.parallax is None else self.parallax.rescaled(up), self.prediction,
        )  # fmt: skip

    @property
    def reason(self) -> str | None:
        """Why the band is not aligned; None if it is."""
        text = explanation(self.issues)
        if text is None or self.status == "aligned":
            return None
        if self.status == "predicted" and self.prediction is not None:
            source, std_px = _SOURCES[self.prediction.source], self.prediction.std_px
            return f"{text}; predicted from {source}, standard error {std_px:.2f} px"
        if self.status == "seed_only":
            return f"{text}; the {self.seed.kind} seed is used unchanged"
        if self.issues[-1].kind == SEED_DOES_NOT_FIT:
            return f"{text}; the {self.seed.kind} seed is used unchanged, {sentence(self.issues[-1])}"
        return text

    def __repr__(self) -> str:
        """One line without the arrays."""
        median_px = None if self.residual is None else round(self.residual.median_px, 3)
        std_px = None if self.joint is None else round(self.joint.corner_std_px, 3)
        reason = "" if self.reason is None else f", reason={self.reason!r}"
        return f"Alignment(status={self.status!r}, residual_median_px={median_px}, corner_std_px={std_px}{reason})"
