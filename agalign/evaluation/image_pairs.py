"""Image pairs with their homographies, in the layouts of public data sets."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from agalign.errors import GeometryError, InputError, UnreadableFileError
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import Raster


@dataclass(frozen=True)
class PairFiles:
    """Files of two images of one plane, and the homography between them."""

    name: str
    group: str
    """Group of pairs whose results are averaged."""
    fixed: Path
    moving: Path
    fixed_to_moving: Matrix | None
    """Ground truth, or an approximation for learning; px, pixel centres at integers. None if it is unknown."""


def find_pairs(source: Path) -> list[PairFiles]:
    """Return the pairs of a CSV file, or of a folder and its subfolders in the HPatches or Oxford layout.

    * HPatches: `i_NAME` and `v_NAME` with 1.ppm ... 6.ppm and H_1_2 ... H_1_6.
    * Oxford: any folder with img1.png ... imgK.png and H1to2p ... H1toKp; the group is the folder's name.
    * CSV: columns fixed and moving, and optionally homography (a text file of 9 numbers, or the numbers themselves),
      name and group; paths are relative to the CSV file.

    Raises InputError with the file's name if there are no pairs or a homography cannot be read.
    """
    if source.is_file():
        result = list(_from_csv(source))
    elif source.is_dir():
        result = [pair for folder in sorted({source, *source.rglob("*/")}) for pair in _from_folder(folder)]
    else:
        raise InputError(f"{source}: does not exist")
    if not result:
        raise InputError(f"{source}: no pairs; give a CSV file, or a folder in the HPatches or Oxford layout")
    return result


def _from_folder(folder: Path) -> Iterator[PairFiles]:
    levels = {2: "easy", 3: "easy", 4: "hard", 5: "hard"}
    for path in sorted([*folder.glob("H_1_*"), *folder.glob("H1to*p")]):
        number = int(re.sub(r"\D", "", path.name.removeprefix("H_1_").removeprefix("H1to")) or 0)
        hpatches = path.name.startswith("H_")
        fixed, moving = (_image(folder, str(k) if hpatches else f"img{k}") for k in (1, number))
        kind = {"i": "illumination", "v": "viewpoint"}.get(folder.name.partition("_")[0]) if hpatches else None
        group = f"{kind}, {levels.get(number, 'tough')}" if kind else folder.name
        yield PairFiles(f"{folder.name} 1-{number}", group, fixed, moving, _read_homography(path))


def _image(folder: Path, stem: str) -> Path:
    for suffix in (".ppm", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm"):
        if (folder / f"{stem}{suffix}").is_file():
            return folder / f"{stem}{suffix}"
    raise InputError(f"{folder}: has a homography for {stem} but no such image")


def _from_csv(path: Path) -> Iterator[PairFiles]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    for number, row in enumerate(rows, start=2):
        try:
            fixed, moving = (row[column] or "" for column in ("fixed", "moving"))
        except KeyError as missing:
            raise InputError(f"{path}: has no column {missing}; it needs fixed and moving") from None
        name = row.get("name") or f"{Path(fixed).stem} {Path(moving).stem}"
        matrix, cell = None, row.get("homography") or ""
        if len(cell.replace(",", " ").split()) > 1:
            matrix = _homography_of(cell, f"{path}, line {number}")
        elif cell:
            matrix = _read_homography(path.parent / cell)
        yield PairFiles(name, row.get("group") or path.stem, path.parent / fixed, path.parent / moving, matrix)


def _read_homography(path: Path) -> Matrix:
    try:
        return _homography_of(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None


def _homography_of(text: str, where: str) -> Matrix:
    try:
        return geometry.normalised(np.array(text.replace(",", " ").split(), float).reshape(3, 3))
    except (ValueError, GeometryError):
        raise InputError(f"{where}: a homography is nine numbers, row by row") from None


def read_image(path: Path) -> Raster:
    """An image file, red first. Raises UnreadableFileError."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise UnreadableFileError(f"{path}: is missing or cannot be read as an image")
    if image.ndim == 3:
        image = image[..., :3][..., ::-1].transpose(2, 0, 1)
    return raster_of(image, None, str(path))
