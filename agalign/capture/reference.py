"""The reference image of a capture, and what seeds, checks and metrics of all bands need of it, worked out once."""

from dataclasses import replace
from functools import cached_property

from agalign.config import LocalScale, Settings
from agalign.pixels.grey import channel_mean
from agalign.pixels.landmarks import LandmarkInput, Landmarks, landmarks
from agalign.pixels.resample import shrink, textured
from agalign.pixels.structure import Field, structure_field, windowed_spectra
from agalign.values.image import Raster
from agalign.verify.displacement_field import DisplacementEstimator
from agalign.verify.metrics import FixedSimilarity
from agalign.verify.residuals import FixedWindows


class Reference:
    """The reference image, and on demand its structure, spectrum, windows and statistics."""

    def __init__(self, image: Raster, settings: Settings) -> None:
        self.image = image
        self.settings = settings
        self._landmarks: dict[LandmarkInput, Landmarks] = {}

    @cached_property
    def grey(self) -> Raster:
        """(H, W): the image or the mean of its channels."""
        return channel_mean(self.image)

    @cached_property
    def raw(self) -> Raster:
        """The image without its lens model, for bands beside which it is not to be corrected."""
        return replace(self.image, lens=None)

    @cached_property
    def is_textured(self) -> bool:
        """False where there is nothing in the image to align."""
        return textured(self.image)

    # ---- for seeds

    @cached_property
    def seed_size_px(self) -> tuple[int, int]:
        """(width, height) at which seeds are scored."""
        width, height = self.image.size_px
        scale = min(1.0, self.settings.seed.working_px / max(width, height))
        return max(8, round(width * scale)), max(8, round(height * scale))

    @cached_property
    def seed_scale(self) -> tuple[float, float]:
        """The same relative to the image, (x, y)."""
        return self.seed_size_px[0] / self.image.size_px[0], self.seed_size_px[1] / self.image.size_px[1]

    @cached_property
    def seed_spectrum(self) -> Field:
        """Windowed spectrum of the structure at that size."""
        small = shrink(self.grey, self.seed_size_px)
        return windowed_spectra(structure_field(small, self.settings.seed.smoothing_px))

    def landmarks(self, source: LandmarkInput) -> Landmarks:
        """What is recognised however a moving image is turned, raw px."""
        if source not in self._landmarks:
            self._landmarks[source] = landmarks(self.image, source)
        return self._landmarks[source]

    # ---- for checks and metrics

    @cached_property
    def structure(self) -> Field:
        """At full resolution."""
        return structure_field(self.grey, self.settings.check.smoothing_px)

    @cached_property
    def windows(self) -> FixedWindows:
        """Those in which an alignment is checked."""
        return FixedWindows(self.grey.valid, self.structure, self.settings.check)

    @cached_property
    def local(self) -> DisplacementEstimator:
        """Smaller ones, which local displacements are fitted to."""
        return self._local_at(self.settings.local.scale)

    @cached_property
    def finer_local(self) -> DisplacementEstimator:
        """The smallest."""
        return self._local_at(self.settings.local.finer_scale)

    def _local_at(self, scale: LocalScale) -> DisplacementEstimator:
        return DisplacementEstimator(self.grey.valid, self.structure, self.settings.local, self.settings.check, scale)

    @cached_property
    def similarity(self) -> FixedSimilarity:
        """Histogram positions and smoothed gradients."""
        return FixedSimilarity(self.grey)
