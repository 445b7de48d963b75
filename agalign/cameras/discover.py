"""The captures below a folder, and the image files in it, without those in output folders of earlier runs; the captures
of georeferenced mosaics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from agalign.cameras import consistency, grouping, image_search
from agalign.cameras.base import reference_index
from agalign.cameras.camera_calibration import different_calibrations, with_complete_calibrations
from agalign.cameras.generic import Generic
from agalign.cameras.image_file import ImageFile, OwnFile, Problem, problem_of, with_one_spelling
from agalign.cameras.metadata import read_tags
from agalign.cameras.read_files import read_files
from agalign.config import DiscoverOptions
from agalign.errors import ConfigurationError, GeometryError, InputError, NoSuchBandError
from agalign.host.text import counted
from agalign.pixels.coordinates import metres_per_unit, transformed
from agalign.pixels.raster import IMAGE_KINDS, probe, suffix_format
from agalign.values import geometry
from agalign.values.arguments import checked
from agalign.values.band_names import no_such_band
from agalign.values.capture import Band, Capture, Position, distance_km
from agalign.values.choices import MAX_MOSAIC_PIXELS
from agalign.values.spectrum import band_key

__all__ = ["DiscoverOptions", "FolderScan", "Problem", "discover"]


@dataclass(frozen=True)
class FolderScan:
    """The captures and the problems below a folder, as `discover` returns them.

    Examples
    --------
    >>> flight = agalign.discover("flight")
    >>> len(flight.captures), flight.problems, flight.is_complete
    (2, (), True)
    """

    folder: Path
    """The input folder."""
    captures: tuple[Capture, ...]
    """Sorted by folder and name."""
    problems: tuple[Problem, ...]
    """Files and captures that are skipped, or used with fewer tags: each has a `path`, an `error` and a `text`."""

    @property
    def is_complete(self) -> bool:
        """False if a file or capture is skipped that may be an image of the flight, or cannot be read."""
        return all(p.is_harmless for p in self.problems)

    @property
    def eight_bit(self) -> tuple[Capture, ...]:
        """The captures with a file per band and 8 bits per pixel in each band."""
        return tuple(
            c
            for c in self.captures
            if c.has_several_files and all(b.dtype == "uint8" for b in c.bands) and not any(b.one_lens for b in c.bands)
        )


@checked
def discover(folder: str | Path, options: DiscoverOptions | None = None) -> FolderScan:
    """Find the captures below a folder: the bands, the camera, and the metadata from the tags of the files.

    Output folders of earlier runs are skipped, and files that agalign wrote. Pixels are not read.

    Parameters
    ----------
    folder
        Input folder, with subfolders.
    options
        Selection of files and bands. By default all images.

    Returns
    -------
    FolderScan
        `captures`, sorted by folder and name, and `problems` of files that are skipped or used with fewer tags.

    Raises
    ------
    InputError
        `folder` does not exist, is not local, or contains no image that `options` selects.
    ConfigurationError
        `options.pattern` matches no file, or `options.bands` leaves fewer than two bands of each capture.
    NoSuchBandError
        No capture has a band that `options` names.

    Examples
    --------
    >>> flight = agalign.discover("flight")
    >>> capture = flight.captures[0]
    >>> len(flight.captures), capture.label, [band.name for band in capture.bands]
    (2, '0000SET/000/IMG_0001', ['Blue', 'Green', 'Red', 'NIR', 'Red edge'])
    """
    folder, options = Path(folder), options or DiscoverOptions()
    image_search.check_folder(folder)
    paths, problems = _chosen_images(folder, options)
    files, copies = grouping.without_copies(_read(paths, options, problems))
    files, damaged = grouping.with_tags_of_flight(files)
    files = with_complete_calibrations(with_one_spelling(grouping.with_bands_of_names(files)))
    captures: list[Capture] = []
    groups, copied = grouping.join_folders(grouping.group_files(files, with_rgb=options.with_rgb))
    problems += copies + copied + damaged
    problems += chain(consistency.list_problems(files), consistency.doubtful_files(files))
    problems += chain(consistency.contradictions(groups), consistency.exposed_apart(groups))
    problems += chain(different_calibrations(files), consistency.of_other_captures(groups))
    problems += consistency.files_of_one_band(groups) if options.pattern is None else []
    _check_bands(groups, options.bands, folder)
    for group in groups:
        if options.pattern is not None:
            problems += grouping.pattern_clashes(group, options.pattern)
        try:
            captures.append(grouping.capture_of(group, folder, options))
        except (InputError, NoSuchBandError) as error:
            problems.append(Problem(group[0].path, error))
    if not captures:
        _check_pattern(options.pattern, paths, folder)
        for unknown_band in (p.error for p in problems if isinstance(p.error, NoSuchBandError)):
            raise unknown_band
    captures = grouping.with_cameras_apart(captures, groups)
    captures.sort(key=lambda c: (c.folder.as_posix(), c.name))
    captures = grouping.with_unique_capture_names(captures, grouping.band_file_owners(captures))
    captures = grouping.with_missing_bands(captures)
    captures = grouping.with_unreadable_bands(captures, files, problems)
    problems += consistency.far_from_flight(captures)
    return FolderScan(folder, tuple(captures), tuple(problems))


def _chosen_images(folder: Path, options: DiscoverOptions) -> tuple[list[Path], list[Problem]]:
    """(the images to read, problems of folders that cannot be listed). Raises InputError without images."""
    images, problems = image_search.image_files(folder, options.skip)
    images, companions = image_search.without_companions(images, folder)
    problems += companions
    paths = [p for p in images if image_search.is_chosen(p.relative_to(folder), options.include, options.exclude)]
    if not paths and problems:
        raise problems[0].error
    if images and not paths:
        globs = " and ".join(f"--{name} '{glob}'" for name in ("include", "exclude") for glob in getattr(options, name))
        such_as = images[0].relative_to(folder).as_posix()
        raise InputError(f"{folder}: none of {len(images)} images, such as {such_as}, passes {globs}")
    if not paths:
        others = ", ".join(f"{count} {suffix}" for suffix, count in image_search.other_files(folder).most_common(5))
        only = f"; there are only {others}" if others else ""
        raise InputError(f"{folder}: no {IMAGE_KINDS} file in it or below it{only}")
    return paths, problems


def _read(paths: Sequence[Path], options: DiscoverOptions, problems: list[Problem]) -> list[ImageFile]:
    """The files that contain a band; files that cannot be read are added to `problems`."""
    files, own = list[ImageFile](), list[Path]()
    generic = Generic(options.pattern)
    for result in read_files(paths, options):
        is_photograph = suffix_format(result.path) in ("JPEG", "PNG") and not generic.is_named_as_band(result.path)
        if isinstance(result, ImageFile):
            files += [result] if result.bands else []
        elif isinstance(result, OwnFile):
            own.append(result.path)
        # An unreadable colour photograph is a problem only if photographs take part.
        elif options.with_rgb or not is_photograph:
            problems.append(result)
    if own:
        what = f"results of agalign among the images are skipped, {counted(len(own), 'file')} in all"
        problems.append(problem_of(own[0], what, is_harmless=True))
    return files


def _check_bands(groups: Sequence[Sequence[ImageFile]], chosen: Sequence[str], folder: Path) -> None:
    """Raise NoSuchBandError for a band of --bands that no capture has, ConfigurationError if --bands leaves less than
    two of each capture.
    """
    by_capture = [[b.name for file in group for b in file.bands] for group in groups]
    known = {band_key(name): name for names in by_capture for name in names}
    if not chosen or not known:
        return
    for name in chosen:
        if band_key(name) not in known:
            raise no_such_band(folder, name, known.values(), by="--bands")
    wanted = {band_key(name) for name in chosen}
    if all(sum(band_key(name) in wanted for name in names) < 2 for names in by_capture):
        what = f"--bands {','.join(chosen)}: leaves less than the two bands of a capture that alignment needs"
        raise ConfigurationError(f"{folder}: {what}; choose from {', '.join(known.values())}")


def _check_pattern(pattern: str | None, paths: Sequence[Path], folder: Path) -> None:
    """Raise ConfigurationError if a pattern matches no file."""
    if pattern is not None and not any(Generic(pattern).split(p)[1] for p in paths):
        what = f"--pattern '{pattern}' matches none of {len(paths)} images, such as {paths[0].name}"
        raise ConfigurationError(f"{folder}: {what}")


# ---- mosaics


def mosaics_onto(
    reference: Path, moving: Sequence[Path], band: str | None = None, max_pixels: int = MAX_MOSAIC_PIXELS
) -> FolderScan:
    """Return a capture for each moving mosaic: the reference's `band` (None for the default, green) and all bands of
    the moving mosaic, which share one mapping.

    Raises UnreadableFileError, InputError if a mosaic is not georeferenced, NoSuchBandError.
    """
    reference_bands = _georeferenced_bands(reference, max_pixels)
    fixed = reference_bands[reference_index(reference_bands, band, reference, "--band")]
    # By its wavelength, it would be displayed, and taken for indices, with the bands of another date.
    fixed = replace(fixed, name=f"{reference.stem} {fixed.name}", wavelength_nm=None, bandwidth_nm=None)
    captures = []
    for path in moving:
        if path.resolve() == reference.resolve():
            raise InputError(f"{path}: is the reference itself; give the mosaics to be aligned to it")
        bands = [
            fixed,
            *(replace(b, one_lens=True, is_from_photograph=False) for b in _georeferenced_bands(path, max_pixels)),
        ]
        captured_at = read_tags(path).captured_at
        unique, root = tuple(grouping.with_unique_band_names(bands)), reference.parent
        captures.append(Capture(path.stem, Path(), unique, 0, captured_at=captured_at, root=root))
    return FolderScan(reference.parent, tuple(grouping.with_unique_capture_names(captures, {})), ())


def mosaics_apart_km(fixed: Band, moving: Band) -> float:
    """Return the distance between the centres of two georeferenced rasters on the ground; 0 if they may overlap.

    Raises GeometryError if their coordinates are in different systems that GDAL cannot transform.
    """
    places, systems = [], []
    for band in (fixed, moving):
        assert band.georeference is not None
        width, height = band.size_px
        places.append(geometry.apply(band.georeference.transform, np.array([[width / 2, height / 2], [0.0, 0.0]])))
        systems.append(band.georeference.crs_wkt)
    try:
        on_earth = [transformed(*place, "EPSG:4326") for place in zip(places, systems, strict=True)]
        (centre, corner), (other, its_corner) = ([Position(*at[::-1]) for at in p.tolist()] for p in on_earth)
        result_km, *half_diagonals_km = (
            distance_km(*p) for p in ((centre, other), (centre, corner), (other, its_corner))
        )
    except GeometryError:
        if systems[0] != systems[1]:
            raise
        # A local system, whose place on Earth is unknown.
        offsets = places[1][0] - places[0][0], *(place[1] - place[0] for place in places)
        result_km, *half_diagonals_km = (float(np.hypot(*o)) * metres_per_unit(systems[0]) / 1000 for o in offsets)
    return result_km if result_km > sum(half_diagonals_km) else 0.0


def _georeferenced_bands(path: Path, max_pixels: int) -> tuple[Band, ...]:
    stored = probe(path, max_pixels)
    if stored[0].georeference is None:
        raise InputError(f"{path}: has no coordinates; align images without by 'agalign FOLDER'")
    return Generic().bands(path, read_tags(path), stored)
