"""The reference image of a capture, with everything that seeds, checks and metrics of all bands need, computed once."""

from dataclasses import replace
from functools import cached_property

from agalign.pixels.grey import channel_mean
from agalign.pixels.landmarks import LandmarkInput, Landmarks, landmarks
from agalign.pixels.resample import shrink, textured
from agalign.pixels.structure import Field, structure_field, windowed_spectra
from agalign.values.image import Raster
from agalign.values.pixel_units import PixelScale
from agalign.verify.displacement_field import COARSE, FINE, LENS, DisplacementEstimator
from agalign.verify.metrics import FixedSimilarity
from agalign.verify.residuals import FixedWindows

_SEED_LONGEST_PX = 384
"""Longer side of the images on which seeds are scored: shifts of a third of the image are found, and it is quick."""

_FIT_PX = LENS.window_px
"""Side of the windows in which planes and baselines are fitted: small enough to be on one surface."""
_HELD_OUT_PX = 64
"""Side of the windows that verify a relief: larger ones have less noise in their shifts."""
_SMALL_WINDOW_PX = 32
"""Side of windows between saturated spots: the smallest with a plain correlation peak."""


class Reference:
    """The reference image, and on demand its structure, spectrum, windows and statistics."""

    def __init__(self, image: Raster) -> None:
        self.image = image
        self._landmarks: dict[LandmarkInput, Landmarks] = {}

    @cached_property
    def grey(self) -> Raster:
        """(H, W): the image or the mean of its channels."""
        return channel_mean(self.image)

    @cached_property
    def raw(self) -> Raster:
        """The image without its lens model, for pairs that are not undistorted."""
        return replace(self.image, lens=None)

    @cached_property
    def is_textured(self) -> bool:
        """False where the image is constant or invalid."""
        return textured(self.image)

    # ---- for seeds

    @cached_property
    def seed_size_px(self) -> tuple[int, int]:
        """(width, height) of the reduced images on which seeds are scored."""
        width, height = self.image.size_px
        scale = min(1.0, _SEED_LONGEST_PX / max(width, height))
        return max(8, round(width * scale)), max(8, round(height * scale))

    @cached_property
    def seed_scale(self) -> PixelScale:
        """Scale of these relative to the image."""
        return PixelScale.between(self.image.size_px, self.seed_size_px)

    @cached_property
    def seed_spectrum(self) -> Field:
        """Windowed spectrum of the structure at that size."""
        return windowed_spectra(structure_field(shrink(self.grey, self.seed_size_px)))

    def landmarks(self, source: LandmarkInput) -> Landmarks:
        """Keypoints that are recognised in a rotated or scaled moving image, raw px."""
        if source not in self._landmarks:
            self._landmarks[source] = landmarks(self.image, source)
        return self._landmarks[source]

    # ---- for checks and metrics

    @cached_property
    def structure(self) -> Field:
        """At full resolution."""
        return structure_field(self.grey)

    @cached_property
    def windows(self) -> FixedWindows:
        """The windows in which an alignment is verified."""
        return FixedWindows(self.grey.valid, self.structure)

    @cached_property
    def overlapping_windows(self) -> FixedWindows:
        """The same, each overlapping the next by a half: of an image with few pixels more of them show something."""
        return FixedWindows(self.grey.valid, self.structure, self.windows.side, self.windows.side // 2)

    @cached_property
    def small_windows(self) -> FixedWindows:
        """Windows for images with valid areas that are too small for those."""
        return FixedWindows(self.grey.valid, self.structure, _SMALL_WINDOW_PX)

    @cached_property
    def local(self) -> DisplacementEstimator:
        """Smaller windows, to which displacement fields are fitted."""
        return DisplacementEstimator(self.grey.valid, self.structure, COARSE)

    @cached_property
    def finer_local(self) -> DisplacementEstimator:
        """The smallest windows."""
        return DisplacementEstimator(self.grey.valid, self.structure, FINE)

    @cached_property
    def fit_windows(self) -> FixedWindows:
        """Windows in the black fields of a chessboard, in which planes and baselines are fitted."""
        return FixedWindows.on_chessboard(self.grey.valid, self.structure, _FIT_PX, white=False)

    @cached_property
    def lens_field(self) -> DisplacementEstimator:
        """Fits what lenses leave in the same windows."""
        return DisplacementEstimator(self.grey.valid, self.structure, LENS, self.fit_windows)

    @cached_property
    def held_out_windows(self) -> FixedWindows:
        """Windows of another size in the white fields, which verify what was fitted in the black ones."""
        return FixedWindows.on_chessboard(self.grey.valid, self.structure, _HELD_OUT_PX, white=True)

    @cached_property
    def similarity(self) -> FixedSimilarity:
        """Histogram positions and smoothed gradients."""
        return FixedSimilarity(self.grey)
