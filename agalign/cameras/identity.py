"""Which band a file is: one spelling for each band, and evidence that contradicts the names."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from agalign.cameras.base import own_stem
from agalign.cameras.known import SAME_BAND_NM
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.read_files import ImageFile, Problem
from agalign.errors import InputError
from agalign.values.capture import Band
from agalign.values.spectrum import band_key, contradicts
from agalign.values.text import counted

_MAX_NAMES = 6
"""Of captures in a message."""
_SAME_NM = 0.5
"""Between the wavelengths of two bands that are called equal."""


def with_one_spelling(files: Sequence[ImageFile]) -> list[ImageFile]:
    """Return the files with the most frequent spelling of each band's name in the files of its camera."""
    spellings: dict[tuple[object, str], Counter[str]] = defaultdict(Counter)
    for file in files:
        for band in file.bands:
            spellings[_camera(file), band_key(band.name)][band.name.strip()] += 1
    usual = {key: counts.most_common(1)[0][0] for key, counts in spellings.items()}
    result = []
    for file in files:
        bands = tuple(replace(b, name=usual[_camera(file), band_key(b.name)]) for b in file.bands)
        is_unique = len({b.name for b in bands}) == len({b.name for b in file.bands})
        result.append(replace(file, bands=bands) if is_unique else file)
    return result


def _camera(file: ImageFile) -> tuple[object, ...]:
    """Make and model, or the folder without a model; multiband files apart from those of single bands."""
    known = (file.tags.make, file.tags.model) if file.tags.model else (file.camera.capture_folder(file.path),)
    return (*known, len(file.bands) > 1)


def name_end(file: ImageFile) -> str:
    """Return the end of a file's name that differs between the bands of a capture, without separators."""
    return own_stem(file.path).removeprefix(file.camera.capture_name(file.path)).strip("_- ")


def _position(file: ImageFile) -> str:
    """The evidence of a band's position in the rig, in words; empty if there is none."""
    index, end = file.tags.text(NAMESPACE, "RigCameraIndex"), name_end(file)
    return f"RigCameraIndex {index}" if index else f"'{end}' at the end of the name" if end else ""


def contradictions(groups: Iterable[Sequence[ImageFile]]) -> list[Problem]:
    """Return a problem for each position in the rig of one camera whose tags change, and for bands with a name or
    wavelength that others contradict. `groups` are the files of each capture.
    """
    tags: dict[tuple[str, ...], dict[str, list[ImageFile]]] = defaultdict(lambda: defaultdict(list))
    bands: dict[str, list[Path]] = defaultdict(list)
    for group in groups:
        for file in group:
            if len(file.bands) == 1 and file.tags.text(NAMESPACE, "BandName") and file.tags.unread is None:
                serial, name = file.tags.serial or str(file.camera.capture_folder(file.path)), file.bands[0].name
                tags[file.tags.make, file.tags.model, serial, _position(file)][band_key(name)].append(file)
        for text, path in _doubtful([b for file in group for b in file.bands if not b.is_from_photograph]):
            bands[text].append(path)
    texts = [(paths[0], f"{text}, in {counted(len(paths), 'file')}; correct the tags") for text, paths in bands.items()]
    for (*_, position), by_name in tags.items():
        found = list(by_name.values()) if len(by_name) > 1 else _by_wavelength(next(iter(by_name.values())))
        if position and len(found) > 1:
            named = [f"{_label(files[0].bands[0])} in {_captures(files)}" for files in found]
            what = f"files with {position} of one camera are {' and '.join(named)}"
            advice = "one of the names is wrong: compare the images and correct the tags"
            texts.append((found[-1][0].path, f"{what}; {advice}"))
    return [Problem(path, InputError(f"{path}: {text}")) for path, text in texts]


def _doubtful(bands: Sequence[Band]) -> list[tuple[str, Path]]:
    """(what contradicts, file) of the bands of a capture."""
    result = []
    known = sorted(((b, b.wavelength_nm) for b in bands if b.wavelength_nm is not None), key=lambda pair: pair[1])
    for band, nm in known:
        if contradicts(band.name, nm):
            text = f"the name '{band.name}' contradicts its wavelength of {nm:g} nm, so that no index uses it"
            result.append((text, band.path))
    for (one, nm), (other, other_nm) in pairwise(known):
        if abs(nm - other_nm) < _SAME_NM and band_key(one.name) != band_key(other.name):
            text = f"the bands {one.name} and {other.name} of a capture have one wavelength, {nm:g} nm"
            result.append((text, other.path))
    return result


def _by_wavelength(files: Sequence[ImageFile]) -> list[list[ImageFile]]:
    """The files of one band by wavelength; together if firmware may have written all of them for it."""
    result: list[list[ImageFile]] = []
    previous_nm = -math.inf
    for nm, file in sorted(((f.bands[0].wavelength_nm or 0.0, f) for f in files), key=lambda pair: pair[0]):
        result += [[]] if nm - previous_nm > SAME_BAND_NM else []
        result[-1].append(file)
        previous_nm = nm
    return result


def _label(band: Band) -> str:
    return band.name if band.wavelength_nm is None else f"{band.name} ({band.wavelength_nm:g} nm)"


def _captures(files: Sequence[ImageFile]) -> str:
    names = list(dict.fromkeys(file.camera.capture_name(file.path) for file in files))
    more = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {counted(more, 'other capture')}" if more > 0 else "")
