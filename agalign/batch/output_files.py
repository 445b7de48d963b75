"""Files of earlier commands in the output folder: which of them a run may replace or remove.

These are files that the sidecar of the capture lists, and files with the mark of the program (`host/own_files.py`).
Others are kept, whatever their names.
"""

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from agalign.batch.products import PRODUCTS
from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, OutputError, SidecarError
from agalign.host.files import check_inside, max_name_bytes, remove_companions
from agalign.host.own_files import is_own_file
from agalign.rasters.aligned_files import band_file_names, is_aligned_raster
from agalign.rasters.parallax_file import PARALLAX_SUFFIX
from agalign.rasters.product import CapturePaths
from agalign.records.run_record import file_states
from agalign.records.sidecar import FilePart
from agalign.records.sidecar_file import is_sidecar, read_checked
from agalign.spectral_indices.rasters import index_rasters
from agalign.values.capture import Capture


def paths_written(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Return the paths of all files that a run with these settings may write or remove for a capture."""
    paths = CapturePaths.of(capture, out)
    own = [paths.sidecar, paths.file(PARALLAX_SUFFIX)]
    return [*own, *(p for product in PRODUCTS for p in product.paths(capture, paths, settings))]


def refuse_to_overwrite(
    captures: Sequence[Capture], out: Path, settings: WriteSettings, listed: Mapping[Path, Sequence[FilePart]]
) -> None:
    """Raise ConfigurationError if an output would replace an input image, an output of another capture, or a file that
    no run has written, or if its name is too long.

    `listed` has the files that a sidecar lists, by its path.
    """
    sources, max_bytes = {band.path.resolve() for capture in captures for band in capture.bands}, max_name_bytes(out)
    resolved: dict[Path, Path] = {}
    written: dict[str, Capture] = {}
    for capture in captures:
        for path in paths_written(capture, out, settings):
            if (name_bytes := len(os.fsencode(path.name))) > max_bytes:
                what = f"{path.name} would have {name_bytes} bytes, and file systems take {max_bytes}"
                raise ConfigurationError(f"{capture.reference.path}: the name of its output {what}; rename its files")
            if path.parent not in resolved:
                resolved[path.parent] = check_inside(path.parent, out).resolve()
            if resolved[path.parent] / path.name in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder")
            other = written.setdefault(str(path).lower(), capture)
            if other is not capture:
                raise ConfigurationError(
                    f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
                )
        if foreign := _foreign_file(capture, out, settings, listed.get(CapturePaths.of(capture, out).sidecar, ())):
            raise ConfigurationError(f"{foreign}: was not written by agalign; choose another output folder with -o")


def _foreign_file(capture: Capture, out: Path, settings: WriteSettings, listed: Sequence[FilePart]) -> Path | None:
    """Return a file in the place of an output that no run has written; None if there is none."""
    paths = CapturePaths.of(capture, out)
    is_foreign = paths.sidecar.is_file() and not (is_sidecar(paths.sidecar) or is_own_file(paths.sidecar))
    if is_foreign and capture.label not in file_states(out):  # else it was a sidecar
        return paths.sidecar
    known = {paths.folder / part.file for part in listed}
    enabled = [product for product in PRODUCTS if product.is_enabled(settings)]
    written = [paths.file(PARALLAX_SUFFIX), *(p for one in enabled for p in one.paths(capture, paths, settings))]
    return next((p for p in written if p not in known and p.is_file() and not is_own_file(p)), None)


def outdated_files(
    capture: Capture, out: Path, settings: WriteSettings, listed: Sequence[FilePart]
) -> Mapping[Path, str]:
    """Return the files of an earlier command for a capture, which are removed unless they are written again, and why.

    Otherwise a sidecar could describe rasters of another run, and bands on an old grid could remain among new ones.
    `listed` has the products in the sidecar, which anyone may have written: a file is returned if it has the name of an
    output of this capture, and the mark of the program or the size in the list. The reason is empty for files that
    users do not miss.
    """
    paths = CapturePaths.of(capture, out)
    sizes = {paths.folder / part.file: part.bytes for part in listed}
    sources = {band.path.resolve() for band in capture.bands}
    return {
        path: reason
        for path, reason in _outdated(capture, out, settings, sizes)
        if path.is_file()
        and path.resolve() not in sources
        and (is_own_file(path) or path.stat().st_size == sizes.get(path))
    }


def _outdated(
    capture: Capture, out: Path, settings: WriteSettings, listed: Mapping[Path, int]
) -> Iterator[tuple[Path, str]]:
    """Yield files with the names of outputs of a capture, given the sizes of listed files by path."""
    paths = CapturePaths.of(capture, out)
    with suppress(OutputError):
        check_inside(paths.folder, out)
        for product in PRODUCTS:
            is_unwanted = product.option is None and not product.is_enabled(settings)
            reason = f"--layout {settings.layout}" if is_unwanted else f"{product.kind} is not written again"
            yield from ((path, reason) for path in product.paths(capture, paths, settings))
        # Also of a band that this run leaves out; a file with a sidecar is the stack of another capture.
        pattern = re.compile(rf"{re.escape(capture.name)}(\d|[._].+)\.tiff?", re.IGNORECASE)
        own = [p for p in listed if pattern.fullmatch(p.name) and not p.with_suffix(".json").exists()]
        own += [paths.folder / name for name in band_file_names(capture).values()]
        yield from ((p, f"--layout {settings.layout}") for p in own if p in listed and is_aligned_raster(p))
        for raster in index_rasters(paths.file("")):
            yield raster.path, "its bands are not aligned"
            yield raster.path.with_suffix(".png"), ""


def remove_files(files: Iterable[Path], out: Path) -> None:
    """Remove files below an output folder, if they can be."""
    for path in files:
        with suppress(OSError, OutputError):
            check_inside(path.parent, out)  # a link may have taken the place of the folder meanwhile
            path.unlink(missing_ok=True)
            remove_companions(path)


def remove_outputs(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Remove and return the outputs of an earlier run for a capture that this one does not align."""
    paths, listed = CapturePaths.of(capture, out), list[FilePart]()
    with suppress(SidecarError):
        listed = read_checked(paths.sidecar).products
    removed = [*outdated_files(capture, out, settings, listed)]
    if paths.sidecar.is_file() and is_sidecar(paths.sidecar):
        removed.append(paths.sidecar)
    if is_own_file(paths.file(PARALLAX_SUFFIX)):
        removed.append(paths.file(PARALLAX_SUFFIX))
    remove_files(removed, out)
    return [path for path in removed if not path.exists()]
