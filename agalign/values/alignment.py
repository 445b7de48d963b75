"""Results of aligning a band pair, and their uncertainty."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray  # the former in quotes: help() prints its name, not 1,000 characters
from pydantic import Field
from pydantic import dataclasses as validated

from agalign.errors import InputError
from agalign.values import geometry
from agalign.values.arguments import checked
from agalign.values.choices import Geometry, Interpolation, ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.equality import equal
from agalign.values.fields import RECORD, Array, Matrix3x3, Measured, Number, Number4, Number6, UpToInfinity
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Mask
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue, sentence
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size
from agalign.values.resampling import can_hold, planes_of, positions_of, resample_planes, valid_of

COVARIANCE_DECIMALS = 9
"""Of covariances in a sidecar, px squared: a millionth of those of accurate mappings."""
MIN_RETRIEVAL = 0.2
"""Minimum held-out retrieval: below it psi is not updated and no result is accepted. Chance is below 0.01; unrelated
images reach 0.05."""
MIN_TIMES_CHANCE = 5.0
"""`MIN_RETRIEVAL` as a multiple of chance, which is high where few keypoints can be drawn."""
_NOISE_PX_SIGMA2 = 48.0
"""RMS noise of the shift of a window times the squared height of its peak, in windows of 40 to 64 px: the median shift
of aligned windows is 0.7 to 1.35 of that noise in sharp, noisy and blurred scenes, with peaks of 8 sigma to 30."""


def noise_px(peaks_sigma: ArrayLike) -> NDArray[np.float64]:
    """Return the RMS noise (n,) of the length of measured shifts from the heights (n,) of their correlation peaks."""
    return np.asarray(_NOISE_PX_SIGMA2 / np.square(peaks_sigma))


@validated.dataclass(frozen=True, config=RECORD)
class Seed:
    """Initial alignment.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> seed = result.seed
    >>> seed.kind, seed.trusted, seed.peak_sigma > 10 * seed.runner_up_sigma
    ('structure', True, True)
    >>> seed.fixed_to_moving.round()
    array([[1., 0., 8.],
           [0., 1., 8.],
           [0., 0., 1.]])
    """

    __eq__ = equal

    kind: SeedKind
    """`user`; `match` (learned descriptors matched); `model` (median mapping of the flight); `rig` (camera tags);
    `centre` (optical centres of DJI); `geo` (geotransforms); `structure` (phase correlation); `identity`."""
    fixed_to_moving: Matrix3x3
    """Homography (3, 3) from the reference to the moving image: between undistorted px if both lenses are known, else
    between raw px."""
    score: Number
    """Correlation at this mapping, in standard deviations; 0 if it replaced a seed that contradicts it."""
    peak_sigma: Number = 0.0
    """Height of the correlation peak, in standard deviations."""
    runner_up_sigma: Number = 0.0
    """Height of the second highest separate peak, in standard deviations."""
    trusted: bool = False
    """The images confirm it to a few pixels, or it is that of tags or flight and replaced a seed that contradicts it.
    """


@validated.dataclass(frozen=True, config=RECORD)
class JointResult:
    """Estimate from descriptors, windows, other bands and rig, or from windows alone.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> joint = result.joint
    >>> joint.recipe, joint.model_family, joint.retrieval > 10 * joint.chance
    ('fast', 'homography', True)
    >>> len(joint.corner_std_xy_px), joint.corner_std_px < 0.2
    (4, True)
    """

    __eq__ = equal

    fixed_to_moving: Matrix3x3
    """Between the same px as the seed. A prediction may have replaced it."""
    loss: Annotated[float, Measured()]
    """Final loss."""
    retrieval: Number
    """Share of held-out patches whose nearest descriptor is the corresponding one."""
    chance: Number
    """Retrieval by guessing."""
    iterations: int
    """Training steps."""
    levels: tuple[Number, ...]
    """Resolutions of the image pyramid; 1 is full."""
    recipe: str
    """`flight` (frozen network of the flight), `fast` (learned on this capture), `paper`, or `windows` (windows
    alone)."""
    model_family: ModelFamily
    """Mapping that was fitted."""
    last_step_px: Number
    """Movement of a corner in the last step."""
    corner_std_xy_px: Annotated[tuple[tuple[UpToInfinity, UpToInfinity], ...], Field(min_length=4, max_length=4)]
    """Standard errors (x, y) at the corners of the reference, clockwise from the top left, px."""
    corner_covariance_px2: Annotated[NDArray[np.float64], Array((8, 8), COVARIANCE_DECIMALS)] | None = None
    """Their covariance."""

    @property
    def corner_std_px(self) -> float:
        """Standard error of the mapping at the least certain corner: root mean square distance, of x and y together."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)

    @property
    def covariance_px2(self) -> NDArray[np.float64]:
        """The covariance (8, 8) of the corners, or their variances alone where only these are known."""
        if self.corner_covariance_px2 is not None:
            return self.corner_covariance_px2
        return np.diag(np.square(np.ravel(self.corner_std_xy_px)))

    def with_homography(self, fixed_to_moving: Matrix, covariance_px2: NDArray[np.float64]) -> "JointResult":
        """Return the result with another homography and covariance (8, 8) of the corners."""
        std = tuple((float(x), float(y)) for x, y in np.sqrt(np.diag(covariance_px2)).reshape(4, 2))
        return replace(
            self, fixed_to_moving=fixed_to_moving, corner_covariance_px2=covariance_px2, corner_std_xy_px=std
        )

    def in_file_px(self, scales: "PairScales") -> "JointResult":
        """Convert the result between the images to one between the files."""
        up = scales.fixed.inverse
        per_axis = np.outer(np.tile(up, 4), np.tile(up, 4))
        return replace(
            self,
            fixed_to_moving=scales.between_files(self.fixed_to_moving),
            last_step_px=self.last_step_px * up.mean,
            corner_std_xy_px=tuple((x * up.x, y * up.y) for x, y in self.corner_std_xy_px),
            corner_covariance_px2=None if self.corner_covariance_px2 is None else self.corner_covariance_px2 * per_axis,
        )


@dataclass(frozen=True)
class RefinedPair:
    """The seed of a pair and its mapping refined by a flight's network, from the images of this pair alone."""

    seed: Seed
    result: JointResult
    sizes_px: tuple[tuple[int, int], tuple[int, int]]
    """(width, height) of the fixed and the moving image."""


@validated.dataclass(frozen=True, config=RECORD)
class Residual:
    """Shifts of windows under a mapping, by phase correlation.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> residual = result.residual
    >>> residual.median_px < 0.1, residual.p95_px < 0.1, residual.std_px < 0.1, residual.coverage
    (True, True, True, 1.0)
    >>> residual.shifts_px.shape, residual.lengths_px.shape, int(residual.is_measured.sum())
    ((24, 2), (24,), 24)
    >>> x_px, y_px = residual.measured_px[residual.lengths_px.argmax()]  # window with the largest shift
    """

    __eq__ = equal

    centres_px: Annotated[NDArray[np.float64], Array((None, 2), 2)]
    """(n, 2) centres of the windows, px of the reference."""
    shifts_px: Annotated[NDArray[np.float64], Array((None, 2), 3, nullable=True)]
    """(n, 2) position of the moving band's structure minus that of the reference's, px of the reference; NaN, null in
    JSON, where it could not be measured."""
    peaks_sigma: Annotated[NDArray[np.float64], Array((None,), 2, nullable=True)]
    """(n,) height of the correlation peak of each window, in standard deviations; the error of a shift is inversely
    proportional to its square."""
    cells: Annotated[NDArray[np.int64], Array((None, 2), integers=True)]
    """(n, 2) column and row of each window in the complete grid, whichever windows of it are measured."""

    def __post_init__(self) -> None:
        """Raise ValueError for arrays of different lengths."""
        if len({len(column) for column in (self.centres_px, self.shifts_px, self.peaks_sigma, self.cells)}) > 1:
            raise ValueError("its lists have different lengths")

    @classmethod
    def joined(cls, several: Sequence["Residual"]) -> "Residual":
        """Return the windows of several residuals as one."""
        return cls(
            np.concatenate([one.centres_px for one in several]),
            np.concatenate([one.shifts_px for one in several]),
            np.concatenate([one.peaks_sigma for one in several]),
            np.concatenate([one.cells for one in several]),
        )

    def with_shifts(self, shifts_px: NDArray[np.float64]) -> "Residual":
        """Return the same windows with other shifts (n, 2)."""
        return replace(self, shifts_px=shifts_px)

    @property
    def is_measured(self) -> NDArray[np.bool_]:
        """(n,) True for windows in which a shift was measured."""
        return np.isfinite(self.shifts_px[:, 0])

    @cached_property
    def lengths_px(self) -> NDArray[np.float64]:
        """(m,) lengths of the measured shifts, px of the reference."""
        return np.asarray(np.linalg.norm(self.shifts_px[self.is_measured], axis=1))

    @property
    def median_px(self) -> float:
        """Median length of the measured shifts, px of the reference; infinite without any."""
        return self._percentiles_px[0]

    @property
    def p95_px(self) -> float:
        """95th percentile of the lengths of the measured shifts, px of the reference; infinite without any."""
        return self._percentiles_px[1]

    @cached_property
    def _percentiles_px(self) -> tuple[float, float]:
        median, p95 = np.percentile(self.lengths_px, (50, 95)).tolist() if len(self.lengths_px) else (np.inf, np.inf)
        return median, p95

    @property
    def coverage(self) -> float:
        """Share of the textured windows in which a shift could be measured."""
        return float(self.is_measured.mean()) if len(self.shifts_px) else 0.0

    @property
    def std_px(self) -> float:
        """Standard error estimated from the windows, px: their RMS shift beyond the noise of their peaks; infinite
        without any.

        A fifth of the windows may be wrong peaks or at depth edges: the RMS is the larger of those of a normal
        distribution with the same median, and with the same 80th percentile. At least half of it is kept, because the
        noise is known only to a factor.
        """
        if not len(self.lengths_px):
            return math.inf
        noise = float(np.median(noise_px(self.peaks_sigma[self.is_measured])))
        # Of a Rayleigh distribution: sqrt(-2 log(1 - p)) for the quantile p, and sqrt(2) for the RMS.
        rms_px = max(float(np.quantile(self.lengths_px, p)) / math.sqrt(-math.log(1 - p)) for p in (0.5, 0.8))
        return math.sqrt(max(rms_px**2 - noise**2, (rms_px / 2) ** 2))

    @property
    def is_even_cell(self) -> NDArray[np.bool_]:
        """(n,) True for alternate windows along both axes of their grid, as on a chessboard."""
        return np.asarray(self.cells.sum(axis=1) % 2 == 0)

    def chessboard_half(self, *, even: bool) -> "Residual":
        """Return the black or the white windows: one half for a fit, the other for its verification."""
        return self.where(self.is_even_cell == even)

    def where(self, selected: NDArray[np.bool_]) -> "Residual":
        """Return the windows where a mask (n,) is True."""
        shifts_px, peaks_sigma, cells = self.shifts_px[selected], self.peaks_sigma[selected], self.cells[selected]
        return Residual(self.centres_px[selected], shifts_px, peaks_sigma, cells)

    @property
    def measured_px(self) -> NDArray[np.float64]:
        """(m, 2) centres of the windows in which a shift was measured, px of the reference."""
        return self.centres_px[self.is_measured]

    def in_file_px(self, scales: "PairScales") -> "Residual":
        """Convert the residual to px of the reference band's file."""
        up = scales.fixed.inverse
        centres_px, shifts_px = up.positions(self.centres_px), up.displacements(self.shifts_px)
        return replace(self, centres_px=centres_px, shifts_px=shifts_px)


@dataclass(frozen=True)
class PairScales:
    """The sizes of the two images of a band pair, each relative to its file."""

    fixed: PixelScale = SAME_PIXELS
    moving: PixelScale = SAME_PIXELS

    @classmethod
    def of(cls, files_px: tuple[Size, Size], images_px: tuple[Size, Size]) -> "PairScales":
        """The scales for the sizes (width, height) of the two files and of their images."""
        return cls(*map(PixelScale.between, files_px, images_px))

    def between_files(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the images as one between their files."""
        return geometry.rescale(fixed_to_moving, self.fixed.inverse, self.moving.inverse)

    def between_images(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the files as one between the images."""
        return geometry.rescale(fixed_to_moving, self.fixed, self.moving)


SAME_SCALES = PairScales()
"""Both images have the pixels of their files."""


@validated.dataclass(frozen=True, config=RECORD)
class Prediction:
    """Mapping of a band by the rig of the flight, or by windows that do not confirm it everywhere.

    Examples
    --------
    `Alignment.prediction` is one. Indices use a predicted band if its standard error is small enough:

    >>> prediction = agalign.Prediction(np.eye(3), "neighbours", std_px=0.42, off_px=0.3)
    >>> prediction.std_px <= agalign.CheckSettings().accept_predicted_px
    True
    """

    __eq__ = equal

    fixed_to_moving: Matrix3x3
    """Homography (3, 3) from the reference's file to the band's file: between undistorted px if both lenses are known,
    else between raw px."""
    source: Annotated[PredictionSource, Field(alias="from")]
    """`bands` (other bands of the capture), `neighbours` (captures around it), `flight` (mean of the flight), or
    `windows` (windows in the image)."""
    std_px: Number4
    """Standard error (RMS over the image), px of the band."""
    off_px: Number4 | None = None
    """RMS distance from the band's own alignment, px of the band."""
    covariance_px2: Annotated[NDArray[np.float64], Array((12, 12), COVARIANCE_DECIMALS)] | None = None
    """Covariance of corners and lens shapes, px of the reference, if these were extrapolated."""


@validated.dataclass(frozen=True, config=RECORD)
class Similarity:
    """Similarity of the pixels that are valid in both bands; null: not measured. Large images are sampled.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> result.before.nmi < 1.01, result.after.nmi > 1.4
    (True, True)
    >>> round(result.after.ncc, 2), round(result.after.gradient_correlation, 2)  # reversed contrast, equal edges
    (-1.0, 1.0)
    """

    __eq__ = equal

    mattes_mi: Number6 = math.nan
    """Negative Mattes mutual information, nats, 32 bins: lower is better."""
    nmi: Number6 = math.nan
    """Normalised mutual information, 1 to 2: higher is better."""
    ncc: Number6 = math.nan
    """Normalised cross-correlation; negative if contrast is reversed."""
    gradient_correlation: Number6 = math.nan
    """Correlation of gradient magnitudes."""
    structure_ssim: Number6 = math.nan
    """SSIM of structure images."""
    overlap: Number6 = math.nan
    """Share of the image in which both bands are valid."""
    residual_px: Number6 = math.nan
    """Median length of the windows' shifts, px of the reference."""
    residual_p95_px: Number6 = math.nan
    """Their 95th percentile."""
    residual_coverage: Number6 = math.nan
    """Share of the textured windows with a measured shift."""


@dataclass(frozen=True)
class Alignment:
    """The mapping from a reference image to a moving image, and how it was estimated and verified.

    `align` returns it for two arrays, `read_alignment` for a band of an aligned capture. Positions are raw pixels: x
    right, y down, (0, 0) the centre of the top-left pixel.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> result.status, result.reason, result.size_px
    ('aligned', None, (200, 200))
    >>> result.residual.median_px < 0.1, result.joint.corner_std_px < 0.2
    (True, True)
    >>> result.geometry, result.space, result.fixed_to_moving.shape
    ('field', 'pixel', (3, 3))
    >>> unknown = agalign.align(np.ones_like(green), nir)  # raises no error
    >>> unknown.status, unknown.reason
    ('failed', 'the reference band is constant or all invalid')
    """

    __eq__ = equal

    mapping: PixelMapping
    """The complete mapping from raw pixels of the reference to raw pixels of the moving image."""
    size_px: Size
    """(width, height) of the reference; `warp` resamples to its grid."""
    issues: tuple[Issue, ...]
    """Reasons against accepting the alignment, the most important first; empty if it is `aligned`."""
    seed: Seed
    """The initial alignment."""
    joint: JointResult | None = None
    """The band's own estimate with its standard error; None without one."""
    residual: Residual | None = None
    """Shifts of windows, each under a mapping that was estimated without the window; of all windows under a seed or a
    prediction of the rig."""
    seconds: float = 0.0
    """Share of the capture's processing time, s, equal for all its bands."""
    before: Similarity = field(default_factory=Similarity)
    """Measures of similarity of the images as they are, their borders overlaid."""
    after: Similarity = field(default_factory=Similarity)
    """The same under the mapping."""
    candidates: Mapping[Geometry, float] = field(default_factory=dict)
    """p95 of the shifts of held-out windows by each geometry that was fitted; empty if only a homography was."""
    prediction: Prediction | None = None
    """Prediction of the mapping, by the rig of the flight or by windows. With `issues` it is the mapping; without, the
    mapping has been compared with it. None if there is no prediction."""
    is_seed_usable: bool = False
    """The mapping is that of the seed, which is trusted or requested, and which fits the windows."""
    lens_std_px: NDArray[np.float64] | None = None
    """(4,) standard deviations of the lens shapes (`fit.window_fit`) that neither tags nor a rig determine, px of the
    reference; None if they are known, or contained in a prediction."""
    relief_std_px: float = 0.0
    """Spread of the relief of the flight, px of the reference, which a mapping without relief lacks where no window is
    near."""
    moving_size_px: Size | None = None
    """(width, height) of the moving image; None if it is not known, as in sidecars of earlier versions."""

    @property
    def status(self) -> PairStatus:
        """Result of the verification; the first row that applies:

        =========  ===================================================
        aligned    there are no issues: it passed verification
        predicted  the mapping is a prediction with a standard error
        seed_only  the mapping is that of the seed, which is usable
        failed     otherwise; the mapping is that of the seed
        =========  ===================================================
        """
        if not self.issues:
            return "aligned"
        if self.prediction is not None:
            return "predicted"
        return "seed_only" if self.is_seed_usable else "failed"

    def map(self, reference_px: "ArrayLike") -> Points:
        """Map positions in the reference to positions in the moving image.

        Parameters
        ----------
        reference_px
            (..., 2): x and y, raw px of the reference; (0, 0) is the centre of the top-left pixel.

        Returns
        -------
        array
            (..., 2), float64: x and y, raw px of the moving image.

        Raises
        ------
        InputError
            `reference_px` is not an array (..., 2) of numbers.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.map([[0, 0], [100, 60]]).round()
        array([[  8.,   8.],
               [108.,  68.]])
        """
        return self.mapping(positions_of(reference_px, "reference_px"))

    def inverse(self, moving_px: "ArrayLike") -> Points:
        """Map positions in the moving image to positions in the reference.

        Parameters
        ----------
        moving_px
            (..., 2): x and y, raw px of the moving image; (0, 0) is the centre of the top-left pixel.

        Returns
        -------
        array
            (..., 2), float64: x and y, raw px of the reference, to 0.001 px; NaN where the iteration diverges. Where
            parallax occludes a part of the scene, it is one of several solutions.

        Raises
        ------
        InputError
            `moving_px` is not an array (..., 2) of numbers.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.inverse(result.map([100, 60])).round(2)
        array([100.,  60.])
        """
        return self.mapping.inverse(positions_of(moving_px, "moving_px"))

    @checked
    def warp(
        self,
        moving: "ArrayLike",
        *,
        valid: "ArrayLike | None" = None,
        nodata: float | None = None,
        interpolation: Interpolation = "lanczos",
    ) -> tuple[NDArray[np.generic], Mask]:
        """Resample the moving image to the grid of the reference.

        Parameters
        ----------
        moving
            Image, (H, W), (H, W, C) or (C, H, W), of any numeric type and the size of the aligned moving image.
        valid
            (H, W), False for pixels that must not be used. NaN, `nodata` and masked pixels are never used.
        nodata
            Value of unknown pixels in the input and the output. By default NaN or, for integers, 0 in the output.
        interpolation
            `nearest`, `bilinear`, `cubic` or `lanczos`.

        Returns
        -------
        pixels
            The resampled image, in the layout and type of `moving`.
        known
            (height, width) of the reference: True where all channels are known, inside the moving image and not
            occluded.

        Raises
        ------
        InputError
            `moving` is not an image or has a different size, or its type cannot hold `nodata`.

        Examples
        --------
        `green`, `nir` and `result` are those of the example of `align`.

        >>> nir_on_green, known = result.warp(nir)
        >>> nir_on_green.shape == green.shape
        True
        >>> bool(np.corrcoef(nir_on_green[known], green[known])[0, 1] < -0.99)  # reversed contrast
        True
        """
        planes, channels_last = planes_of(moving, "moving")
        if self.moving_size_px not in (None, planes.shape[:0:-1]):
            given, aligned = (f"{width} x {height} px" for width, height in (planes.shape[:0:-1], self.moving_size_px))
            raise InputError(f"moving has {given}, the aligned image {aligned}; give an image of that size")
        mask = valid_of(moving, valid, (planes.shape[1], planes.shape[2]))
        for plane in planes:
            mask = mask & (np.isfinite(plane) if plane.dtype.kind == "f" else True) & (plane != nodata)
        fill = nodata if nodata is not None else math.nan if planes.dtype.kind == "f" else 0
        if not can_hold(planes.dtype, fill):
            raise InputError(f"nodata is {nodata:g}, which {planes.dtype} cannot hold")
        pixels, known = resample_planes(planes, mask, self.mapping, self.size_px, interpolation, fill)
        if np.ndim(moving) == 2:
            return pixels[0], known
        return (np.moveaxis(pixels, 0, -1) if channels_last else pixels), known

    @property
    def fixed_to_moving(self) -> Matrix:
        """The homography of the mapping, between undistorted pixels if both lenses are known, else between raw ones.

        It is the complete mapping only if there are no lenses, displacement field and relief: use `warp` and `map`.
        """
        return self.mapping.fixed_to_moving

    @property
    def seed_mapping(self) -> PixelMapping:
        """The mapping of the seed, with the lenses and without displacements."""
        return PixelMapping(self.seed.fixed_to_moving, self.mapping.fixed_lens, self.mapping.moving_lens)

    @property
    def geometry(self) -> Geometry:
        """What the mapping has in addition to the homography and the lenses of the tags."""
        if self.mapping.parallax is not None:
            return "relief" if self.mapping.field is None else "relief and field"
        return "homography" if self.mapping.field is None else "field"

    @property
    def space(self) -> Space:
        """The pixels that the homography maps: raw (`pixel`) or undistorted ones."""
        return "pixel" if self.mapping.fixed_lens is None else "undistorted"

    def in_file_px(self: "Alignment", scales: "PairScales", size_px: Size) -> "Alignment":
        """The same between the files of the two bands; `size_px` is (width, height) of the reference's file.

        A displacement field gets a lattice on the file, as a sidecar has it.
        """
        up = scales.fixed.inverse
        mapping = self.mapping.rescaled(up, scales.moving.inverse)
        if mapping.field is not None:
            field = mapping.field.on_lattice(mapping.field.step_px / mapping.field.scale.mean, size_px)
            mapping = replace(mapping, field=field)
        return replace(
            self,
            mapping=mapping,
            size_px=size_px,
            seed=replace(self.seed, fixed_to_moving=scales.between_files(self.seed.fixed_to_moving)),
            joint=None if self.joint is None else self.joint.in_file_px(scales),
            residual=None if self.residual is None else self.residual.in_file_px(scales),
            lens_std_px=None if self.lens_std_px is None else self.lens_std_px * up.mean,
            relief_std_px=self.relief_std_px * up.mean,
            candidates={kind: float(p95_px * up.mean) for kind, p95_px in self.candidates.items()},
        )

    @property
    def reason(self) -> str | None:
        """Why the band is not aligned; None if it is."""
        text = sentence(self.issues[0]) if self.issues else None
        if text is None or self.status == "aligned":
            return None
        if self.status == "predicted" and self.prediction is not None:
            sources: dict[PredictionSource, str] = {
                "bands": "the capture's other bands",
                "neighbours": "the captures around it",
                "flight": "the flight's mean",
                "windows": "windows in the image",
            }
            source, std_px = sources[self.prediction.source], self.prediction.std_px
            return f"{text}; predicted from {source}, standard error {std_px:.2f} px"
        if self.status == "seed_only":
            return f"{text}; the {self.seed.kind} seed is used unchanged"
        if self.issues[-1].kind == SEED_DOES_NOT_FIT:
            return f"{text}; the {self.seed.kind} seed is used unchanged, {sentence(self.issues[-1])}"
        return text

    def __repr__(self) -> str:
        """One line without the arrays; its names are attributes."""
        residual = "" if self.residual is None else f", residual.median_px={self.residual.median_px:.3g}"
        std = "" if self.joint is None else f", joint.corner_std_px={self.joint.corner_std_px:.3g}"
        reason = "" if self.reason is None else f", reason={self.reason!r}"
        return f"Alignment(status={self.status!r}{residual}{std}{reason})"


Alignments = dict[str, Alignment]
"""Alignments between images by band."""
