"""Band pairs with ground truth, from folders with `ties.json` or the `truth.json` of a synthetic flight."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agalign.cameras import rig_seed
from agalign.cameras.discover import discover
from agalign.pixels.raster import probe, read_for_alignment
from agalign.pixels.resample import warped
from agalign.values import lens
from agalign.values.capture import Band, Capture
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

Matrix = np.ndarray


@dataclass(frozen=True)
class Case:
    """One band pair with its ground truth."""

    set_name: str
    capture: Capture | None
    reference: Band
    band: Band
    fixed: Raster
    moving: Raster
    """As in the files, with their lenses."""
    ties: Matrix
    """(n, 4) undistorted px."""

    @property
    def rig(self) -> Matrix:
        """Mapping of the rig from the tags, or identity without tags."""
        result = rig_seed(self.reference, self.band)
        return np.eye(3) if result is None else result

    def straight(self) -> tuple[Raster, Raster]:
        """Both images without lens distortion."""
        return straightened(self.fixed), straightened(self.moving)


def straightened(raster: Raster) -> Raster:
    """Return an image without lens distortion."""
    if not lens.is_distorting(raster.lens):
        return raster
    return warped(raster, PixelMapping(np.eye(3), None, raster.lens), raster.size_px)


def cases(folders: list[Path]) -> Iterator[Case]:
    """Return every band pair of folders with ties.json or truth.json."""
    for path in [p for folder in folders for p in (folder / "ties.json", folder / "truth.json") if p.is_file()]:
        captures = {}
        for capture in discover(path.parent).captures:
            captures.update({b.path.name: capture for b in capture.bands})
        for entry in json.loads(path.read_text()).values():
            capture = captures.get(entry["reference"])
            reference = _band(path.parent, entry["reference"], capture)
            fixed = read_for_alignment(reference, 4096)
            for name, truth in entry["bands"].items():
                band = _band(path.parent, name, capture)
                both = reference.lens is not None and band.lens is not None
                here, there = (b if both else replace(b, lens=None) for b in (reference, band))
                raw = np.array(truth["ties"])
                ties = np.hstack([lens.undistort(here.lens, raw[:, :2]), lens.undistort(there.lens, raw[:, 2:])])
                images = fixed if both else replace(fixed, lens=None), read_for_alignment(there, 4096)
                yield Case(path.parent.name, capture, here, there, *images, ties)


def _band(folder: Path, name: str, capture: Capture | None) -> Band:
    for band in capture.bands if capture else ():
        if band.path.name == name:
            return band
    path = next(folder.rglob(name))
    info = probe(path)
    return Band(path.stem, path, 1, info.width_px, info.height_px, info.dtypes[0])
