"""A band with a result, as the estimation compares and verifies it."""

import math
from dataclasses import dataclass

from agalign.capture.band_pair import BandPair
from agalign.capture.warped_pair import WarpedPair
from agalign.values.alignment import JointResult, Residual, Seed
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.checks import BY_WINDOWS


@dataclass(frozen=True)
class Candidate:
    """A band with a result of the joint optimisation and the residual of its windows."""

    pair: BandPair
    seed: Seed
    joint: JointResult[FixedImagePx]
    warped: WarpedPair
    by_halves: tuple[Matrix, Matrix] | None = None
    """Homographies from half of the windows (`WarpedPair.cross_validated`)."""

    @classmethod
    def of(cls, pair: BandPair, seed: Seed, joint: JointResult[FixedImagePx]) -> "Candidate":
        """Measure the windows with the homography of a result."""
        return cls(pair, seed, joint, WarpedPair.of(pair, pair.mapping(joint.fixed_to_moving)))

    @classmethod
    def at_seed(cls, pair: BandPair, seed: Seed) -> "Candidate":
        """Return a band without a result: with the mapping of its seed, and without evidence of descriptors."""
        matrix = seed.fixed_to_moving
        joint = JointResult[FixedImagePx](
            matrix, math.nan, 0.0, 0.0, 0, (1.0,), BY_WINDOWS, "homography", 0.0, ((math.inf, math.inf),) * 4
        )
        return cls.of(pair, seed, joint)

    def fit_residual(self, mapping: PixelMapping) -> Residual[FixedImagePx]:
        """Measure the windows of the fit with a mapping."""
        return self.pair.reference.black_windows.residuals(self._warped(mapping))

    def held_out_residual(self, mapping: PixelMapping) -> Residual[FixedImagePx]:
        """Measure the windows that take no part in the fit."""
        return self.pair.reference.white_windows.residuals(self._warped(mapping))

    def _warped(self, mapping: PixelMapping) -> Raster:
        return self.warped.warped if mapping is self.warped.mapping else self.pair.warped_moving(mapping)
