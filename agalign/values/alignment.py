"""What alignment finds of a band pair, and how sure it is."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from agalign.values import geometry
from agalign.values.choices import ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue, explanation, sentence

MIN_RETRIEVAL = 0.2
"""Held-out retrieval below which descriptors do not match: psi does not move and no result is accepted. Chance is below
0.01, unrelated images reach 0.05 (docs/method.md)."""
MIN_TIMES_CHANCE = 5.0
"""The same as a multiple of chance: it decides where few keypoints can be drawn and chance is high."""


@dataclass(frozen=True)
class Seed:
    """A coarse mapping to start from and how well the images agree under it."""

    kind: SeedKind
    fixed_to_moving: Matrix
    score: float
    """By which candidates are compared: the height of the correlation at this mapping, in standard deviations."""
    peak_sigma: float = 0.0
    """Height of the correlation peak above its surroundings, in standard deviations."""
    runner_up_sigma: float = 0.0
    """The same for the second highest separate peak."""
    trusted: bool = False
    """The images themselves leave no doubt that it is good to a few pixels."""


@dataclass(frozen=True)
class JointResult:
    """What the joint optimisation ended with."""

    fixed_to_moving: Matrix
    loss: float
    retrieval: float
    """Share of held-out patches whose nearest descriptor in the other image is the right one."""
    chance: float
    """The retrieval that guessing would give."""
    iterations: int
    levels: tuple[float, ...]
    """Resolutions worked at, coarse to fine; 1 is full."""
    recipe: str
    model_family: ModelFamily
    last_step_px: float
    corner_std_xy_px: tuple[tuple[float, float], ...]
    """Standard deviations along x and y of the mapping at the corners of the reference, clockwise from the top left,
    px of the reference: from the curvature at the solution and what the patches disagree by."""
    corner_covariance_px2: NDArray[np.float64] | None = None
    """(8, 8) of (x, y) of those corners, for a homography whatever the family; None where it is not known."""

    @property
    def corner_std_px(self) -> float:
        """Root mean square distance of the least certain corner from where it is mapped to."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)

    def enlarged(self, up: tuple[float, float], moving_up: tuple[float, float]) -> "JointResult":
        """The same of images that are larger by these factors (x, y)."""
        return replace(
            self,
            fixed_to_moving=geometry.rescale(self.fixed_to_moving, up, moving_up),
            corner_std_xy_px=tuple((x * up[0], y * up[1]) for x, y in self.corner_std_xy_px),
            last_step_px=self.last_step_px * up[0],
            corner_covariance_px2=None
            if self.corner_covariance_px2 is None
            else self.corner_covariance_px2 * np.outer(np.tile(up, 4), np.tile(up, 4)),
        )


@dataclass(frozen=True)
class Residual:
    """Local shifts that an alignment leaves, measured independently of how it was found."""

    centres_px: NDArray[np.float64]
    """(n, 2) tile centres on the reference grid."""
    shifts_px: NDArray[np.float64]
    """(n, 2) where the moving band's structure lies minus where the reference's does; nan where not measured."""
    median_px: float
    p95_px: float
    coverage: float
    """Share of the tiles with enough structure in which a shift could be measured."""
    peaks_sigma: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.empty(0))
    """(n,) how far each tile's correlation peak stands out, in standard deviations: the error of a shift falls with its
    square."""

    @classmethod
    def of(
        cls, centres_px: NDArray[np.float64], shifts_px: NDArray[np.float64], peaks_sigma: NDArray[np.float64]
    ) -> "Residual":
        """What (n, 2) shifts say of all windows together."""
        measured = np.isfinite(shifts_px[:, 0])
        length = np.linalg.norm(shifts_px[measured], axis=1)
        median, p95 = np.percentile(length, (50, 95)) if len(length) else (np.inf, np.inf)
        coverage = float(measured.mean()) if len(measured) else 0.0
        return cls(centres_px, shifts_px, float(median), float(p95), coverage, peaks_sigma)

    def is_better_than(self, other: "Residual") -> bool:
        """True where more windows lie close: half of all, weighed with how many could be measured, within less."""
        return self.median_px / max(self.coverage, 1e-6) < other.median_px / max(other.coverage, 1e-6)

    def enlarged(self, up: tuple[float, float]) -> "Residual":
        """The same on an image that is larger by these factors (x, y)."""
        return replace(
            self,
            centres_px=(self.centres_px + 0.5) * up - 0.5,
            shifts_px=self.shifts_px * up,
            median_px=self.median_px * up[0],
            p95_px=self.p95_px * up[0],
        )


@dataclass(frozen=True)
class DisplacementField:
    """A smooth field of displacements on an image, px, by its values on a lattice."""

    step_px: float
    displacements_px: NDArray[np.float64]
    """(rows, columns, 2); the first lies at (0, 0)."""

    def __call__(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """The displacement (..., 2) at points (..., 2), by cubic splines; beyond the lattice that of its edge."""
        points = np.asarray(points_px)
        at = points.reshape(-1, 2)[:, ::-1].T / self.step_px
        planes = np.moveaxis(self.displacements_px, -1, 0)
        result = [map_coordinates(plane, at, order=3, mode="nearest") for plane in planes]
        return np.stack(result, axis=-1).reshape(points.shape)

    def rescaled(self, scale: tuple[float, float]) -> "DisplacementField":
        """The same on an image that is larger by these factors (x, y), which are all but equal."""
        # The lattice's first node lies at the centre of a pixel; half a pixel is nothing to a smooth field.
        return DisplacementField(self.step_px * scale[0], self.displacements_px * scale)

    def on_lattice(self, step_px: float, size_px: tuple[int, int]) -> "DisplacementField":
        """The same by its values on another lattice, which covers an image (width, height)."""
        columns, rows = (math.ceil(n / step_px) + 1 for n in size_px)
        nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64) * step_px
        return DisplacementField(float(step_px), self(nodes))

    def plus(self, other: "DisplacementField") -> "DisplacementField":
        """X -> x + d(x) with this field, measured again under it: d(x) + other(x)."""
        return DisplacementField(self.step_px, self.displacements_px + other.displacements_px)


@dataclass(frozen=True)
class DisplacementResult:
    """A field of displacements, where it gains something, and what it gains on windows it was not fitted to."""

    field: DisplacementField | None
    before_p95_px: float
    after_p95_px: float

    def enlarged(self, up: tuple[float, float]) -> "DisplacementResult":
        """The same on an image that is larger by these factors (x, y)."""
        larger = None if self.field is None else self.field.rescaled(up)
        return DisplacementResult(larger, self.before_p95_px * up[0], self.after_p95_px * up[0])


_SOURCES: dict[PredictionSource, str] = {
    "bands": "the capture's other bands", "neighbours": "the captures around it", "flight": "the flight's mean",
}  # fmt: skip


@dataclass(frozen=True)
class Prediction:
    """The mapping of a band that the rig of a flight predicts."""

    fixed_to_moving: Matrix
    """Between the files, undistorted where the rig's mappings are."""
    source: PredictionSource
    """From the capture's other bands, from the captures around it, or from the flight's mean."""
    std_px: float
    """Root mean square error that is to be expected over the image, px of the moving file."""
    off_px: float | None = None
    """Root mean square distance of what the band's own image says; None where it says nothing."""


@dataclass(frozen=True)
class Alignment:
    """The mapping found for one band pair and everything known about it."""

    fixed_to_moving: Matrix
    """Between undistorted pixels where both lenses are known, else between raw pixels."""
    space: Space
    status: PairStatus
    issues: tuple[Issue, ...]
    """What speaks against it, the plainest first; none where it is `aligned`."""
    seed: Seed
    joint: JointResult | None
    residual: Residual | None
    seconds: float
    before: Mapping[str, float] = dataclasses.field(default_factory=dict)
    after: Mapping[str, float] = dataclasses.field(default_factory=dict)
    local: DisplacementResult | None = None
    """What a field of displacements of this capture's own gains; None where it was not asked for."""
    field: DisplacementField | None = None
    """All displacements in raw px of the reference, before the homography: the rig's and the capture's own."""
    prediction: Prediction | None = None
    """What the flight's rig says of it; None without a rig."""

    def between_files(self, fixed_scale: tuple[float, float], moving_scale: tuple[float, float]) -> "Alignment":
        """An alignment of images that were reduced by these scales (x, y) as one of their files."""
        if fixed_scale == moving_scale == (1.0, 1.0):
            return self
        up, there = ((1 / x, 1 / y) for x, y in (fixed_scale, moving_scale))
        return replace(
            self,
            fixed_to_moving=geometry.rescale(self.fixed_to_moving, up, there),
            seed=replace(self.seed, fixed_to_moving=geometry.rescale(self.seed.fixed_to_moving, up, there)),
            joint=None if self.joint is None else self.joint.enlarged(up, there),
            residual=None if self.residual is None else self.residual.enlarged(up),
            local=None if self.local is None else self.local.enlarged(up),
            field=None if self.field is None else self.field.rescaled(up),
        )

    @property
    def reason(self) -> str | None:
        """Why it is not aligned, in words; None where it is."""
        told = explanation(self.issues)
        if told is None or self.status == "aligned":
            return None
        if self.status == "predicted" and self.prediction is not None:
            known = f"known to {self.prediction.std_px:.2f} px from {_SOURCES[self.prediction.source]}"
            return f"{told}; the rig of the flight says where it lies, {known}"
        if self.status == "seed_only":
            return f"{told}; the {self.seed.kind} seed is used as it is"
        if self.issues[-1].kind == SEED_DOES_NOT_FIT:
            return f"{told}; the {self.seed.kind} seed is used as it is, {sentence(self.issues[-1])}"
        return told

    def __repr__(self) -> str:
        """One line without the arrays."""
        median_px = None if self.residual is None else round(self.residual.median_px, 3)
        std_px = None if self.joint is None else round(self.joint.corner_std_px, 3)
        reason = "" if self.reason is None else f", reason={self.reason!r}"
        return f"Alignment(status={self.status!r}, residual_median_px={median_px}, corner_std_px={std_px}{reason})"
