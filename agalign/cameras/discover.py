"""The captures below a folder."""

from collections.abc import Callable, Sequence
from pathlib import Path

from agalign.cameras.folder_walk import IMAGE_KINDS, check_folder, image_files, is_chosen, other_files
from agalign.cameras.grouping import capture_of, group_files, pattern_clashes, with_missing_bands
from agalign.cameras.naming import band_file_owners, with_unique_capture_names
from agalign.cameras.read_files import ImageFile, read_files
from agalign.cameras.scan import FolderScan, Problem
from agalign.config import DiscoverOptions
from agalign.errors import ConfigurationError, InputError, NoSuchBandError
from agalign.pixels.raster import TIFF_SUFFIXES
from agalign.values.capture import Capture

__all__ = ["DiscoverOptions", "FolderScan", "Problem", "discover"]

_MAX_SUFFIXES = 5
"""Suffixes of other files that a message lists."""
Progress = Callable[[int, int], None]
"""Called with (number of files read, number of files)."""


def discover(
    folder: str | Path, options: DiscoverOptions | None = None, progress: Progress | None = None
) -> FolderScan:
    """Return all captures below `folder`, sorted by folder and name, and the problems.

    Raises InputError if the folder does not exist or contains no image, ConfigurationError for a band that no capture
    has.
    """
    folder, options = Path(folder), options or DiscoverOptions()
    check_folder(folder)
    images, problems = image_files(folder, options.skip)
    paths = [p for p in images if is_chosen(p.relative_to(folder), options.include, options.exclude)]
    if not paths and problems:
        raise problems[0].error
    if images and not paths:
        raise InputError(f"{folder}: has {len(images)} images, and --include and --exclude leave none")
    if not paths:
        others = ", ".join(f"{count} {suffix}" for suffix, count in other_files(folder).most_common(_MAX_SUFFIXES))
        only = f"; there are only {others}" if others else ""
        raise InputError(f"{folder}: no {IMAGE_KINDS} file in it or below it{only}")
    files = _read(paths, options, progress, problems)
    captures: list[Capture] = []
    for group in group_files(files):
        if options.pattern is not None:
            problems += pattern_clashes(group, options.pattern)
        try:
            captures.append(capture_of(group, folder, options))
        except (InputError, NoSuchBandError) as error:
            problems.append(Problem(group[0].path, error))
    _check_bands_exist(files, options.bands, folder)
    captures.sort(key=lambda c: (c.folder.as_posix(), c.name))
    captures = with_missing_bands(with_unique_capture_names(captures, band_file_owners(captures)))
    return FolderScan(folder, tuple(captures), tuple(problems))


def _read(
    paths: Sequence[Path], options: DiscoverOptions, progress: Progress | None, problems: list[Problem]
) -> list[ImageFile]:
    """The files that contain a band; files that cannot be read are added to `problems`."""
    files: list[ImageFile] = []
    for number, result in enumerate(read_files(paths, options), start=1):
        if isinstance(result, ImageFile):
            files += [result] if result.bands else []
        # An unreadable colour photograph is a problem only if photographs take part.
        elif options.with_rgb or result.path.suffix.lower() in TIFF_SUFFIXES:
            problems.append(result)
        if progress is not None:
            progress(number, len(paths))
    return files


def _check_bands_exist(files: Sequence[ImageFile], names: Sequence[str], folder: Path) -> None:
    """Raises ConfigurationError if no file has a band of one of these names."""
    known = {b.name.lower() for file in files for b in file.bands}
    unknown = [name for name in names if name.lower() not in known]
    if unknown and files:
        raise ConfigurationError(f"{folder}: no capture has a band {' or '.join(map(repr, unknown))}, as --bands asks")
