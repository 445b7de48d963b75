"""Grouping of image files into captures: its files, reference band, missing bands and unique names."""

import hashlib
import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from filecmp import cmp as same_bytes
from itertools import count, product
from pathlib import Path

from agalign.cameras import dji, pix4d
from agalign.cameras.base import Camera, colour_bands, reference_index
from agalign.cameras.generic import Generic, split_elsewhere, split_stem
from agalign.cameras.image_file import ImageFile, Problem, natural_order, problem_of
from agalign.cameras.makers import camera_of
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import band_at, lacking
from agalign.cameras.xmp import names_in
from agalign.config import DiscoverOptions
from agalign.errors import InputError, Reason, UnreadableFileError
from agalign.host.files import PANELS_FILE, REPORT_FILE, RUN_FILE, SKY_FILE, SUMMARY_FILE
from agalign.host.text import counted, shortened, some_of
from agalign.pixels.raster import suffix_format
from agalign.values.band_names import is_band_name, own_stem
from agalign.values.capture import Band, CameraIdentity, Capture, CaptureTime, Pose
from agalign.values.spectrum import band_key

_GroupKey = tuple[str, str, str]
"""(camera, folder of the capture, the camera's capture key)."""
_LENS_CALIBRATION = (
    *names_in(pix4d.NAMESPACE, "PrincipalPoint PerspectiveDistortion RigRelatives FisheyePolynomial"),
    *names_in(dji.NAMESPACE, "DewarpData CalibratedHMatrix RelativeOpticalCenterX RelativeOpticalCenterY"),
)
"""XMP values that a maker measures on each camera."""
_MAX_HALVES_APART = timedelta(seconds=1)
"""Between the exposures of a dual camera, which are simultaneous; an id may occur again in another flight."""
_NUMBER_OF_BAND = re.compile(r"[a-z]?\d{1,2}", re.IGNORECASE)
_BEFORE_SUFFIX = "-.~@+_"
"""Characters before what synchronisation and users add to the names of copies, besides spaces and brackets."""


def without_copies(files: Sequence[ImageFile]) -> tuple[list[ImageFile], list[Problem]]:
    """Return the files that are not copies of others, and a problem for each copy.

    A copy agrees with a file of a shorter name in two of three respects: its name contains that of the other file, as
    file managers, browsers and synchronisation make it in all languages ('IMG_1 - Copy.tif', 'IMG_1 copie 2.tif',
    'IMG_1 (1).tif', 'Copy of IMG_1.tif', 'IMG_1.sync-conflict-20210827.tif', 'IMG_1-HOST.tif'); its bands and capture
    id in the tags; its bytes. Without an id, the name of a single band with a suffix is that of a copy.
    """
    kept: dict[object, ImageFile] = {}
    copies: dict[Path, Problem] = {}
    # A file that was copied over one of another capture has the name of the wrong siblings.
    names = {f.path: (f.capture_id, f.camera.capture_name(f.path)) for f in files if f.capture_id}
    of_name = Counter(names.values())
    siblings = {path: of_name[name] for path, name in names.items()}
    for file in sorted(files, key=lambda f: (-siblings.get(f.path, 0), len(f.path.name), natural_order(f.path.name))):
        folder, bands = file.camera.capture_folder(file.path), tuple(b.name for b in file.bands)
        by_tags = (folder, file.capture_id, bands) if file.capture_id else file.path
        for original in (kept[key] for key in (by_tags, *_paths_in_name(file.path)) if key in kept):
            is_exact = same_bytes(original.path, file.path, shallow=False)
            if is_exact:
                text = f"is left out, because it is a copy of {original.path.name}"
            elif original.path in _paths_in_name(file.path) and (
                original is kept.get(by_tags) if file.capture_id else _is_plain_name(original, file.path)
            ):
                text = f"is left out as a changed copy of {original.path.name}: same band and capture; keep one of them"
            else:
                continue
            copies[file.path] = problem_of(file.path, text, is_harmless=is_exact)
            break
        else:
            kept.setdefault(by_tags, file)
            kept[file.path] = file
    return [f for f in files if f.path not in copies], list(copies.values())


def join_folders(groups: Sequence[list[ImageFile]]) -> tuple[list[list[ImageFile]], list[Problem]]:
    """Return the files of each capture, with those of other folders that belong to it, and a problem for each folder
    with copies, which are left out.

    Files belong to a capture with the same id and time: the halves of a dual camera, which write to a card each, and
    copies of folders. Without an id, copies have the same names and bytes. The folder with the shortest path is kept.
    """
    kept: dict[object, list[list[ImageFile]]] = defaultdict(list)
    copies: dict[tuple[Path, Path], _CopiedFolder] = defaultdict(_CopiedFolder)
    for group in sorted(groups, key=lambda g: (len(str(g[0].path.parent)), natural_order(str(g[0].path)))):
        capture_id, here = group[0].capture_id, group[0].path.parent
        files = [(f.path.name, f.path.stat().st_size) for f in group]
        of_key = kept[(group[0].camera.name, capture_id) if capture_id else (_end_of(group[0].path), *files)]
        is_one = _is_of_one_moment if capture_id else _has_same_bytes
        elsewhere = [o for o in of_key if o[0].path.parent != here and is_one(o, group)]
        if not elsewhere:
            of_key.append(group)
            continue
        original = elsewhere[0]
        names = {f.path.stem for f in original} | {b.name for f in original for b in f.bands}
        new = [f for f in group if names.isdisjoint((f.path.stem, *(b.name for b in f.bands)))]
        if len(new) < len(group):
            known = {(f.path.name, f.path.stat().st_size) for f in original}
            used = [f.path.name for f in new]
            copy = copies[here, original[0].path.parent]
            copy.captures += 1
            copy.used += used
            copy.different += [name for name, size in files if name not in used and (name, size) not in known]
        original[:] = sorted((*original, *new), key=lambda f: natural_order(f.path.name))
        group.clear()
    problems = [
        problem_of(here, copy.sentence(there), is_harmless=not copy.different) for (here, there), copy in copies.items()
    ]
    # Colour photographs come last.
    return [sorted(group, key=lambda f: f.bands[0].is_from_photograph) for group in groups if group], problems


def _is_plain_name(original: ImageFile, copy: Path) -> bool:
    """Return True for a file with the name of a band, which another name has with a suffix, as programs name copies."""
    has_band = bool(split_stem(own_stem(original.path))[1]) and len(original.bands) == 1
    added = copy.stem.removeprefix(original.path.stem)
    # Without tags, an underscore may separate parts of a name that has no band.
    is_suffix = added != copy.stem and added[:1] != "_" and not is_band_name(split_stem(copy.stem)[1])
    return original.path.stem == own_stem(copy) or (has_band and is_suffix)


@dataclass
class _CopiedFolder:
    """What a folder has of captures that are in another folder too."""

    captures: int = 0
    """Number of such captures."""
    used: list[str] = field(default_factory=list)
    """Names of files that the other folder lacks."""
    different: list[str] = field(default_factory=list)
    """Names of files that the other folder has under another name or with another size."""

    def sentence(self, other: Path) -> str:
        """Return in words what is left out and what is used, given the other folder."""
        text = f"left out {counted(self.captures, 'capture')} that {other} has"
        if self.used:
            text += f", except for {counted(len(self.used), 'file')} that it lacks: {some_of(self.used)}"
        if self.different:
            differ = "differs" if len(self.different) == 1 else "differ"
            text += f"; {counted(len(self.different), 'file')} {differ} in name or size: {some_of(self.different)}; "
            text += "keep one of the folders"
        return text


def _is_of_one_moment(one: Sequence[ImageFile], other: Sequence[ImageFile]) -> bool:
    before, now = (CaptureTime.of(files[0].tags.captured_at) for files in (one, other))
    return before == now or bool(before and now and abs(before.utc - now.utc) < _MAX_HALVES_APART)


def _has_same_bytes(one: Sequence[ImageFile], other: Sequence[ImageFile]) -> bool:
    """Return True for copies of a capture; a single band is none."""
    same = (same_bytes(a.path, b.path, False) for a, b in zip(one, other, strict=True))
    return (len(one) > 1 or one[0].is_whole_capture) and all(same)


def _end_of(path: Path) -> bytes:
    """Return the last 4096 bytes of a file, which distinguish most images of equal name and size."""
    with path.open("rb") as file:
        file.seek(-min(4096, path.stat().st_size), os.SEEK_END)
        return file.read()


def _paths_in_name(path: Path) -> list[Path]:
    """Return the files that this one may be a copy of.

    Their names are the part of its own name before or after a space or bracket, or before another separator if the text
    after it does not name a band.
    """
    stem = path.stem
    is_band = is_band_name(split_stem(stem)[1])  # f_red-edge is a band, not a copy of f_red
    places = [] if is_band else [i for i, c in enumerate(stem) if c in _BEFORE_SUFFIX]
    parts = [stem[:i] for i in places if not _NUMBER_OF_BAND.fullmatch(stem[i + 1 :])]
    parts += [part for i, c in enumerate(stem) if c in " (" for part in (stem[:i], stem[i + 1 :])]
    return [path.with_name(part + path.suffix) for part in parts if part]


def with_tags_of_flight(files: Sequence[ImageFile]) -> tuple[list[ImageFile], list[Problem]]:
    """Return the files, and a problem for each with a damaged XMP packet that lacks tags.

    The tags that a packet should have are those in its own text, and those of an intact file of the same camera and
    band: one with the same end of the name, such as `_2` or `_NIR`. From this file comes a missing name of a band.
    """
    intact = {key: f for f in reversed(files) if f.tags.unread is None for key in _similar(f)}
    result, problems = list(files), []
    for i, file in enumerate(files):
        if file.tags.unread is None:
            continue
        of_band, of_camera = (intact.get(key) for key in _similar(file))
        lacking = dict.fromkeys(file.tags.unread)
        if similar := of_band or of_camera:
            lacking |= dict.fromkeys(name for key, name in similar.tags.xmp if (key, name) not in file.tags.xmp)
        if lacking:
            text = f"its XMP packet is damaged and lacks {some_of(lacking)}; copy the file from the card again"
            problems.append(problem_of(file.path, text, is_harmless=True))
        if "BandName" in lacking and of_band is not None and len(file.bands) == len(of_band.bands) == 1:
            (own,), (band,) = file.bands, of_band.bands
            own = replace(own, name=band.name, wavelength_nm=band.wavelength_nm, bandwidth_nm=band.bandwidth_nm)
            result[i] = replace(file, bands=(own,))
    return result, problems


def _similar(file: ImageFile) -> tuple[object, object]:
    """Keys that files of the same camera and band, and of the same camera, share."""
    camera = file.camera.name, file.tags.make, file.tags.model, suffix_format(file.path)
    return (*camera, file.name_end), camera


def group_files(files: Iterable[ImageFile], *, with_rgb: bool = False) -> list[list[ImageFile]]:
    """Return the files of each capture: same camera, folder and key.

    Those in TIFFs next to bands of the same capture are left out unless `with_rgb`, as other photographs are.
    """
    groups: dict[_GroupKey, list[ImageFile]] = defaultdict(list)
    for file in files:
        key = file.path.name if file.is_whole_capture else file.camera.capture_key(file.path, file.tags)
        groups[file.camera.name, str(file.camera.capture_folder(file.path)), key].append(file)
    _join_photographs(groups, with_rgb=with_rgb)
    _add_files_without_id(groups)
    _drop_copies(groups)
    return list(groups.values())


def with_bands_of_names(files: Sequence[ImageFile]) -> list[ImageFile]:
    """Return the files, those of single bands without tags with the band of their folder or of the beginning of their
    name, if names of other bands agree otherwise: nir/7.tif and red/7.tif, or NIR07.tif and RED07.tif.
    """
    result = {file.path: file for file in files}
    for layout in ("start", "folder"):
        camera = Generic(layout=layout)
        captures: dict[tuple[Path, str], dict[str, list[ImageFile]]] = defaultdict(lambda: defaultdict(list))
        for file in (f for f in files if f.camera.has_free_names and len(f.bands) == 1):
            if (parts := split_elsewhere(file.path, layout)) is not None:
                captures[camera.capture_folder(file.path), parts[0]][band_key(parts[1])].append(file)
        several = [(folder, name) for (folder, name), found in captures.items() if len(found) > 1]
        numbered = Counter(folder for folder, _ in several)
        for folder, name in several:
            # A number alone may be that of a band: red1.tif, red2.tif.
            is_sure = layout == "folder" or not name.isdecimal() or numbered[folder] > 1
            found = [files_of_band for files_of_band in captures[folder, name].values() if is_sure]
            if layout == "folder" and len({file.path.parent for of_band in found for file in of_band}) == 1:
                continue  # a folder that happens to have the name of a band
            for file in (of_band[0] for of_band in found if max(map(len, found)) == 1):
                bands = camera.bands(file.path, file.tags, [replace(file.bands[0], name="")])
                result[file.path] = replace(file, camera=camera, bands=bands)
    return list(result.values())


def _join_photographs(groups: dict[_GroupKey, list[ImageFile]], *, with_rgb: bool) -> None:
    """Join colour TIFFs with the single bands of the same capture name, or remove them."""
    for key, (file, *_) in list(groups.items()):
        colours = [b.name for b in file.bands] == ["Red", "Green", "Blue"]
        named = re.sub(r"[ _-]?(rgb|vis)$", "", file.path.stem, flags=re.IGNORECASE)
        if colours and file.is_whole_capture and (bands := groups.get((key[0], key[1], named))):
            del groups[key]
            bands += [replace(file, bands=colour_bands(file.bands))] if with_rgb else []


def _add_files_without_id(groups: dict[_GroupKey, list[ImageFile]]) -> None:
    """Move files without a capture id to the group with one and the same capture name: files with a damaged id, then
    single bands without tags, which another program removed.
    """
    by_name: dict[_GroupKey, list[_GroupKey]] = defaultdict(list)
    for key, group in groups.items():
        for name in {f.camera.capture_name(f.path) for f in group if not f.is_whole_capture}:
            by_name[key[0], key[1], name].append(key)
    cameras = {key[0]: group[0].camera for key, group in groups.items() if key[0] != Generic.name}
    for key in sorted(groups, key=lambda key: key[0] == Generic.name):
        for file in list(groups[key]):
            if key[0] != Generic.name:
                names = [] if file.is_whole_capture else [key]
            elif file.tags.make or file.tags.xmp or len(file.bands) != 1 or not _is_tiff(file):
                names = []
            else:
                of_cameras = [(name, key[1], camera.capture_name(file.path)) for name, camera in cameras.items()]
                names = [name for name in of_cameras if name[2] != file.path.stem]
            targets = [k for name in names for k in by_name.get(name, ()) if k in groups and k != key]
            if len(targets) == 1 or (targets and key[0] != Generic.name):
                groups[key].remove(file)
                joined = groups[targets[0]]
                joined.append(_with_camera(file, joined[0].camera))
                joined.sort(key=lambda f: natural_order(f.path.name))
        if not groups[key]:
            del groups[key]


def _with_camera(file: ImageFile, camera: Camera) -> ImageFile:
    """The file as one of a camera whose tags it lacks: a number that is its band's name is not the whole name."""
    if file.camera.name != Generic.name:
        return file
    band = file.bands[0]
    named = replace(band, name=f"band_{band.name}") if band.name.isdecimal() else band
    return replace(file, camera=camera, bands=(named,))


def _drop_copies(groups: dict[_GroupKey, list[ImageFile]]) -> None:
    """Drop JPEG and PNG copies of bands, which programs leave as quick looks: next to the TIFFs of the same bands, and
    alone if there are other captures.
    """
    for key, group in list(groups.items()):
        in_tiff = {f.camera.split(f.path)[1].lower() for f in group if _is_tiff(f) and isinstance(f.camera, Generic)}
        groups[key] = [f for f in group if not (_is_picture_band(f) and f.bands[0].name.lower() in in_tiff)]
    alone = {k for k, group in groups.items() if len(group) == 1 and _is_picture_band(group[0])}
    if len(alone) < len(groups):
        for key in alone:
            del groups[key]


def _is_tiff(file: ImageFile) -> bool:
    return suffix_format(file.path) == "TIFF"


def _is_picture_band(file: ImageFile) -> bool:
    """True for a JPEG or PNG with the name of a band."""
    return file.camera.name == Generic.name and not _is_tiff(file) and not file.bands[0].is_from_photograph


def pattern_clashes(files: Sequence[ImageFile], pattern: str) -> Iterator[Problem]:
    """Yield the files of one capture that a pattern assigns to the same band: it splits their names wrongly."""
    first: dict[str, Path] = {}
    for file in files:
        for name in {b.name for b in file.bands}:
            if first.setdefault(name, file.path) != file.path:
                what = f"is band '{name}' of one capture with {first[name].name} by the pattern '{pattern}'"
                yield problem_of(file.path, f"{what}; give one that distinguishes them")


def capture_of(files: Sequence[ImageFile], folder: Path, options: DiscoverOptions) -> Capture:
    """Return the capture of a group of files below the input `folder`.

    Raises InputError if fewer than two bands remain, NoSuchBandError if the reference band is missing.
    """
    first = files[0]
    bands = with_unique_band_names(_bands_to_align(files, options.bands))
    bands = first.camera.with_shared_rig(bands, [f.tags for f in files])
    if options.ignore_metadata:
        bands = [replace(b, lens=None, to_rig=None, other_to_rig=None) for b in bands]
    reference = bands[reference_index(bands, options.reference, first.path)]
    if options.order == "wavelength":
        bands.sort(key=lambda b: math.inf if b.wavelength_nm is None else b.wavelength_nm)
    elif options.order == "name":
        bands.sort(key=lambda b: natural_order(b.name))
    tags = _tags_of(reference, files)
    camera = camera_of(tags)
    serials = sorted({f.tags.serial for f in files if f.tags.serial})
    folders, own_folder = {f.path.parent for f in files}, first.camera.capture_folder(first.path)
    if len(folders) > 1 and all(is_band_name(p.name) for p in folders):
        own_folder = first.path.parent.parent  # above the input if that is the folder of one band
    wanted = {band_key(name) for name in options.bands}
    missing = lacking(tags.model, [(f.name_end, f.bands[0]) for f in files if tags.model and len(files) > 1])
    return Capture(
        name=(first.path.stem if len(files) == 1 else first.camera.capture_name(first.path)) or "capture",
        root=folder,
        folder=own_folder.relative_to(folder) if own_folder.is_relative_to(folder) else Path(),
        bands=tuple(bands),
        reference_index=next(i for i, b in enumerate(bands) if b is reference),
        camera=CameraIdentity.of(tags.make, tags.model, serials),
        capture_id=shortened(tags.first_text(camera.capture_ids)),
        flight_id=shortened(tags.first_text(camera.flight_ids)),
        captured_at=camera.captured_at(tags),
        position=tags.position,
        pose=_pose(camera, tags, next((f for f in files if f.path == reference.path), first)),
        motion=camera.motion(tags),
        missing_bands=tuple(name for name in missing if not wanted or band_key(name) in wanted),
        elevation_deg=camera.elevation_deg(tags),
    )


def _pose(camera: Camera, tags: Tags, file: ImageFile) -> Pose | None:
    """The pose by the tags of a file, with the focal length in pixels of its image."""
    pose = camera.pose(tags)
    if pose is None or pose.focal_length_px is None:
        return pose
    return replace(pose, focal_length_px=None if file.has_other_lens else pose.focal_length_px * file.scale.mean)


def _tags_of(reference: Band, files: Sequence[ImageFile]) -> Tags:
    """The tags that describe the capture: those of the reference, or of the first file if these are damaged."""
    with_tags = [f for f in files if f.tags != Tags()]
    first = with_tags[0].tags if with_tags else files[0].tags
    tags = next((f.tags for f in with_tags if f.path == reference.path), first)
    if tags.unread is None:
        return tags
    return replace(tags, xmp={k: v for f in reversed(files) for k, v in f.tags.xmp.items()} | dict(tags.xmp))


def companion_advice(path: Path) -> str:
    """Return what to do about a file that is the only band of its capture."""
    capture, _, band = path.stem.rpartition("_")
    if capture and band:
        return f"copy the other files of {capture} from the card, or give --pattern"
    return "name files '<capture>_<band>.tif' or give --pattern"


def _bands_to_align(files: Sequence[ImageFile], names: Sequence[str]) -> list[Band]:
    """The bands with these names, ignoring case, or all. Raises InputError if there is nothing to align."""
    first = files[0]
    wanted = {band_key(name) for name in names}
    bands = [b for file in files for b in file.bands if not wanted or band_key(b.name) in wanted]
    if len(bands) < 2 and names:
        left = bands[0].name if bands else "nothing"
        raise InputError(f"{first.path}: of this capture, --bands leaves {left}")
    if len(bands) < 2:
        raise InputError(f"{first.path}: a band with no companion; {companion_advice(first.path)}")
    if len(files) == 1 and first.bands[0].one_lens:
        other = " (a second camera needs files of the same names in another folder, named by its filter)"
        advice = other if first.camera.has_one_lens(first.tags) else ""
        raise InputError(f"{first.path}: its bands come through one lens; there is nothing to align{advice}")
    return bands


def with_missing_bands(captures: Sequence[Capture]) -> list[Capture]:
    """Return the captures with the bands of their camera, which at least half of its captures have: rarer names come
    from damaged tags. Those that a capture lacks, and those that the camera is known to record, are its
    `missing_bands`.

    A multiband file has no missing bands. A capture of a dual camera without files of one half gets the serial numbers
    of both.
    """
    result: dict[str, Capture] = {}
    for of_camera in _by_camera(captures):
        identities = {c.camera for c in of_camera}
        usual = _camera_bands([c for c in of_camera if c.has_several_files])
        for capture in of_camera:
            bands = usual if capture.has_several_files else ()
            own = {band_key(b.name) for b in capture.bands}
            lacking = [b.name for b in bands if band_key(b.name) not in own]
            missing = tuple({band_key(name): name for name in (*capture.missing_bands, *lacking)}.values())
            identity = _complete(capture.camera, identities)
            result[capture.label] = replace(capture, missing_bands=missing, camera_bands=bands, camera=identity)
    return [result[capture.label] for capture in captures]


def with_unreadable_bands(
    captures: Sequence[Capture], files: Sequence[ImageFile], problems: Iterable[Problem]
) -> list[Capture]:
    """Return the captures with the reasons why files of their missing bands cannot be read. The name of such a file
    tells its capture and, by the readable `files` or what is known of the camera, its band.
    """
    if not (unreadable := {p.path: p.error for p in problems if isinstance(p.error, UnreadableFileError)}):
        return list(captures)
    names = {_place(f.path, f.camera): f.bands[0].name for f in files if len(f.bands) == 1}
    cameras = {file.path: file.camera for file in files}
    of_captures: dict[tuple[Camera, Path, str], list[Path]] = defaultdict(list)
    for camera, file in product(set(cameras.values()), unreadable):
        of_captures[camera, camera.capture_folder(file), camera.capture_name(file)].append(file)
    result = []
    for capture in captures:
        path = capture.reference.path
        camera = cameras[path]
        of_capture = of_captures[camera, camera.capture_folder(path), camera.capture_name(path)]
        missing, reasons = {band_key(name): name for name in capture.missing_bands}, dict[str, Reason]()
        for file in of_capture if capture.has_several_files else ():
            without_tags = replace(capture.reference, name="", path=file, wavelength_nm=None)
            found = [names.get(_place(file, camera), ""), band_at(capture.camera.model, camera.name_end(file))]
            found += [band.name for band in camera.bands(file, Tags(), (without_tags,))]
            for own in map(band_key, found):
                if own in missing:
                    what, remedy = unreadable[file].reason
                    reasons[missing[own]] = Reason(f"{file.name}: {what.removeprefix(f'{file}: ')}", remedy)
                    break
        result.append(replace(capture, unreadable_bands=reasons) if reasons else capture)
    return result


def _place(path: Path, camera: Camera) -> tuple[str, Path, str]:
    """What distinguishes the file of a band from those of the other bands of a capture."""
    return camera.name, path.parent.relative_to(camera.capture_folder(path)), camera.name_end(path)


def _camera_bands(captures: Sequence[Capture]) -> tuple[Band, ...]:
    """The usual bands of a camera without their files, in the order of the most complete captures: a band that these
    lack follows the one that it follows in others.
    """
    usual, order = set(usual_bands(captures)), list[str]()
    found: dict[str, Band] = {}
    for capture in sorted(captures, key=lambda c: -len(usual.intersection(b.name for b in c.bands))):
        position = 0
        for band in (b for b in capture.bands if b.name in usual):
            if band.name not in found:
                order.insert(position, band.name)
                about = band.wavelength_nm, band.bandwidth_nm
                found[band.name] = Band(
                    band.name, Path(), 1, *band.size_px, band.dtype, wavelength_nm=about[0], bandwidth_nm=about[1]
                )
            position = order.index(band.name) + 1
    return tuple(found[name] for name in order)


def usual_bands(captures: Sequence[Capture]) -> list[str]:
    """Return the names of the bands that at least half of the captures have."""
    counts = Counter(b.name for c in captures for b in c.bands)
    return [name for name, n in counts.items() if 2 * n >= len(captures)]


def _by_camera(captures: Sequence[Capture]) -> list[list[Capture]]:
    """The captures of each camera: of a make, model and serial numbers, or of a folder if no tag names a model.

    Captures of one model that share a serial number are of one camera: a dual camera has two serial numbers, and a
    capture without files of one half has one of them. A capture without a serial number belongs to the only camera of
    its model.
    """
    cameras: dict[tuple[str, str], list[frozenset[str]]] = defaultdict(list)
    for capture in captures:
        own = capture.camera.serials
        same_model = cameras[capture.camera.make, capture.camera.model]
        sharing = [known for known in same_model if known & own]
        if own:
            same_model[:] = [*(known for known in same_model if known not in sharing), own.union(*sharing)]
    result: dict[object, list[Capture]] = defaultdict(list)
    for capture in captures:
        make, model, own = capture.camera.make, capture.camera.model, capture.camera.serials
        same_model = cameras[make, model]
        known = [serials for serials in same_model if serials & own or (not own and len(same_model) == 1)]
        result[(make, model, known[0] if known else own) if model else capture.folder].append(capture)
    return list(result.values())


def with_cameras_apart(captures: Sequence[Capture], groups: Sequence[Sequence[ImageFile]]) -> list[Capture]:
    """Return the captures, those of a model without serial numbers with their lens calibration in the camera's identity
    if it differs between captures: two cameras of one model. `groups` are the files of captures.
    """
    tags_of = {file.path: file.tags for group in groups for file in group}
    calibrations = [_lens_calibration(tags_of[c.reference.path]) for c in captures]
    by_model: dict[tuple[object, ...], set[str]] = defaultdict(set)
    models = [(c.camera.make, c.camera.model, c.reference.name, c.reference.size_px) for c in captures]
    for model, calibration in zip(models, calibrations, strict=True):
        by_model[model] |= {calibration} - {""}
    return [
        replace(c, camera=replace(c.camera, lens_calibration=calibration))
        if c.camera.model and not c.camera.serial and len(by_model[model]) > 1
        else c
        for c, model, calibration in zip(captures, models, calibrations, strict=True)
    ]


def _lens_calibration(tags: Tags) -> str:
    """A checksum of the tags of the lens and the rig, which the maker calibrates; empty without any, or if some may be
    lost in a damaged packet.
    """
    if tags.unread is not None:
        return ""
    values = [text for name in _LENS_CALIBRATION if (text := tags.text(*name))]
    return hashlib.sha256("\n".join(values).encode()).hexdigest()[:8] if values else ""


def _complete(camera: CameraIdentity, same: set[CameraIdentity]) -> CameraIdentity:
    """The camera with the serial numbers of both halves, if a capture has one of them, and the others of the camera
    have the same pair.
    """
    larger = {one.serial for one in same if camera.serials and camera.serials < one.serials}
    return replace(camera, serial=larger.pop()) if len(larger) == 1 else camera


def with_unique_band_names(bands: Sequence[Band]) -> list[Band]:
    """Return the bands with unique names: the first band keeps a repeated name, the others get a number."""
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


def band_file_owners(captures: Sequence[Capture]) -> dict[str, str]:
    """Return the label of the capture by the band files that it may write, without suffix, below the output folder."""
    return {
        (c.folder / b.path.stem).as_posix().lower(): c.label for c in captures if c.has_several_files for b in c.bands
    }


def with_unique_capture_names(captures: Sequence[Capture], file_owners: Mapping[str, str]) -> list[Capture]:
    """Return the captures with a number added to names that are those of an earlier capture, of a file of the run, or
    of another capture's band file. `file_owners` is from `band_file_owners`, or empty without band files.
    """
    taken = {Path(file).stem for file in (RUN_FILE, PANELS_FILE, SKY_FILE, SUMMARY_FILE, REPORT_FILE)}
    counts: Counter[str] = Counter()
    unique = []
    for capture in captures:
        renamed = capture
        while renamed.label.lower() in taken or file_owners.get(renamed.label.lower(), capture.label) != capture.label:
            counts[capture.label.lower()] += 1
            renamed = replace(capture, name=f"{capture.name}-{counts[capture.label.lower()] + 1}")
        taken.add(renamed.label.lower())
        unique.append(renamed)
    return unique
