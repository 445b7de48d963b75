"""Coarse mappings that a file's metadata offers, before any pixel is looked at."""

from contextlib import suppress

from agalign.cameras import other_rig_seed, rig_seed
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.pixels.raster import transformed
from agalign.values import geometry
from agalign.values.capture import Band
from agalign.values.choices import SeedKind
from agalign.values.geometry import Matrix

_FROM_TAGS: tuple[SeedKind, ...] = ("rig", "geo", "identity")


def seed_candidates(reference: Band, moving: Band, settings: SeedSettings) -> dict[SeedKind, Matrix]:
    """fixed_to_moving between undistorted pixels of the files, in order of trust, identity last.

    Where the settings force a kind that tags can give, only that one, or none where the tags do not give it.
    """
    candidates: dict[SeedKind, Matrix] = {}
    with suppress(GeometryError):  # values in the tags that do not describe a camera
        rig = rig_seed(reference, moving)
        if rig is not None:
            candidates["rig"] = rig
    with suppress(GeometryError):
        by_centres = other_rig_seed(reference, moving)
        if by_centres is not None:
            candidates["centre"] = by_centres
    with suppress(GeometryError):
        geo = geo_seed(reference, moving)
        if geo is not None:
            candidates["geo"] = geo
    candidates["identity"] = geometry.overlay(reference.size_px, moving.size_px)
    if settings.force in _FROM_TAGS:
        return {kind: matrix for kind, matrix in candidates.items() if kind == settings.force}
    return candidates


def geo_seed(reference: Band, moving: Band) -> Matrix | None:
    """fixed_to_moving from the two files' geotransforms; None where either has none.

    Between two coordinate reference systems it is the homography closest to the transformation. Geotransforms refer to
    the corner of the top-left pixel, this package to its centre: hence the half pixels. Raises GeometryError.
    """
    fixed, other = reference.georeference, moving.georeference
    if fixed is None or other is None:
        return None
    to_corner = geometry.translation(0.5, 0.5)
    try:
        map_to_moving = geometry.invert(other.transform)
    except GeometryError:
        raise GeometryError(f"{moving.path}: its geotransform cannot be inverted") from None
    if fixed.crs_wkt == other.crs_wkt:
        return geometry.compose(geometry.invert(to_corner), map_to_moving, fixed.transform, to_corner)
    points = geometry.lattice(*reference.size_px, 9, 7)
    on_map = transformed(geometry.apply(fixed.transform, points + 0.5), fixed.crs_wkt, other.crs_wkt)
    try:
        return geometry.fit_homography(points, geometry.apply(map_to_moving, on_map) - 0.5)
    except GeometryError:
        raise GeometryError(f"{moving.path}: is outside the coordinates of {reference.path.name}") from None
