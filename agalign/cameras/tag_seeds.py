"""Initial mappings of a band pair from the metadata of the files."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.pixels.coordinates import transformed
from agalign.values import geometry
from agalign.values.capture import Band
from agalign.values.choices import SeedKind
from agalign.values.geometry import Matrix


def tag_seeds(reference: Band, moving: Band, settings: SeedSettings) -> dict[SeedKind, Matrix]:
    """Return fixed_to_moving between undistorted px of the files by kind, in order of preference, identity last.

    If the settings force a kind that tags provide, only this kind is returned, or nothing if the tags lack it.
    """
    sources: tuple[tuple[SeedKind, Callable[[Band, Band], Matrix | None]], ...] = (
        ("rig", rig_seed),
        ("centre", other_rig_seed),
        ("geo", geo_seed),
    )
    matrices: dict[SeedKind, Matrix] = {}
    for kind, source in sources:
        with suppress(GeometryError):  # invalid values in the tags
            matrix = source(reference, moving)
            if matrix is not None:
                matrices[kind] = matrix
    matrices["identity"] = geometry.overlay(reference.size_px, moving.size_px)
    if settings.force in ("rig", "geo", "identity"):
        return {kind: matrix for kind, matrix in matrices.items() if kind == settings.force}
    return matrices


def rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """Return `fixed_to_moving` (3, 3) between undistorted pixels from tags alone; None if the tags lack it."""
    if reference.to_rig is None or moving.to_rig is None:
        return None
    return geometry.compose(geometry.invert(moving.to_rig), reference.to_rig)


def other_rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """Return `rig_seed` by the second set of tags that some makers write; None if both bands lack it."""
    if reference.other_to_rig is None and moving.other_to_rig is None:
        return None
    others = (b if b.other_to_rig is None else replace(b, to_rig=b.other_to_rig) for b in (reference, moving))
    return rig_seed(*others)


def geo_seed(reference: Band, moving: Band) -> Matrix | None:
    """Return fixed_to_moving from the geotransforms of two files; None if one has none.

    Between different coordinate reference systems it is the homography that fits the transformation best. Half pixels
    convert between the corner of the top-left pixel, to which geotransforms refer, and its centre. Raises
    GeometryError.
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
