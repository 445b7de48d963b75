"""A band pair on one grid: the moving image under a mapping, and the residual of its windows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.fit.held_out import chessboard, held_out
from agalign.fit.windows import FixedWindows, centred_correlation, residual_under
from agalign.pixels.band_resampling import shrink
from agalign.pixels.structure import Field, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster
from agalign.values.issues import Issue
from agalign.values.mapping import PixelMapping
from agalign.values.residual import Residual
from agalign.verify.checks import (
    AliasPeak,
    Layer,
    alias_peaks,
    content_issues,
    layer_issues,
    repetition_issues,
    second_layer,
)
from agalign.verify.coverage import points_in_frame, points_in_mask, unobserved_quarters


@dataclass(frozen=True)
class WarpedPair:
    """A pair with the warped moving image and the residual of its windows."""

    pair: BandPair
    mapping: PixelMapping
    warped: Raster
    """The moving image, one channel, on the grid of the reference; of a nearly equal mapping after `with_mapping`."""
    windows: FixedWindows
    residual: Residual
    """Of these windows, under the mapping or, if it is cross-validated, under the estimates without each of them."""
    cross: Field | None = None
    """Sum of cross spectra of these windows under the warped image; None if they were not correlated here."""

    @classmethod
    def of(cls, pair: BandPair, mapping: PixelMapping, windows: FixedWindows | None = None) -> "WarpedPair":
        """Warp the moving image and measure the residual of `windows`.

        By default these are those of the pair, or small ones if these are measured in more quarters of the overlap. A
        fit and its verification must use the same windows: those of two grids share pixels, whatever their colours.
        """
        if windows is not None:
            warped = pair.warped_moving(mapping)
            return cls(pair, mapping, warped, windows, *windows.correlated(warped))
        usual, size_px = cls.of(pair, mapping, pair.windows), pair.fixed.size_px
        in_frame_px = points_in_frame(mapping, *pair.sizes_px)

        def unobserved(one: WarpedPair) -> int:
            return len(unobserved_quarters(one.residual.measured_px, size_px, in_frame_px))

        if not unobserved(usual):
            return usual
        small = pair.reference.small_windows
        smaller = replace(usual, windows=small, residual=small.residuals(usual.warped), cross=None)
        return min((usual, smaller), key=unobserved)

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

    def cross_validated(self, by_fold: Sequence[Matrix | None]) -> "WarpedPair":
        """Return the pair with the residual of each window under the homography that was estimated without its fold of
        a chessboard; windows of a fold without one have no shift.
        """
        mappings = [None if m is None else replace(self.mapping, fixed_to_moving=m) for m in by_fold]
        return replace(self, residual=held_out(self.residual, self.mapping, chessboard(self.residual), mappings))

    @cached_property
    def alias_peaks(self) -> list[AliasPeak]:
        """Correlation peaks of the reduced images that are nearly as high as that of the mapping."""
        reference = self.pair.reference
        moving = windowed_spectra(structure_field(shrink(self.warped, reference.seed_size_px)))
        return alias_peaks(reference.seed_spectrum, moving, reference.seed_scale)

    @cached_property
    def _in_usual_windows(self) -> tuple[Residual, Field]:
        """The residual and the sum of cross spectra of the windows that cover the image once."""
        if self.windows is self.pair.windows and self.cross is not None:
            return self.residual, self.cross
        return self.pair.windows.correlated(self.warped)

    @cached_property
    def second_layer(self) -> Layer | None:
        """Structure of the moving image that fits another shift."""
        return second_layer(centred_correlation(self._in_usual_windows[1]))

    @cached_property
    def issues(self) -> tuple[Issue, ...]:
        """What the checks of the pixels find."""
        residual, _ = self._in_usual_windows
        is_expected, pixel_px = (
            partial(self.pair.is_expected, self.mapping.fixed_to_moving),
            self.pair.file_pixel_size_px,
        )
        return (
            *content_issues(residual, pixel_px),
            *layer_issues(self.second_layer, pixel_px),
            *repetition_issues(self.alias_peaks, is_expected, pixel_px),
        )

    @cached_property
    def common_px(self) -> Points:
        """The points (n, 2) of a grid over the reference that the moving image covers.

        Georeferenced rasters have areas without data, which do not count; the image of a camera is complete.
        """
        if self.pair.is_georeferenced:
            return points_in_mask(self.pair.fixed.valid & self.warped.valid)
        return points_in_frame(self.mapping, *self.pair.sizes_px)
