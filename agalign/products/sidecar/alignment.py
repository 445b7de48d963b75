"""The complete mapping of a band, rebuilt from the sidecar of its capture."""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.errors import NoSuchBandError, SidecarError
from agalign.fit.relief import occluded
from agalign.pixels.raster import read_preview
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import BandPart, ReliefPart, Sidecar
from agalign.values import lens
from agalign.values.alignment import Alignment, Residual, Seed
from agalign.values.choices import Geometry
from agalign.values.displacement import DisplacementField
from agalign.values.image import OutputGrid
from agalign.values.issues import Issue
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.checks import KINDS


def read_alignment(sidecar: str | Path, band: str) -> Alignment[FixedFilePx]:
    """Return the alignment of a moving band as a sidecar and its relief raster store it.

    Its `map`, `inverse` and `warp` are those of the run, between the raw pixels of the files; the relief, and occlusion
    by it, is known in the area that was written. `joint` and `prediction` are None, `before` and `after` empty.
    Raises SidecarError for a file that is not a sidecar or lacks the mapping, NoSuchBandError for a band that is not a
    moving band of the capture, UnreadableFileError for a relief raster that cannot be read.
    """
    path = Path(sidecar)
    content = read_sidecar(path)
    parts = {b.band: b for b in content.bands if b.status != "reference"}
    if band not in parts:
        raise NoSuchBandError(f"{path}: no moving band {band!r}; choose from {', '.join(parts)}")
    part = parts[band]
    if part.homography is None or part.seed is None:
        raise SidecarError(f"{path}: has no mapping of the band {band!r}")
    fixed, moving = (None, None) if part.lenses is None else (Lens(**dict(one)) for one in part.lenses)
    field = None if part.field is None else DisplacementField(part.field.step_px, np.array(part.field.displacements_px))
    mapping = PixelMapping(np.array(part.homography.fixed_to_moving), fixed, moving, field=field)
    if part.relief is not None:
        mapping = mapping.with_parallax(_parallax(path, content, part.relief, fixed))
    peaks = part.seed.peak_sigma, part.seed.runner_up_sigma
    seed = Seed(part.seed.kind, np.array(part.seed.fixed_to_moving), part.seed.peak_sigma, *peaks)
    issues = tuple(Issue(KINDS[i.kind], i.value, i.limit) for i in part.issues)
    return Alignment(
        mapping,
        content.reference.size_px,
        part.status,
        issues,
        seed,
        residual=_residual(part),
        seconds=part.seconds,
        candidates=_candidates(part),
        moving_size_px=part.size_px,
    )


def _candidates(part: BandPart) -> dict[Geometry, FixedFilePx]:
    held_out_px = {} if part.geometry is None else part.geometry.held_out_p95_px
    return {kind: FixedFilePx(math.inf if px is None else px) for kind, px in held_out_px.items()}


def _residual(part: BandPart) -> Residual[FixedFilePx] | None:
    tiles = [] if part.metrics is None else [t for t in part.metrics.tiles if t.cell is not None]
    if part.metrics is None or len(tiles) < len(part.metrics.tiles):
        return None
    centres, shifts = np.array([(t.centre_px, t.shift_px) for t in tiles], float).reshape(-1, 2, 2).swapaxes(0, 1)
    peaks, cells = np.array([t.peak_sigma for t in tiles], float), np.array([t.cell for t in tiles], np.int64)
    return Residual[FixedFilePx].of(centres, shifts, peaks, cells.reshape(-1, 2))


def _parallax(path: Path, content: Sidecar, part: ReliefPart, fixed: Lens | None) -> Parallax:
    """Return the parallax of a band, from the raster that was written on the output grid."""
    if part.file is None or content.output is None:
        raise SidecarError(f"{path}: its relief was not written")
    if content.output.undistorted and fixed is None:
        raise SidecarError(
            f"{path}: has a relief on a lens-corrected grid, but not the lens; run again without --undistort"
        )
    grid = content.output.grid
    values = read_preview(path.parent / part.file, 1, (0, 0, grid.width, grid.height), (grid.width, grid.height))
    parallax_px = _on_reference(values, grid, content.reference.size_px, fixed)
    relief = Relief(parallax_px, np.ones_like(parallax_px))
    return Parallax(relief, part.baseline, occluded(relief, part.baseline))


def _on_reference(
    values: NDArray[np.float32], grid: OutputGrid, size_px: tuple[int, int], fixed: Lens | None
) -> NDArray[np.float32]:
    """Return values (height, width) on a grid at the raw pixels of the reference; those at the edge are continued."""
    points = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in size_px)), axis=-1)
    if grid.undistorted:
        points = lens.undistort(fixed, points)
    at = (grid.scale.positions(points) - (grid.x0, grid.y0)).astype(np.float32)
    return np.asarray(cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
