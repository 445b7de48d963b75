"""One band pair, start to end: read, seed, align, check."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign import geometry, lens
from agalign.check import is_as_it_was, verdict
from agalign.config import Settings
from agalign.errors import GeometryError, NotEnoughTextureError
from agalign.geometry import Matrix
from agalign.joint import align_jointly
from agalign.metrics import similarity, tile_residuals
from agalign.raster import read_for_alignment
from agalign.records import Alignment, Band, FloatImage, JointResult, Lens, PairStatus, Raster, Residual, Seed, SeedKind
from agalign.seed import best_seed, geo_seed, is_trusted, overlay, warped
from agalign.structure import textured
from agalign.warp import Mapping

StageProgress = Callable[[str, float], None]
"""Called with the stage and the share of it that is behind, 0 to 1."""

RigSeed = Callable[[Band, Band], Matrix | None]
"""A camera's fixed_to_moving between undistorted pixels from metadata alone."""


_AS_FILES_LIE: tuple[SeedKind, ...] = ("geo", "identity")
"""Seeds that change nothing: an input aligned already is left untouched, not resampled by a hundredth of a pixel."""


@dataclass(frozen=True)
class View:
    """A band as the alignment sees it."""

    raw: Raster
    """As in the file, perhaps reduced."""
    straight: Raster
    """Lens-corrected where a model is known, else the same."""
    scale: tuple[float, float]
    """Size relative to the file."""


def load_view(band: Band, longest_side_px: int) -> View:
    """Read a band for alignment. Raises UnreadableFileError."""
    raw = read_for_alignment(band, longest_side_px)
    scale = raw.size_px[0] / band.width_px, raw.size_px[1] / band.height_px
    return View(raw, lens.undistort_raster(raw, _rescaled(band.lens, scale)), scale)


def align_views(
    fixed: View, moving: View, candidates: dict[SeedKind, Matrix], settings: Settings, progress: StageProgress
) -> Alignment:
    """Align one pair. `candidates` and the result map undistorted pixels of the FILES; the views may be reduced."""
    started = time.perf_counter()
    down = {kind: geometry.rescale(m, fixed.scale, moving.scale) for kind, m in candidates.items()}
    progress("seeding", 0.0)
    one, other = fixed.straight, moving.straight
    before = _similarity_before(fixed, moving)
    if not (textured(one) and textured(other)):
        blank = "reference" if not textured(one) else "moving"
        kind, matrix = next(iter(candidates.items()))
        reason = f"the {blank} band is constant or all invalid"
        return _outcome(matrix, "failed", reason, Seed(kind, matrix, 0.0), None, None, started, before, {})
    seed = best_seed(one, other, down, settings.seed)
    trusted = is_trusted(seed, settings.seed)
    joint, why_not = _joint(one, other, seed, trusted, settings, progress)
    matrix = seed.fixed_to_moving
    if joint is not None:
        for given in (down[kind] for kind in _AS_FILES_LIE if kind in down):
            if is_as_it_was(joint, given, one.size_px, settings.check):
                joint = replace(joint, fixed_to_moving=given)
                break
        matrix = joint.fixed_to_moving
    progress("checking", 0.0)
    residual, after = _measure(one, other, matrix, settings)
    status, doubt = verdict(seed, trusted, joint, why_not, residual, one.size_px, settings.check)
    if status != "aligned" and joint is not None:
        matrix = seed.fixed_to_moving
        residual, after = _measure(one, other, matrix, settings)
    if status == "seed_only" and (residual is None or residual.coverage < 0.3):
        status, doubt = "failed", f"{doubt}, but it does not fit either"
    to_file = [(1 / s[0], 1 / s[1]) for s in (fixed.scale, moving.scale)]
    full = geometry.rescale(matrix, *to_file)
    seed = replace(seed, fixed_to_moving=geometry.rescale(seed.fixed_to_moving, *to_file))
    if joint is not None:
        joint = replace(
            joint, corner_std_px=joint.corner_std_px * to_file[1][0], last_step_px=joint.last_step_px * to_file[0][0]
        )
    residual = _residual_in_file_px(residual, to_file[0])
    return _outcome(full, status, doubt, seed, joint, residual, started, before, after)


def _joint(
    fixed: Raster, moving: Raster, seed: Seed, trusted: bool, settings: Settings, progress: StageProgress
) -> tuple[JointResult | None, str]:
    try:
        joint, _ = align_jointly(
            fixed, moving, seed.fixed_to_moving, settings.joint, trusted=trusted, progress=progress
        )
    except NotEnoughTextureError as reason:
        return None, str(reason)
    except GeometryError:
        return None, "the optimisation ended in a mapping that cannot be inverted"
    return joint, ""


def _outcome(
    matrix: Matrix, status: PairStatus, reason: str | None, seed: Seed, joint: JointResult | None,
    residual: Residual | None, started: float, before: dict[str, float], after: dict[str, float],
) -> Alignment:  # fmt: skip
    seconds = time.perf_counter() - started
    return Alignment(matrix, "pixel", status, reason, seed, joint, residual, seconds, before, after)


def _similarity_before(fixed: View, moving: View) -> dict[str, float]:
    """The files laid on each other as they are."""
    size = fixed.raw.size_px
    scale = moving.raw.size_px[0] / size[0], moving.raw.size_px[1] / size[1]
    return _similarity_of(fixed.raw, moving.raw, geometry.resolution_change(*scale))


def _similarity_of(fixed: Raster, moving: Raster, fixed_to_moving: Matrix) -> dict[str, float]:
    there = warped(moving, fixed_to_moving, fixed.size_px, (1.0, 1.0))
    return similarity(_mean(fixed.pixels), _mean(there.pixels), fixed.valid & there.valid)


def _mean(pixels: NDArray[np.float32]) -> FloatImage:
    return pixels if pixels.ndim == 2 else np.asarray(pixels.mean(axis=0))


def _measure(
    fixed: Raster, moving: Raster, matrix: Matrix, settings: Settings
) -> tuple[Residual | None, dict[str, float]]:
    there = warped(moving, matrix, fixed.size_px, (1.0, 1.0))
    one, other = Raster(_mean(fixed.pixels), fixed.valid), Raster(_mean(there.pixels), there.valid)
    after = similarity(one.pixels, other.pixels, one.valid & other.valid)
    return tile_residuals(one, other, settings.check), after


def _residual_in_file_px(residual: Residual | None, scale: tuple[float, float]) -> Residual | None:
    if residual is None or scale == (1.0, 1.0):
        return residual
    factor = np.array(scale)
    return replace(
        residual, centres_px=(residual.centres_px + 0.5) * factor - 0.5, shifts_px=residual.shifts_px * factor,
        median_px=residual.median_px * scale[0], p95_px=residual.p95_px * scale[0], bias_px=residual.bias_px * scale[0],
    )  # fmt: skip


def _rescaled(model: Lens | None, scale: tuple[float, float]) -> Lens | None:
    if model is None or scale == (1.0, 1.0):
        return model
    sx, sy = scale
    centre = geometry.apply(geometry.resolution_change(sx, sy), (model.cx_px, model.cy_px))
    return replace(
        model, fx_px=model.fx_px * sx, fy_px=model.fy_px * sy, cx_px=float(centre[0]), cy_px=float(centre[1])
    )


def seed_candidates(reference: Band, moving: Band, rig_seed: RigSeed, settings: Settings) -> dict[SeedKind, Matrix]:
    """The coarse mappings that metadata offers, in order of trust; identity is always among them."""
    candidates: dict[SeedKind, Matrix] = {}
    with suppress(GeometryError):  # numbers in the tags that make no camera
        rig = rig_seed(reference, moving)
        if rig is not None:
            candidates["rig"] = rig
    geo = geo_seed(reference, moving)
    if geo is not None:
        candidates["geo"] = geo
    candidates["identity"] = overlay(reference, moving)
    forced = settings.seed.force
    if forced is not None and forced in candidates:
        return {forced: candidates[forced]}
    return candidates


def align_pair(
    reference: Band, moving: Band, fixed: View, rig_seed: RigSeed, settings: Settings, progress: StageProgress
) -> Alignment:
    """Align one band of a capture to its reference, whose view is read already."""
    straight = reference.lens is not None and moving.lens is not None
    if not straight:
        reference, moving = replace(reference, lens=None), replace(moving, lens=None)
        fixed = View(fixed.raw, fixed.raw, fixed.scale)
    progress("reading", 0.0)
    view = load_view(moving, settings.joint.longest_side_px)
    candidates = seed_candidates(reference, moving, rig_seed, settings)
    found = align_views(fixed, view, candidates, settings, progress)
    return replace(found, space="undistorted" if straight else "pixel")


def mapping_of(reference: Band, moving: Band, alignment: Alignment) -> Mapping:
    """The complete mapping between the raw pixels of the two files."""
    if alignment.space == "pixel":
        return Mapping(alignment.fixed_to_moving)
    return Mapping(alignment.fixed_to_moving, reference.lens, moving.lens)
