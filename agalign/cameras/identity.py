"""Which band a file is: one spelling for each band, and evidence that contradicts the names."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from agalign.cameras.base import Camera
from agalign.cameras.known import SAME_BAND_NM
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.read_files import ImageFile, Problem
from agalign.errors import InputError
from agalign.values.band_names import own_stem
from agalign.values.capture import Band
from agalign.values.spectrum import band_key, contradicts
from agalign.values.text import counted, some_of

_SAME_NM = 0.5
"""Between the wavelengths of two bands that are called equal."""


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
    return own_stem(path).removeprefix(camera.capture_name(path)).strip("_- ")


def _position(file: ImageFile) -> str:
    """The evidence of a band's position in the rig, in words; empty if there is none."""
    index, end = file.tags.text(NAMESPACE, "RigCameraIndex"), name_end(file)
    return f"RigCameraIndex {index}" if index else f"'{end}' at the end of the name" if end else ""


def contradictions(groups: Iterable[Sequence[ImageFile]]) -> list[Problem]:
    """Return a problem for each position in the rig of one camera that changes its tags, and for bands with a name or
    wavelength that others contradict. `groups` are the files of each capture.
    """
    tags: dict[tuple[str, ...], dict[str, list[ImageFile]]] = defaultdict(lambda: defaultdict(list))
    doubtful: dict[str, list[Path]] = defaultdict(list)
    for group in groups:
        for file in (f for f in group if len(f.bands) == 1 and f.tags.text(NAMESPACE, "BandName")):
            if file.tags.unread is None and (position := _position(file)):
                serial = file.tags.serial or str(file.camera.capture_folder(file.path))
                tags[file.tags.make, file.tags.model, serial, position][_label(file.bands[0])].append(file)
        for text, path in _doubtful([b for file in group for b in file.bands if not b.is_from_photograph]):
            doubtful[text].append(path)
    texts = [(p[0], f"{text}, in {counted(len(p), 'file')}; correct the tags") for text, p in doubtful.items()]
    for (*_, position), by_label in tags.items():
        bands = [files[0].bands[0] for files in by_label.values()]
        wavelengths = [b.wavelength_nm for b in bands if b.wavelength_nm is not None]
        is_one_name = len({band_key(b.name) for b in bands}) == 1
        if not is_one_name or max(wavelengths, default=0.0) - min(wavelengths, default=0.0) > SAME_BAND_NM:
            captures = {label: (f.camera.capture_name(f.path) for f in files) for label, files in by_label.items()}
            what = " and ".join(f"{label} in {some_of(dict.fromkeys(names))}" for label, names in captures.items())
            advice = "one of the names is wrong: compare the images and correct the tags"
            path = [*by_label.values()][-1][0].path
            texts.append((path, f"files with {position} of one camera are {what}; {advice}"))
    return [Problem(path, InputError(f"{path}: {text}")) for path, text in texts]


def files_of_one_band(groups: Iterable[Sequence[ImageFile]]) -> list[Problem]:
    """Return a problem for each band that captures have from two files, as of different naming: f_red.tif and
    red/f_red.tif. `groups` are the files of each capture; bands of one name and other wavelengths are two bands.
    """
    clashes: dict[str, list[tuple[Path, Path]]] = defaultdict(list)
    for group in groups:
        first: dict[str, ImageFile] = {}
        for file in (f for f in group if len(f.bands) == 1):
            other = first.setdefault(band_key(file.bands[0].name), file)
            nms = [b.wavelength_nm for b in (*other.bands, *file.bands) if b.wavelength_nm is not None]
            if other is not file and max(nms, default=0.0) - min(nms, default=0.0) <= SAME_BAND_NM:
                clashes[file.bands[0].name].append((other.path, file.path))
    problems = []
    for name, pairs in clashes.items():
        other_path, path = pairs[0]
        others = f", and so in {counted(len(pairs) - 1, 'other file')}" if len(pairs) > 1 else ""
        twin = other_path.name if other_path.name != path.name else other_path
        text = f"is band '{name}' of one capture as {twin} is{others}; both are aligned: move one of them elsewhere"
        problems.append(Problem(path, InputError(f"{path}: {text}")))
    return problems


def _doubtful(bands: Sequence[Band]) -> list[tuple[str, Path]]:
    """(what contradicts, file) of the bands of a capture."""
    known = sorted(((b, b.wavelength_nm) for b in bands if b.wavelength_nm is not None), key=lambda pair: pair[1])
    wrong = ((b, nm) for b, nm in known if contradicts(b.name, nm))
    text = "the name '{}' contradicts its wavelength of {:g} nm, so that no index uses it"
    result = [(text.format(band.name, nm), band.path) for band, nm in wrong]
    for (one, nm), (other, other_nm) in pairwise(known):
        if other_nm - nm < _SAME_NM and band_key(one.name) != band_key(other.name):
            text = f"the bands {one.name} and {other.name} of a capture have one wavelength, {nm:g} nm"
            result.append((text, other.path))
    return result


def _label(band: Band) -> str:
    return band.name if band.wavelength_nm is None else f"{band.name} ({band.wavelength_nm:g} nm)"
