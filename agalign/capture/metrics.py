"""What is measured of the final alignment of a pair: similarity before and after it, and areas that moved."""

from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from agalign.verify.moved import moved_areas


def with_metrics(alignment: Alignment, pair: BandPair) -> Alignment:
    """Return an alignment between the files with similarity metrics of the images before (borders overlaid) and after
    alignment, with those of its windows, and with the areas that moved in its error.
    """
    similarity = pair.reference.similarity
    before = pair.warped_moving(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    mapping = alignment.mapping.rescaled(pair.scales.fixed, pair.scales.moving)
    mapping.hold_positions(pair.fixed.size_px)
    after = pair.warped_moving(mapping)
    of_pixels, residual = similarity.to(after), alignment.residual
    if residual is not None:
        median_px, p95_px, coverage = residual.median_px, residual.p95_px, residual.coverage
        of_pixels = replace(of_pixels, residual_px=median_px, residual_p95_px=p95_px, residual_coverage=coverage)
    measured = replace(alignment, before=similarity.to(before), after=of_pixels)
    return _with_moved_areas(measured, pair, after)


def _with_moved_areas(alignment: Alignment, pair: BandPair, warped: Raster) -> Alignment:
    """Return an alignment between the files with the areas that moved in its error; `warped` is the moving image under
    its mapping.

    They contradict a mapping that the rest of the image confirms: that of an aligned band.
    """
    if alignment.status != "aligned" or alignment.error is None or alignment.residual is None:
        return alignment
    both = pair.reference.grey.valid & warped.valid
    whole = replace(warped, valid=np.ones_like(warped.valid))  # a third faster; invalid pixels are not used
    median_px = alignment.residual.median_px * pair.scales.fixed.mean
    areas = moved_areas(pair.reference.structure, structure_field(whole), both, median_px)
    moved = tuple(area.rescaled(pair.scales.fixed.inverse) for area in areas)
    return replace(alignment, error=replace(alignment.error, moved=moved)) if moved else alignment
