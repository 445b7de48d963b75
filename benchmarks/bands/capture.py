"""What needs more than two arrays: the program on a whole flight, and images corrected for their lenses.

Both get a folder of the set's own files, so that tags are there.
"""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from cases import straightened

from agalign.cameras.discover import discover
from agalign.pixels.raster import TIFF_SUFFIXES, without_warnings
from agalign.values import geometry, lens
from agalign.values.capture import Band
from agalign.values.mapping import PixelMapping
from bands.images import LENS_CORRECTED, Image, read, spoilt
from bands.methods import Align, grey_raster
from bands.score import AS_IT_IS, Pair

WHOLE = {"agalign, capture": (), "agalign, capture, no tags": ("--ignore-metadata",)}
"""By their names, the options of the command line."""
Row = dict[str, Any]
_GRID = (33, 25)


def by_command_line(
    method: str, paths: Mapping[str, Path], pairs: Sequence[Pair], variant: str, folder: Path
) -> list[Row]:
    """`agalign FOLDER` on the set's files, of which the moving ones of the pairs are spoilt; the rest of the flight is
    as it is. A band is claimed where it is called aligned; one that is predicted is given and not claimed.
    """
    flight, out = folder / "flight", folder / "out"
    flight.mkdir(parents=True)
    for name, path in paths.items():
        shutil.copyfile(path, flight / name)
    if variant != AS_IT_IS:
        for pair in pairs:
            _replace_pixels(flight / pair.file, spoilt(read(paths[pair.file]), pair, variant))
    began = time.perf_counter()
    command = [sys.executable, "-m", "agalign", str(flight), "-o", str(out), "-q", *WHOLE[method]]
    # Exit code 3 is that of bands which are not aligned; what it says of each is in the sidecars.
    subprocess.run(command, check=False, stderr=subprocess.DEVNULL)
    seconds = (time.perf_counter() - began) / (len(paths) - len({p.reference for p in pairs}))
    said = {band["file"]: band for side in _sidecars(out) for band in side["bands"]}
    return [_row(said.get(pair.file), seconds) for pair in pairs]


def _replace_pixels(path: Path, pixels: Image) -> None:
    with without_warnings(), rasterio.open(path, "r+") as dataset:
        dataset.write(pixels, 1)


def _sidecars(out: Path) -> Iterator[dict[str, Any]]:
    for path in sorted(out.rglob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        if str(result.get("schema", "")).startswith("agalign/"):
            yield result


def _row(band: Mapping[str, Any] | None, seconds: float) -> Row:
    given = band is not None and band["status"] in ("aligned", "predicted") and band["grid"]
    if band is None or not given:
        return {"seconds": seconds}
    grid = {k: np.round(band["grid"][k], 4).tolist() for k in ("reference_px", "moving_px")}
    return {"grid": grid, "claimed": "yes" if band["status"] == "aligned" else "no", "seconds": seconds}


def has_tags(paths: Mapping[str, Path]) -> bool:
    """Files of a camera, in which a flight can be found."""
    return all(path.suffix.lower() in TIFF_SUFFIXES for path in paths.values())


# ---- images without their lenses' distortion


def bands_of(paths: Mapping[str, Path], folder: Path) -> dict[str, Band]:
    """What the tags of a set's files say, by name; none where the files have no tags."""
    if not has_tags(paths):
        return {}
    for name, path in paths.items():
        (folder / name).symlink_to(path.resolve())
    return {band.path.name: band for capture in discover(folder).captures for band in capture.bands}


def lens_corrected(align: Align, fixed: tuple[Image, Band], moving: tuple[Image, Band]) -> Row:
    """What a pair method says of images that are corrected first, as a grid between the files' raw pixels. The
    correction is no part of its seconds.
    """
    images = [straightened(_with_lens(image, band)) for image, band in (fixed, moving)]
    began = time.perf_counter()
    matrix = align(images[0].pixels, images[1].pixels)
    seconds = time.perf_counter() - began
    if matrix is None:
        return {"seconds": seconds}
    here = geometry.lattice(*images[0].size_px, *_GRID)
    there = PixelMapping(geometry.normalised(matrix), fixed[1].lens, moving[1].lens)(here)
    grid = {"reference_px": np.round(here, 4).tolist(), "moving_px": np.round(there, 4).tolist()}
    return {"grid": grid, "seconds": seconds}


def _with_lens(image: Image, band: Band) -> Any:
    raster = grey_raster(image)
    return type(raster)(raster.pixels, raster.valid, band.lens)


def applies(method: str, variant: str, pairs: Sequence[Pair], bands: Mapping[str, Band], *, tags: bool) -> bool:
    """Whether a method can be asked of a variant: the program corrects lenses itself, and an image without a lens has
    nothing to be corrected.
    """
    if variant == LENS_CORRECTED:
        known = [bands.get(name) for p in pairs for name in (p.reference, p.file)]
        return method not in WHOLE and all(b is not None and lens.is_distorting(b.lens) for b in known)
    return method not in WHOLE or tags
