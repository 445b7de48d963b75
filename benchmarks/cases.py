"""Band pairs with ground truth, from folders with `ties.json` or the `truth.json` of a synthetic flight, and image
pairs with a homography in a text file.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agalign.cameras import rig_seed
from agalign.cameras.discover import discover
from agalign.evaluation.image_pairs import PairFiles
from agalign.pixels.raster import probe, read_for_alignment
from agalign.pixels.resample import warped
from agalign.values import lens
from agalign.values.capture import Band
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

_PAIR_NAMES = ("VIS_{}.png", "NIR_TF_{}.png", "GT_{}.txt"), ("VI_{}_a.png", "VI_{}_b.png", "VI_{}_fixed_to_moving.txt")


@dataclass(frozen=True)
class Case:
    """One band pair with its ground truth."""

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


def cases(folder: Path) -> Iterator[Case]:
    """Return every band pair of a folder with ties.json or truth.json."""
    for path in [p for p in (folder / "ties.json", folder / "truth.json") if p.is_file()]:
        bands = {b.path.name: b for capture in discover(folder).captures for b in capture.bands}
        for entry in json.loads(path.read_text()).values():
            reference = bands.get(entry["reference"]) or _plain_band(folder, entry["reference"])
            fixed = read_for_alignment(reference, 4096)
            for name, truth in entry["bands"].items():
                band = bands.get(name) or _plain_band(folder, name)
                both = reference.lens is not None and band.lens is not None
                here, there = (b if both else replace(b, lens=None) for b in (reference, band))
                raw = np.array(truth["ties"])
                ties = np.hstack([lens.undistort(here.lens, raw[:, :2]), lens.undistort(there.lens, raw[:, 2:])])
                images = fixed if both else replace(fixed, lens=None), read_for_alignment(there, 4096)
                yield Case(here, there, *images, ties)


def _plain_band(folder: Path, name: str) -> Band:
    path = next(folder.rglob(name))
    stored = probe(path)[0]
    return Band(path.stem, path, 1, *stored.size_px, stored.dtype)


def image_pairs(folder: Path) -> list[PairFiles]:
    """Return the aerial (VIS_1.png, NIR_TF_1.png, GT_1.txt) and visible-thermal pairs of a folder by number."""
    files = [(n, [folder / name.format(n) for name in names]) for n in range(1, 100) for names in _PAIR_NAMES]
    return [
        PairFiles(str(number), folder.name, fixed, moving, np.loadtxt(truth))
        for number, (fixed, moving, truth) in files
        if truth.is_file()
    ]
