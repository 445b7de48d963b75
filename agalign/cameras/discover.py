"""From a folder to captures."""

import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from types import MappingProxyType

from pebble import ProcessExpired, ProcessPool

from agalign.cameras.base import Camera, default_reference
from agalign.cameras.known import camera_of, known_cameras
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.pix4d import panel_in
from agalign.errors import AgalignError, ConfigurationError, InputError, NoSuchBandError, UnreadableFileError
from agalign.pixels.radiometry import is_physical
from agalign.pixels.raster import JPEG_SUFFIXES, TIFF_SUFFIXES, RasterInfo, probe
from agalign.values.capture import Band, CameraIdentity, Capture
from agalign.values.choices import MAX_MOSAIC_PIXELS, MAX_PIXELS, BandOrder
from agalign.values.files import RUN_FILE
from agalign.values.processes import follow_parent, without_interrupt_key


@dataclass(frozen=True)
class Problem:
    """A file or capture that cannot take part, and why."""

    path: Path
    error: AgalignError

    @property
    def text(self) -> str:
        """One line that names the file and says what to do."""
        return str(self.error)


@dataclass(frozen=True)
class FolderScan:
    """Everything found below a folder."""

    folder: Path
    captures: tuple[Capture, ...]
    problems: tuple[Problem, ...]


_SUFFIXES = TIFF_SUFFIXES | JPEG_SUFFIXES
_SYSTEMS = {"lost+found", "System Volume Information", "$RECYCLE.BIN"}
"""What operating systems keep on a card."""
_NAMELESS = "capture"
_FILES_AT_ONCE = 100
_KILLED = "reading it, or a file beside it, killed the process; take it out of the folder"
_FILES_WORTH_PROCESSES = 1000
_NAMES_OF_THE_RUN = {"panels", Path(RUN_FILE).stem, "summary", "index"}


@dataclass(frozen=True)
class _File:
    path: Path
    camera: Camera
    tags: Tags
    bands: tuple[Band, ...]


@dataclass(frozen=True)
class DiscoverOptions:
    """What to look for."""

    pattern: str | None = None
    """File names as '{capture}_{band}.tif', for files whose names follow no known scheme."""
    reference: str | None = None
    """Name of the reference band; None is the camera's default."""
    ignore_metadata: bool = False
    """Leave lens and rig tags aside."""
    with_rgb: bool = False
    """The colour photographs that some cameras take beside the narrow bands take part, as three bands."""
    bands: tuple[str, ...] = ()
    """Names of the bands that take part; empty for all."""
    order: BandOrder = "index"
    """Of the bands in the stacks: as the camera counts them, by wavelength, or by name."""
    skip: tuple[Path, ...] = field(default=())
    """Folders not to look into, such as the output's."""
    max_pixels: int = MAX_PIXELS
    """Images that declare more are refused before anything is made of them."""
    jobs: int = 1
    """Processes that look at files, where these are many; the calling script must be importable then."""


def discover(
    folder: str | Path, options: DiscoverOptions | None = None, progress: Callable[[int, int], None] | None = None
) -> FolderScan:
    """All captures below `folder`, sorted by folder and name. `progress` gets (files done, files in all).

    Raises InputError where the folder does not exist or holds no image, ConfigurationError for a band that no capture
    has.
    """
    folder, options = Path(folder), options or DiscoverOptions()
    _check_folder(folder)
    files: list[_File] = []
    paths, problems = _images(folder, options.skip)
    if not paths and problems:
        raise problems[0].error
    if not paths:
        raise InputError(f"{folder}: no .tif, .tiff, .jpg or .jpeg file in it or below it")
    for number, result in enumerate(_examined(paths, options), start=1):
        if isinstance(result, _File):
            if result.bands:
                files.append(result)
        # A colour photograph that does not take part does no harm either.
        elif options.with_rgb or result.path.suffix.lower() in TIFF_SUFFIXES:
            problems.append(result)
        if progress is not None:
            progress(number, len(paths))
    captures: list[Capture] = []
    for group in _groups(files):
        problems += _alike(group, options)
        made = _capture(folder, group, options)
        if isinstance(made, Problem):
            problems.append(made)
        else:
            captures.append(made)
    known = {b.name.lower() for file in files for b in file.bands}
    unknown = [name for name in options.bands if name.lower() not in known]
    if unknown and files:
        raise ConfigurationError(f"{folder}: no capture has a band {' or '.join(map(repr, unknown))}, as --bands asks")
    captures.sort(key=lambda c: (c.folder.as_posix(), c.name))
    captures = _with_missing_bands(_with_unique_names(captures, _names_of_files(captures)))
    return FolderScan(folder, tuple(captures), tuple(problems))


def _check_folder(folder: Path) -> None:
    """Raises InputError for what is no folder."""
    if folder.as_posix().startswith("/vsi"):
        raise InputError(f"{folder}: is one of GDAL's virtual paths; mount or unpack it, and give the folder")
    try:
        if folder.is_dir():
            return
        what = "is a file; give the folder it is in" if folder.exists() else "does not exist"
    except OSError as error:
        what = f"cannot be looked into ({error.strerror or error})"
    raise InputError(f"{folder}: {what}")


def captures_onto(
    reference: Path, moving: Sequence[Path], band: str | None = None, max_pixels: int = MAX_MOSAIC_PIXELS
) -> list[Capture]:
    """Georeferenced images that are to be laid on the grid of another one: of each, a capture of the reference's `band`
    (by default the green one) and of all its own bands, which share one mapping.

    Raises UnreadableFileError, InputError where one is not georeferenced, NoSuchBandError.
    """
    here = _georeferenced_bands(reference, max_pixels)
    fixed = here[_reference_index(here, band, reference)]
    fixed = replace(fixed, name=f"{reference.stem} {fixed.name}")
    captures = []
    for path in moving:
        if path.resolve() == reference.resolve():
            raise InputError(f"{path}: is the reference itself; name the mosaics that are to be laid on it")
        bands = [fixed, *(replace(b, one_lens=True, companion=False) for b in _georeferenced_bands(path, max_pixels))]
        taken_at = read_tags(path).captured_at
        captures.append(Capture(path.stem, Path(), tuple(_with_unique_band_names(bands)), 0, captured_at=taken_at))
    return _with_unique_names(captures)


def _georeferenced_bands(path: Path, max_pixels: int) -> tuple[Band, ...]:
    info = probe(path, max_pixels)
    if info.georeference is None:
        raise InputError(f"{path}: has no coordinates; align images without by 'agalign FOLDER'")
    *_, generic = known_cameras(None)
    return generic.bands(path, read_tags(path), info)


def _images(folder: Path, skip: Sequence[Path]) -> tuple[list[Path], list[Problem]]:
    """(the image files below a folder, the folders that cannot be looked into)."""
    skipped = {p.resolve() for p in skip}
    result: list[Path] = []
    problems: list[Problem] = []

    def refused(error: OSError) -> None:
        path = Path(error.filename)
        problems.append(Problem(path, InputError(f"{path}: cannot be looked into ({error.strerror}); left out")))

    for parent, folders, names in os.walk(folder, onerror=refused):
        here = Path(parent)
        folders[:] = sorted(
            d for d in folders
            if not d.startswith(".") and d not in _SYSTEMS and (here / d).resolve() not in skipped
            and not is_output(here / d)
        )  # fmt: skip
        images = [n for n in names if Path(n).suffix.lower() in _SUFFIXES and not n.startswith(".")]
        images.sort(key=_natural)
        result.extend(here / n for n in images)
    return result, problems


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Sorts `_2` before `_10`."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part.lower()) for part in parts]


def is_output(folder: Path) -> bool:
    """An earlier run's output folder lies below its input: its stacks are not captures.

    A run names itself there before it writes anything else, so that one that was killed is known too.
    """
    try:
        entries = {entry.name for entry in os.scandir(folder)}
    except OSError:
        return False
    return RUN_FILE in entries or {"summary.csv", "index.html"} <= entries


def _examined(paths: Sequence[Path], options: DiscoverOptions) -> Iterator["_File | Problem"]:
    """What each file holds, or why it cannot take part; many files are looked at by several processes."""
    parts = [paths[i : i + _FILES_AT_ONCE] for i in range(0, len(paths), _FILES_AT_ONCE)]
    if min(options.jobs, len(parts)) <= 1 or len(paths) < _FILES_WORTH_PROCESSES:
        for part in parts:
            yield from _look_at(part, options)
        return
    # Processes that start from nothing: what a fork would take along of this one is not known here.
    pool = ProcessPool(min(options.jobs, len(parts)), context=get_context("spawn"), initializer=follow_parent)
    try:
        with without_interrupt_key():
            futures = [pool.schedule(_look_at, args=(part, options)) for part in parts]
        for part, future in zip(parts, futures, strict=True):
            try:
                yield from future.result()
            except BrokenExecutor:  # all of them were killed, and not over a file
                yield from _look_at(part, options)
            except ProcessExpired:
                yield from (Problem(path, UnreadableFileError(f"{path}: {_KILLED}")) for path in part)
        pool.close()
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.join()


def _look_at(paths: Sequence[Path], options: DiscoverOptions) -> list["_File | Problem"]:
    cameras = known_cameras(options.pattern)
    result: list[_File | Problem] = []
    for path in paths:
        try:
            result.append(_examine(path, cameras, options))
        except UnreadableFileError as error:
            result.append(Problem(path, error))
    return result


def _examine(path: Path, cameras: Iterable[Camera], options: DiscoverOptions) -> _File:
    info = probe(path, options.max_pixels)
    tags = read_tags(path)
    # Cameras write one band a file, or photographs: a stack is someone's product, whatever make it carries on.
    *_, generic = cameras
    camera = generic if _is_stack(path, info) else next(c for c in cameras if c.recognises(tags))
    panel = panel_in(tags, (info.width_px, info.height_px))
    bands = (replace(b, panel=panel) for b in camera.bands(path, tags, info) if options.with_rgb or not b.companion)
    return _File(path, camera, tags, tuple(_with_possible_values(b) for b in bands))


def _with_possible_values(band: Band) -> Band:
    """What damaged tags say of a band, and cannot be, is not said."""
    possible = band.radiometry is None or is_physical(band.radiometry, band.size_px)
    return band if possible else replace(band, radiometry=None)


def _is_stack(path: Path, info: RasterInfo) -> bool:
    photograph = info.dtypes[0] == "uint8" and len(info.dtypes) in (3, 4)
    return path.suffix.lower() in TIFF_SUFFIXES and len(info.dtypes) > 1 and not photograph


def _is_whole(file: _File) -> bool:
    """True for a file that is a capture in itself: of several bands, each with a lens of its own."""
    return len(file.bands) > 1 and not file.bands[0].one_lens


def _groups(files: Iterable[_File]) -> list[list[_File]]:
    """Files of one capture: same camera, folder and key."""
    groups: dict[tuple[str, ...], list[_File]] = defaultdict(list)
    for file in files:
        key = file.path.name if _is_whole(file) else file.camera.capture_key(file.path, file.tags)
        groups[(file.camera.name, str(file.camera.capture_folder(file.path)), key)].append(file)
    # A file whose tags are damaged lost its capture id, but not its name.
    with_id: dict[tuple[str, ...], tuple[str, ...]] = {}
    for group_key, group in groups.items():
        names = {f.camera.capture_name(f.path) for f in group}
        if len(names) == 1 and not _is_whole(group[0]) and names != {group_key[-1]}:
            with_id.setdefault((*group_key[:-1], *names), group_key)
    for group_key in list(groups):
        home = with_id.get(group_key)
        if home is not None and not _is_whole(groups[group_key][0]):
            groups[home].extend(groups.pop(group_key))
            groups[home].sort(key=lambda f: _natural(f.path.name))
    return list(groups.values())


def _alike(files: Sequence[_File], options: DiscoverOptions) -> list[Problem]:
    """Names that a pattern takes for the same band of the same capture: it splits them in the wrong place."""
    if options.pattern is None:
        return []
    first: dict[str, Path] = {}
    result = []
    for file in files:
        for name in {b.name for b in file.bands}:
            if first.setdefault(name, file.path) != file.path:
                text = (
                    f"{file.path}: is band '{name}' of one capture with {first[name].name} by the pattern "
                    f"'{options.pattern}'; give one that tells them apart"
                )
                result.append(Problem(file.path, InputError(text)))
    return result


def _capture(folder: Path, files: list[_File], options: DiscoverOptions) -> Capture | Problem:
    # Narrow bands first: the capture is theirs, and the colour photograph's name comes before them.
    files = sorted(files, key=lambda f: f.bands[0].companion)
    bands = [b for file in files for b in file.bands]
    first = files[0]
    if options.bands:
        wanted = {name.lower() for name in options.bands}
        bands = [b for b in bands if b.name.lower() in wanted]
        if len(bands) < 2:
            left = _names(bands) or "nothing"
            return Problem(first.path, InputError(f"{first.path}: of this capture, --bands leaves {left}"))
    if len(bands) > 1 and len(files) == 1 and first.bands[0].one_lens:
        text = f"{first.path}: its bands come through one lens; there is nothing to align"
        return Problem(first.path, InputError(text))
    if len(bands) < 2:
        text = f"{first.path}: a band with no companion; name files '<capture>_<band>.tif' or give --pattern"
        return Problem(first.path, InputError(text))
    bands = first.camera.placed(_with_unique_band_names(bands), [f.tags for f in files])
    if options.ignore_metadata:
        bands = [replace(b, lens=None, to_rig=None, other_to_rig=None) for b in bands]
    try:
        reference = bands[_reference_index(bands, options.reference, first.path)]
    except NoSuchBandError as error:
        return Problem(first.path, error)
    bands = _ordered(bands, options.order)
    # What is said of the capture is said of its reference; a damaged file says nothing.
    tags = next((f.tags for f in files if f.path == reference.path and f.tags != Tags()), first.tags)
    camera = camera_of(tags)
    serials = sorted({f.tags.serial for f in files if f.tags.serial})
    return Capture(
        name=(first.path.stem if len(files) == 1 else first.camera.capture_name(first.path)) or _NAMELESS,
        folder=_below(folder, first.camera.capture_folder(first.path)),
        bands=tuple(bands),
        reference_index=next(i for i, b in enumerate(bands) if b is reference),
        camera=CameraIdentity(tags.make, tags.model, "+".join(serials)),
        capture_id=tags.first_text(camera.capture_ids),
        flight_id=tags.first_text(camera.flight_ids),
        captured_at=tags.captured_at,
        position=tags.position,
        pose=camera.pose(tags),
        motion=camera.motion(tags),
    )


def _reference_index(bands: Sequence[Band], wanted: str | None, path: Path) -> int:
    if wanted is None or wanted.lower() == "auto":
        return default_reference(bands)
    for index, band in enumerate(bands):
        if band.name.lower() == wanted.lower():
            return index
    raise NoSuchBandError(f"{path}: no band '{wanted}' for the reference; this capture has {_names(bands)}")


def _below(folder: Path, of_capture: Path) -> Path:
    """Relative to the input folder, and never above it: bands whose folders lie beside each other may be the input."""
    return of_capture.relative_to(folder) if of_capture.is_relative_to(folder) else Path()


def _names(bands: Sequence[Band]) -> str:
    return ", ".join(b.name for b in bands)


def _ordered(bands: Sequence[Band], order: BandOrder) -> list[Band]:
    if order == "wavelength":
        return sorted(bands, key=lambda b: math.inf if b.wavelength_nm is None else b.wavelength_nm)
    return sorted(bands, key=lambda b: _natural(b.name)) if order == "name" else list(bands)


def _with_unique_band_names(bands: Sequence[Band]) -> list[Band]:
    """The bands, renamed where a name repeats: the first band keeps it, the others get the next free number."""
    taken = {b.name for b in bands}
    kept: set[str] = set()
    unique = []
    for band in bands:
        name = band.name
        if name in kept:
            name = next(n for k in count(2) if (n := f"{band.name}-{k}") not in taken)
        taken.add(name)
        kept.add(name)
        unique.append(replace(band, name=name))
    return unique


def _names_of_files(captures: Sequence[Capture]) -> dict[str, str]:
    """{file below the output folder that a layout of single bands may write, without suffix: its capture's label}."""
    return {
        (c.folder / b.path.stem).as_posix().lower(): c.label
        for c in captures if len({b.path for b in c.bands}) > 1 for b in c.bands
    }  # fmt: skip


def _with_unique_names(captures: Sequence[Capture], files: Mapping[str, str] = MappingProxyType({})) -> list[Capture]:
    """Two captures of one folder must not write the same file, neither their own nor a band's of the other, nor one of
    the run's: the later one gets a number.
    """
    taken = set(_NAMES_OF_THE_RUN)
    counts: Counter[str] = Counter()
    unique = []
    for capture in captures:
        given = capture
        while given.label.lower() in taken or files.get(given.label.lower(), capture.label) != capture.label:
            counts[capture.label.lower()] += 1
            given = replace(capture, name=f"{capture.name}-{counts[capture.label.lower()] + 1}")
        taken.add(given.label.lower())
        unique.append(given)
    return unique


def _with_missing_bands(captures: Sequence[Capture]) -> list[Capture]:
    """What other captures of the same kind have and this one lacks."""

    # A dual camera that lost all bands of one half has lost a serial number too: so it is the model that counts, and
    # where no tag names one, the folder. Multiband files are each complete in themselves.
    def family(capture: Capture) -> tuple[str, ...]:
        camera = capture.camera
        return (camera.make, camera.model) if camera.model else (capture.folder.as_posix(),)

    separate = {c.label for c in captures if len({b.path for b in c.bands}) > 1}
    members: Counter[tuple[str, ...]] = Counter()
    seen: dict[tuple[str, ...], Counter[str]] = defaultdict(Counter)
    for capture in captures:
        if capture.label in separate:
            members[family(capture)] += 1
            seen[family(capture)].update(b.name for b in capture.bands)
    # A band that most captures do not have is a name that damaged tags have made up.
    usual = {f: [n for n, count in names.items() if 2 * count >= members[f]] for f, names in seen.items()}
    complete = []
    for capture in captures:
        known = {b.name for b in capture.bands}
        missing = tuple(n for n in usual[family(capture)] if n not in known) if capture.label in separate else ()
        complete.append(replace(capture, missing_bands=missing) if missing else capture)
    return complete
