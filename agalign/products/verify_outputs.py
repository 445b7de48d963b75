"""Comparison of the files of a run with the checksums in their sidecars."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from agalign.errors import SidecarError
from agalign.products.sidecar_file import content_checksum, read_result, run_sidecars
from agalign.values.files import open_regular


def verify_outputs(out: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield (sidecar, problems of the sidecar and the files that it lists) for every capture below `out`.

    Raises InputError if there is no sidecar.
    """
    for path in run_sidecars(out):
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
