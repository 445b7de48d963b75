"""Estimation: the sidecar of a capture, from its images."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from agalign.batch.output_files import is_removed
from agalign.cameras.metadata import exposed_after_s
from agalign.capture.align_bands import PairProgress, align_capture_bands
from agalign.config import Settings
from agalign.flight.fingerprint import RENDER_STAGES, input_digests, input_samples, input_states
from agalign.flight.model import FlightModel
from agalign.pixels.raster import ReadTile, read_tile
from agalign.rasters.parallax_file import PARALLAX_KIND, PARALLAX_SUFFIX, write_parallax
from agalign.rasters.product import CapturePaths
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import file_part, write_sidecar
from agalign.values.alignment import Alignment, relief_of
from agalign.values.capture import Capture


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

    Returns the sidecar and the alignments as a reader of the file has them: a later command renders the same bytes.

    The sidecar lists the products of the `earlier` one, which describe another estimate, until they are rendered again.
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
    delayed = [b for b in capture.moving if alignments[b.name].status != "aligned"]
    delays_s = {b.name: s for b in delayed if (s := exposed_after_s(b, capture.reference)) is not None}
    result = Sidecar.estimated(capture, alignments, settings, delays_s)
    facts: dict[str, Any] = {
        "parallax": parallax,
        "model": "" if model is None else model.fingerprint,
        "input_samples": input_samples(capture),
        "input_digests": input_digests(capture),
        "input_states": input_states(capture),
        "seconds": time.perf_counter() - began_s,
    }
    if earlier is not None:
        options = {key: stage for key, stage in (result.options or {}).items() if key not in RENDER_STAGES}
        options |= {key: stage for key, stage in (earlier.options or {}).items() if key in RENDER_STAGES}
        facts |= {"products": earlier.products, "options": options}
    written = write_sidecar(paths.sidecar, result.model_copy(update=facts))
    if relief is None and is_removed(path, {}):
        with suppress(OSError):
            path.unlink(missing_ok=True)
    # Their mappings have the decimals of the file, and hold the positions of all pixels.
    return written, written.alignments({name: alignment.mapping for name, alignment in alignments.items()})
