"""Helpers of tests that make or read the outputs of a run."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from synthetic_flights.cameras import MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_two_headings

from agalign.batch.index_run import index_tasks, run_indices
from agalign.config import Settings, WriteSettings
from agalign.rasters.band_reader import BandReader
from agalign.rasters.output_grid import Layer
from agalign.rasters.product import CapturePaths, ProductContext
from agalign.records.captures import AlignedBand
from agalign.records.sidecar import Sidecar
from agalign.spectral_indices.formulas import INDICES, Index
from agalign.spectral_indices.rasters import IndexReport, write_index
from agalign.synthetic.cameras import REDEDGE
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction, Seed
from agalign.values.capture import Capture
from agalign.values.choices import PairStatus
from agalign.values.image import OutputGrid
from agalign.values.issues import RETRIEVAL, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError

from .conftest import Shared, read_json, write_signed

CAMERAS = {"RedEdge": REDEDGE, "M3M calibrated": MAVIC, "M3M": MAVIC_3M, "6X": SENTERA_6X}


def change(path: Path, **changes: object) -> None:
    """Replace entries of a sidecar, and its checksum, or of the record of a run, which has none."""
    contents = read_json(path)
    text = json.dumps(contents | changes)
    if "checksum" in contents:
        write_signed(path, text)
    else:
        path.write_text(text, encoding="utf-8")


def aligned(mapping: PixelMapping, size_px: tuple[int, int], status: PairStatus = "aligned", **facts: Any) -> Alignment:
    """The alignment of a band to a reference of `size_px` (width, height), equal to its seed."""
    prediction = Prediction(mapping.fixed_to_moving, "bands", 0.4) if status == "predicted" else None
    issues = () if status == "aligned" else (Issue(RETRIEVAL, 0.1, 0.2),)
    error = None
    if status in ("aligned", "predicted"):
        rig_std_px = 0.4 / geometry.magnification(mapping.fixed_to_moving, *size_px) if prediction else 0.0
        windows = None if prediction else facts.get("residual")
        error = MappingError(size_px, residual=windows, rig_std_px=rig_std_px, parallax=mapping.parallax)
    evidence = {"issues": issues, "prediction": prediction, "is_seed_usable": status == "seed_only"}
    evidence |= {} if error is None else {"error": error, "std_px": error.rms_px(geometry.lattice(*size_px, 24, 18))}
    facts = {**evidence, "seed": Seed("rig", mapping.fixed_to_moving, 30.0, 30.0, 5.0)} | facts
    result = Alignment(mapping, size_px, **facts)
    assert result.status == status
    return result


def context_of(
    capture: Capture,
    alignments: Mapping[str, Alignment],
    folder: Path = Path(),
    layers: Sequence[Layer] = (),
    grid: OutputGrid | None = None,
    **write: Any,
) -> ProductContext:
    """Of a capture for which nothing was written; its grid is by default that of the reference."""
    paths, settings = CapturePaths(folder, capture.name), Settings(write=WriteSettings(**write))
    grid = grid or OutputGrid(0, 0, *capture.reference.size_px)
    known = tuple(b for b in capture.bands if b is capture.reference or b.name in alignments)
    part = replace(capture, bands=known, reference_index=known.index(capture.reference))
    sidecar = Sidecar.estimated(part, alignments, settings)
    return ProductContext(capture, paths, settings, sidecar, alignments, layers, grid)


def table_in(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def index_of(bands: Sequence[AlignedBand], index: Index, base: Path, **more: Any) -> IndexReport:
    """Write an index of bands as `base`_<index>.tif."""
    with BandReader() as reader:
        return write_index(reader, bands, index, base, base.name, **more)


def indices_of(
    out: Path, *indices: str | Index, target: Path | None = None, overwrite: bool = False
) -> list[IndexReport]:
    """Calculate indices of the captures of a run, by default NDVI."""
    chosen = [INDICES[index] if isinstance(index, str) else index for index in indices or ("ndvi",)]
    tasks = index_tasks(out, chosen, target or out, overwrite=overwrite)
    return [report for done in run_indices(tasks, jobs=1) for report in done]


def capture_by(camera: str, shared: Shared) -> Path:
    """The images of one capture by a camera of `CAMERAS`."""

    def fill(folder: Path) -> None:
        make_two_headings(folder, 1, (480, 360), camera=CAMERAS[camera], line=1, lakes=False)

    return shared(f"capture by {camera}", fill)


def facts_of(folder: Path) -> dict[str, Any]:
    """The data in the report of a run."""
    page = (folder / "index.html").read_text(encoding="utf-8")
    return json.loads(page.partition('<script type="application/json" id="facts">')[2].partition("</script>")[0])
