"""The reference image of a capture, with cached data for the seeds, checks and metrics of all bands, and its size."""

from dataclasses import replace
from functools import cached_property

from agalign.fit.displacement_field import DisplacementEstimator
from agalign.fit.windows import (
    LARGE_WINDOW_PX,
    MIN_WINDOW_PX,
    RELIEF_CHECK_WINDOW_PX,
    RELIEF_FIT_WINDOW_PX,
    FixedWindows,
)
from agalign.pixels.band_resampling import channel_mean, shrink, textured
from agalign.pixels.landmarks import LandmarkInput, Landmarks, landmarks
from agalign.pixels.structure import Field, blur_px, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.pixel_units import PixelScale
from agalign.verify.similarity import FixedSimilarity

LONGEST_SIDE_PX = 2700
"""Larger images are reduced to this for estimation, which limits memory and time; `full_resolution` refines the result.
The bands of most cameras have fewer pixels (2592 on the Mavic 3M)."""
COARSE_RATIO = 0.4
"""A moving band is coarse if its magnification relative to the reference is smaller than this; the reference is reduced
for it."""


class Reference:
    """The reference image; its structure, spectrum, windows and statistics are computed on first use."""

    def __init__(self, image: Raster) -> None:
        self.image = image
        self._landmarks: dict[LandmarkInput, Landmarks] = {}

    @cached_property
    def grey(self) -> Raster:
        """The mean of the image's channels, (H, W)."""
        return channel_mean(self.image)

    @cached_property
    def raw(self) -> Raster:
        """The image without its lens model, for pairs that are not undistorted."""
        return replace(self.image, lens=None)

    @cached_property
    def is_textured(self) -> bool:
        """False if the image is constant or invalid."""
        return textured(self.image)

    # ---- for seeds

    @cached_property
    def seed_size_px(self) -> tuple[int, int]:
        """(width, height) of the reduced images on which seeds are scored."""
        width, height = self.image.size_px
        longest_px = 384  # large shifts are found quickly at this resolution
        scale = min(1.0, longest_px / max(width, height))
        return max(8, round(width * scale)), max(8, round(height * scale))

    @cached_property
    def seed_scale(self) -> PixelScale:
        """Scale of the reduced images relative to the image."""
        return PixelScale.between(self.image.size_px, self.seed_size_px)

    @cached_property
    def seed_spectrum(self) -> Field:
        """(height, width) windowed spectrum of the structure field of the reduced image, packed as by `cv2.dft`."""
        return windowed_spectra(structure_field(shrink(self.grey, self.seed_size_px)))

    def landmarks(self, source: LandmarkInput) -> Landmarks:
        """Return SIFT landmarks of the image or its edges, raw px."""
        if source not in self._landmarks:
            self._landmarks[source] = landmarks(self.image, source)
        return self._landmarks[source]

    # ---- for checks and metrics

    @cached_property
    def structure(self) -> Field:
        """(height, width) structure field of the image."""
        return structure_field(self.grey)

    @cached_property
    def windows(self) -> FixedWindows:
        """Windows for the verification of an alignment."""
        return FixedWindows(self.grey.valid, self.structure)

    @cached_property
    def large_windows(self) -> FixedWindows:
        """Larger windows, for blurred images."""
        return FixedWindows(self.grey.valid, self.structure, LARGE_WINDOW_PX)

    @cached_property
    def blur_px(self) -> float:
        """Length at which the image varies."""
        return blur_px(self.grey)

    @cached_property
    def overlapping_windows(self) -> FixedWindows:
        """Windows of the same size with an overlap of one half, for images with few pixels."""
        return FixedWindows(self.grey.valid, self.structure, self.windows.side, self.windows.side // 2)

    @cached_property
    def small_windows(self) -> FixedWindows:
        """Windows for images with small valid areas."""
        return FixedWindows(self.grey.valid, self.structure, MIN_WINDOW_PX)

    @cached_property
    def tie_windows(self) -> FixedWindows:
        """Windows of the size of those that verify a relief, over the whole image."""
        return FixedWindows(self.grey.valid, self.structure, RELIEF_CHECK_WINDOW_PX)

    @cached_property
    def displacement_field(self) -> DisplacementEstimator:
        """Estimator of displacement fields."""
        return DisplacementEstimator(self.grey.valid, self.structure)

    @cached_property
    def relief_fit_windows(self) -> FixedWindows:
        """Windows in the black fields of a chessboard, for the fit of planes and baselines."""
        return FixedWindows.on_chessboard(self.grey.valid, self.structure, RELIEF_FIT_WINDOW_PX, white=False)

    @cached_property
    def relief_check_windows(self) -> FixedWindows:
        """Windows in the white fields, for the verification of a fit to the black ones."""
        return FixedWindows.on_chessboard(
            self.grey.valid, self.structure, RELIEF_CHECK_WINDOW_PX, white=True, min_valid_share=0.9
        )

    @cached_property
    def similarity(self) -> FixedSimilarity:
        """Histogram bins and gradients for the similarity metrics."""
        return FixedSimilarity(self.grey)


def longest_for(size_px: tuple[int, int], fixed_to_moving: Matrix) -> int:
    """Return the longer side, px, to which a reference (width, height) is reduced for a moving band.

    It is less than LONGEST_SIDE_PX for a band with much larger pixels, as of a thermal camera.
    """
    ratio = geometry.magnification(fixed_to_moving, *size_px)
    if not 0 < ratio < COARSE_RATIO:
        return LONGEST_SIDE_PX
    oversampling = 2.0  # along a line; more pixels of the reference add no common detail
    min_side_px = 128  # required by the windows
    side_px = round(oversampling * ratio * max(size_px))
    return min(LONGEST_SIDE_PX, max(side_px, min_side_px))


def is_coarse(size_px: tuple[int, int], fixed_to_moving: Matrix) -> bool:
    """Return True if a reference (width, height) is reduced for a moving band, which has much larger pixels."""
    return longest_for(size_px, fixed_to_moving) < min(LONGEST_SIDE_PX, max(size_px))
