"""Estimation: the sidecar of a capture, from its images."""

import time
from contextlib import suppress
from pathlib import Path

from agalign.capture.align_bands import PairProgress, align_capture_bands
from agalign.config import Settings
from agalign.flight.fingerprint import RENDER_STAGES
from agalign.flight.model import FlightModel
from agalign.pixels.raster import ReadTile, read_tile
from agalign.products.product import CapturePaths
from agalign.products.rasters.alignment_maps import relief_of
from agalign.products.rasters.parallax_file import PARALLAX_KIND, PARALLAX_SUFFIX, write_parallax
from agalign.products.sidecar.file import file_part, read_sidecar, write_sidecar
from agalign.products.sidecar.schema import Sidecar
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.own_files import is_own_file


def estimate(
    capture: Capture,
    out: Path,
    settings: Settings,
    model: FlightModel | None,
    progress: PairProgress,
    earlier: Sidecar | None = None,
    read: ReadTile = read_tile,
) -> tuple[Sidecar, dict[str, Alignment]]:
    """Align the bands of a capture; write its sidecar, and its parallax if it has a relief.

    Returns the sidecar as it was written, and the alignments.

    It lists the products of the `earlier` sidecar, which describe another estimate, until they are rendered again.
    A parallax file without the mark of the program is kept.
    `read` reads the pixels of the files. Raises UnreadableFileError if the reference cannot be read, and OutputError.
    """
    began_s, paths = time.perf_counter(), CapturePaths.of(capture, out)
    alignments = align_capture_bands(capture, settings, model, progress, read)
    progress(capture.reference.name, "writing", 0.0)
    relief, path, parallax = relief_of(alignments), paths.file(PARALLAX_SUFFIX), None
    if relief is not None:
        write_parallax(path, relief, capture.reference.georeference)
        parallax = file_part(PARALLAX_KIND, path, paths.folder)
    seconds = time.perf_counter() - began_s
    fingerprint = "" if model is None else model.fingerprint
    result = Sidecar.estimated(capture, alignments, settings, parallax, seconds, fingerprint)
    if earlier is not None:
        options = {key: stage for key, stage in (result.options or {}).items() if key not in RENDER_STAGES}
        options |= {key: stage for key, stage in (earlier.options or {}).items() if key in RENDER_STAGES}
        result = result.model_copy(update={"products": earlier.products, "options": options})
    write_sidecar(paths.sidecar, result)
    if relief is None and is_own_file(path):
        with suppress(OSError):
            path.unlink(missing_ok=True)
    # With the decimals of the file: a later command renders the same bytes.
    return read_sidecar(paths.sidecar), alignments
