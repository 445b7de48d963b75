"""Which band a file is: one spelling for each band, and the part of a name that tells it."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from agalign.cameras.base import Camera
from agalign.cameras.image_file import ImageFile
from agalign.values.band_names import own_stem
from agalign.values.spectrum import band_key


def with_one_spelling(files: Sequence[ImageFile]) -> list[ImageFile]:
    """Return the files with one spelling of each band's name in the files of a camera, or of a folder without tags: the
    first. Multiband files are apart from those of single bands.
    """
    spellings: dict[tuple[object, ...], str] = {}
    result = []
    for file in files:
        camera = file.tags.make, file.tags.model or file.camera.capture_folder(file.path), len(file.bands) > 1
        names = [spellings.setdefault((*camera, band_key(b.name)), b.name.strip()) for b in file.bands]
        is_unique = len(set(names)) == len({b.name for b in file.bands})
        bands = tuple(replace(b, name=name) for b, name in zip(file.bands, names, strict=True))
        result.append(replace(file, bands=bands) if is_unique else file)
    return result


def name_end(file: ImageFile) -> str:
    """Return the end of a file's name that differs between the bands of a capture, without separators."""
    return end_of(file.path, file.camera)


def end_of(path: Path, camera: Camera) -> str:
    """Return the same of a file that only its name assigns to a camera."""
    stem, capture = own_stem(path), camera.capture_name(path)
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(stem, capture, strict=False)))
    rest = capture[shared:]  # what follows the band in the name
    if rest and len(stem) > len(capture) and stem.endswith(rest):
        return stem[shared : len(stem) - len(rest)].strip("_- ")
    return stem.removeprefix(capture).strip("_- ")
