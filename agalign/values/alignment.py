"""Results of aligning a band pair, and their uncertainty."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray  # the former in quotes: help() prints its name, not 1,000 characters
from pydantic import Field
from pydantic import dataclasses as validated

from agalign.errors import InputError
from agalign.values.arguments import checked
from agalign.values.choices import Geometry, Interpolation, ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.fields import RECORD, Matrix3x3, Measured, Number, Number4, UpToInfinity, equal
from agalign.values.geometry import Matrix, PairScales, Points, magnification
from agalign.values.image import FloatImage, Mask, Tile
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue, sentence
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import ErrorOnGrid, MappingError
from agalign.values.parallax import Relief
from agalign.values.pixel_units import Size
from agalign.values.resampling import can_hold, planes_of, positions_of, resample_planes, valid_of
from agalign.values.residual import Residual, Similarity

COVARIANCE_DECIMALS = 9
"""Of covariances in a sidecar, px squared: a millionth of those of accurate mappings."""
STD_DECIMALS = 4
"""Of standard errors: a limit of them holds for what is written."""
_SAME_PIXEL_SIZE = 0.1
"""Relative difference between the pixels of band and reference up to which an error in words is one number: bands of
one resolution differ by less, thermal and panchromatic bands by more."""
MIN_RETRIEVAL = 0.2
"""Minimum held-out retrieval: below it psi is not updated, and only windows that no fit used confirm a result. Chance
is below 0.01; unrelated images reach 0.05."""
MIN_TIMES_CHANCE = 5.0
"""`MIN_RETRIEVAL` as a multiple of chance, which is high where few keypoints can be drawn."""
BY_WINDOWS = "windows"
"""Recipe of a result that is fitted to windows; its residual contains the windows that were left out of the fit."""


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
    """`user`; `match` (SIFT keypoints; with `--seed match` learned descriptors); `model` (mapping of the
    flight); `rig` (camera tags); `centre` (optical centres of DJI); `geo` (geotransforms); `structure` (phase
    correlation); `identity`."""
    fixed_to_moving: Matrix3x3
    """Homography (3, 3) from the reference to the moving image: between undistorted px if both lenses are known, else
    between raw px."""
    score: Number
    """Correlation at this mapping, in standard deviations; 0 if it replaced a seed that contradicts it."""
    peak_sigma: Number = 0.0
    """The same as `score`; 0 without a correlation."""
    runner_up_sigma: Number = 0.0
    """Height of the second highest separate peak, in standard deviations."""
    trusted: bool = False
    """The images have a clear correlation peak there, which shows the shift of the centre rather than that of the
    corners, or windows confirm it; or it is that of tags or flight and replaced a seed that contradicts it."""


@validated.dataclass(frozen=True, config=RECORD)
class JointResult:
    """Estimate from descriptors, windows, other bands and rig; from the other three where descriptors fail.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> joint = result.joint
    >>> joint.recipe, joint.model_family, joint.retrieval > 10 * joint.chance
    ('fast', 'homography', True)
    >>> joint.min_retrieval, joint.is_retrieved
    (0.2, True)
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
    """Resolutions of the image pyramid by which the mapping was optimised with the network; 1 is full."""
    recipe: str
    """`flight` (frozen network of the flight), `fast` or `scratch` (learned on this capture), `paper`, or `windows`
    (without descriptors)."""
    model_family: ModelFamily
    """Kind of mapping that was fitted to the descriptors; windows may make it a homography."""
    last_step_px: Number
    """Movement of a corner in the last step."""
    corner_std_xy_px: Annotated[tuple[tuple[UpToInfinity, UpToInfinity], ...], Field(min_length=4, max_length=4)]
    """Standard errors (x, y) at the corners of the reference, clockwise from the top left, px."""
    corner_covariance_px2: Annotated[NDArray[np.float64] | None, Field(exclude=True)] = None
    """Covariance of the corners of a homography, also if a simpler family was fitted; a sidecar has that of the
    mapping, in `error`."""
    by_images: Annotated["JointResult | None", Field(exclude=True)] = None
    """The estimate without the rig, if this one contains the rig: with it, other bands are predicted. A sidecar does
    not have it."""

    @property
    def corner_std_px(self) -> float:
        """Standard error of the mapping at the least certain corner: root mean square distance, of x and y together."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)

    @property
    def min_retrieval(self) -> float:
        """The retrieval of held-out patches from which the descriptors distinguish them; above 1 if few are visible."""
        return max(MIN_RETRIEVAL, MIN_TIMES_CHANCE * self.chance)

    @property
    def is_retrieved(self) -> bool:
        """True if the mapping is by descriptors that distinguish held-out patches."""
        return self.recipe != BY_WINDOWS and self.retrieval >= self.min_retrieval

    @property
    def covariance_px2(self) -> NDArray[np.float64]:
        """The covariance (8, 8) of the corners, or their variances alone where only these are known."""
        if self.corner_covariance_px2 is not None:
            return self.corner_covariance_px2
        return np.diag(np.square(np.ravel(self.corner_std_xy_px)))

    def with_homography(self, fixed_to_moving: Matrix, covariance_px2: NDArray[np.float64]) -> "JointResult":
        """Return the result of images with another homography and covariance (8, 8) of the corners."""
        std = tuple((float(x), float(y)) for x, y in np.sqrt(np.diag(covariance_px2)).reshape(4, 2))
        return replace(
            self,
            fixed_to_moving=fixed_to_moving,
            corner_covariance_px2=covariance_px2,
            corner_std_xy_px=std,
            by_images=None,
        )

    def in_file_px(self, scales: PairScales) -> "JointResult":
        """Convert the result between the images to one between the files."""
        up = scales.fixed.inverse
        per_axis = np.outer(np.tile(up, 4), np.tile(up, 4))
        return replace(
            self,
            fixed_to_moving=scales.between_files(self.fixed_to_moving),
            last_step_px=self.last_step_px * up.mean,
            corner_std_xy_px=tuple((x * up.x, y * up.y) for x, y in self.corner_std_xy_px),
            corner_covariance_px2=None if self.corner_covariance_px2 is None else self.corner_covariance_px2 * per_axis,
            by_images=None,
        )


@validated.dataclass(frozen=True, config=RECORD)
class Prediction:
    """Mapping of a band by the rig of the flight, or by windows that do not confirm it everywhere.

    Examples
    --------
    `Alignment.prediction` is one. Indices use a predicted band if its expected error is small enough:

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
    """Standard error: RMS of the expected error over the common area, px of the band."""
    off_px: Number4 | None = None
    """RMS distance from the band's own alignment, px of the band."""


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
    >>> result.std_px < 0.2, result.std_band_px < 0.2, result.error_map_px.shape  # px of the reference, of the band
    (True, True, (200, 200))
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
    """The band's own estimate with its expected error; None without one."""
    residual: Residual | None = None
    """Shifts of windows, each under a mapping that was estimated without the window (with a displacement field, under
    the field without the window); of all windows under a seed or a prediction of the rig."""
    seconds: float = 0.0
    """Share of the capture's processing time, s, equal for all its bands."""
    before: Similarity = field(default_factory=Similarity)
    """Measures of similarity of the images as they are, their borders overlaid."""
    after: Similarity = field(default_factory=Similarity)
    """The same under the mapping."""
    held_out_p95_px: Mapping[Geometry, float] = field(default_factory=dict)
    """p95 of the shifts of held-out windows by each geometry that was fitted; empty if only a homography was."""
    prediction: Prediction | None = None
    """Prediction of the mapping, by the rig of the flight or by windows. With `issues` it is the mapping; without, the
    mapping has been compared with it. None if there is no prediction."""
    is_seed_usable: bool = False
    """The mapping is that of the seed, which is trusted or requested, and which fits the windows."""
    error: MappingError | None = None
    """What the error of the mapping is made of; None for `seed_only` and `failed`, whose error is unknown."""
    std_px: float = math.inf
    """Standard error: the RMS of `error_px` over the area that both images show, px of the reference; infinite if it is
    unknown. The shifts of areas that moved (`error.moved`) are no part of it."""
    moving_size_px: Size | None = None
    """(width, height) of the moving image; None if it is not known, as in sidecars of earlier versions."""

    @property
    def status(self) -> PairStatus:
        """Result of the verification; the first row that applies:

        =========  ===================================================
        aligned    there are no issues: it passed verification
        predicted  the mapping is a prediction with an expected error
        seed_only  the mapping is that of the seed, which is usable
        failed     otherwise; the mapping is that of the seed
        =========  ===================================================
        """
        if not self.issues:
            return "aligned"
        if self.prediction is not None:
            return "predicted"
        return "seed_only" if self.is_seed_usable else "failed"

    @property
    def std_band_px(self) -> float:
        """The expected error in px of the moving image: for a thermal band, whose pixels are larger than those of the
        reference, a smaller number than `std_px`. `prediction.std_px` of a predicted band.
        """
        if self.status == "predicted" and self.prediction is not None:
            return self.prediction.std_px
        return self.std_px * magnification(self.fixed_to_moving, *self.size_px)

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
            (H, W), False, 0 or NaN for pixels that must not be used. NaN, `nodata` and masked pixels are never used.
        nodata
            Value of unknown pixels in the input and the output. By default NaN or, for integers, 0 in the output.
        interpolation
            `nearest`, `bilinear`, `cubic` or `lanczos`.

        Returns
        -------
        pixels
            The resampled image, in the layout and type of `moving`.
        valid
            (height, width) of the reference: True where all channels have a value, inside the moving image and not
            occluded.

        Raises
        ------
        InputError
            `moving` is not an image or has a different size, or its type cannot hold `nodata`.

        Examples
        --------
        `green`, `nir` and `result` are those of the example of `align`.

        >>> nir_on_green, valid = result.warp(nir)
        >>> nir_on_green.shape == green.shape
        True
        >>> bool(np.corrcoef(nir_on_green[valid], green[valid])[0, 1] < -0.99)  # reversed contrast
        True
        """
        planes, channels_last = planes_of(moving, "moving")
        if self.moving_size_px not in (None, planes.shape[:0:-1]):
            given, aligned = (f"{width} x {height} px" for width, height in (planes.shape[:0:-1], self.moving_size_px))
            raise InputError(f"moving has {given}, the aligned image {aligned}; give an image of that size")
        fill = nodata if nodata is not None else math.nan if planes.dtype.kind == "f" else 0
        if not can_hold(planes.dtype, fill):
            raise InputError(f"nodata is {nodata:g}, which {planes.dtype} cannot hold")
        mask = valid_of(moving, valid, (planes.shape[1], planes.shape[2]))
        for plane in planes:
            mask = mask & (np.isfinite(plane) if plane.dtype.kind == "f" else True) & (plane != nodata)
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
    def geometry(self) -> Geometry:
        """What the mapping has in addition to the homography and the lenses of the tags."""
        if self.mapping.parallax is not None:
            return "relief" if self.mapping.field is None else "relief and field"
        return "homography" if self.mapping.field is None else "field"

    @property
    def space(self) -> Space:
        """The pixels that the homography maps: raw (`pixel`) or undistorted ones."""
        return "pixel" if self.mapping.fixed_lens is None else "undistorted"

    def error_px(self, reference_px: "ArrayLike") -> NDArray[np.float64]:
        """Return the expected error at positions in the reference.

        `std_px` is its RMS over the area that both images show, without the shifts of areas that moved (`error.moved`);
        the limits of `aligned`, the error map and the quality flags are limits of it.

        Parameters
        ----------
        reference_px
            (..., 2): x and y, raw px of the reference; (0, 0) is the centre of the top-left pixel.

        Returns
        -------
        array
            (...), float64: RMS distance of mapped from true positions, px of the reference; infinite where it is
            unknown, as in bands that are `seed_only` or `failed`, and for NaN, as `inverse` returns it.

        Raises
        ------
        InputError
            `reference_px` are not positions.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> at_centre, at_corner = result.error_px([[100, 100], [0, 0]])
        >>> bool(0 < at_centre < 0.2), bool(at_corner < 0.5)
        (True, True)
        """
        points_px = positions_of(reference_px, "reference_px")
        errors_px = np.full(points_px.shape[:-1], np.inf)
        if self.error is not None:
            is_known = np.isfinite(points_px).all(axis=-1)
            errors_px[is_known] = self.error.error_px(points_px[is_known])
        return errors_px

    @property
    def error_map_px(self) -> FloatImage:
        """The expected error at every pixel of the reference: (height, width), float32.

        It is `error_px`, but for the parts of the parallax and of what moved at nodes every 16 px, between which it is
        linear.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.error_map_px.shape, bool((result.error_map_px < 0.5).mean() > 0.9)
        ((200, 200), True)
        """
        if self.error is None:
            return np.full(self.size_px[::-1], np.inf, np.float32)
        return ErrorOnGrid.of(self.error, self.size_px).on_tile(Tile(0, 0, *self.size_px))

    @checked
    def is_usable(self, accept_predicted_px: float) -> bool:
        """Return True if the band is aligned, or predicted with a small expected error.

        Parameters
        ----------
        accept_predicted_px
            Largest expected error of a prediction, px of the band, such as `CheckSettings.accept_predicted_px`.

        Returns
        -------
        bool
            True for a band that indices use.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.is_usable(1.0)
        True
        """
        return is_usable(self.status, self.prediction, accept_predicted_px)

    def in_file_px(self, scales: PairScales, size_px: Size) -> "Alignment":
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
            error=None if self.error is None else self.error.in_file_px(scales, size_px, mapping.parallax),
            std_px=self.std_px * up.mean,
            held_out_p95_px={kind: float(p95_px * up.mean) for kind, p95_px in self.held_out_p95_px.items()},
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
            error = in_both_px(self.std_px, self.std_band_px)
            return f"{text}; predicted from {sources[self.prediction.source]}, expected error {error}"
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


def is_usable(status: PairStatus, prediction: Prediction | None, accept_predicted_px: float) -> bool:
    """Return True for the reference, an aligned band, or a predicted one with an expected error of at most
    `accept_predicted_px`, px of the band: the one definition of a delivered band.

    The limit also holds in px of the coarser of band and reference, which is what their combination resolves: a band
    with larger pixels than the reference is itself the coarser; in a band with smaller ones, a px is less.
    """
    if status == "predicted":
        return prediction is not None and prediction.std_px <= accept_predicted_px
    return status in ("reference", "aligned")


def has_same_pixel_size(std_px: float, std_band_px: float) -> bool:
    """Return True if the pixels of the reference and of a band have the same size to 10 %, given an error in both."""
    return abs(std_band_px - std_px) <= _SAME_PIXEL_SIZE * std_px


def in_both_px(std_px: float, std_band_px: float) -> str:
    """Return an error in words, given in px of the reference and of the band: one number if their pixels are equal."""
    if has_same_pixel_size(std_px, std_band_px):
        return f"{std_band_px:.2f} px"
    return f"{std_px:.2f} px of the reference ({std_band_px:.2f} px of the band)"


Alignments = dict[str, Alignment]
"""Alignments between images by band."""


def relief_of(alignments: Mapping[str, Alignment]) -> Relief | None:
    """Return the relief of a capture; None if no band is displaced by one."""
    return next((a.mapping.parallax.relief for a in alignments.values() if a.mapping.parallax is not None), None)
