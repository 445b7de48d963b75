"""Whether the files of a run are still what was written: by the sizes and checksums in their sidecars."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from agalign.errors import InputError, SidecarError
from agalign.products.sidecar import content_checksum, find_sidecars, read_result
from agalign.values.files import open_regular


def verify_outputs(out: Path) -> Iterator[tuple[Path, list[str]]]:
    """(the sidecar, what is wrong with it or with a file that it lists) for every capture below `out`.

    Raises InputError where there is no sidecar.
    """
    sidecars = find_sidecars(out) if out.is_dir() else []
    if not sidecars:
        raise InputError(f"{out}: no sidecars there; give the output folder of a run")
    for path in sidecars:
        try:
            yield path, list(_problems(path))
        except SidecarError as error:
            yield path, [str(error)]


def _problems(path: Path) -> Iterator[str]:
    sidecar = read_result(path)
    with open_regular(path) as file:
        text = file.read()
    if sidecar.checksum is not None and sidecar.checksum != content_checksum(text):
        yield f"{path}: was changed after it was written; run again with --overwrite"
    for kind in sidecar.not_written:
        yield f"{path}: its {kind} could not be written; run again"
    for part in sidecar.products:
        target = path.parent / part.file
        try:
            with open_regular(target) as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            yield f"{target}: cannot be read ({error.strerror or error}); run again"
        else:
            if digest != part.sha256:
                yield f"{target}: is not what was written; delete it and run again"
