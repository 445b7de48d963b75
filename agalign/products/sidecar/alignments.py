"""The alignments of a capture, from its sidecar."""

from pathlib import Path

from agalign.errors import NoSuchBandError, SidecarError
from agalign.products.rasters.parallax_file import read_relief
from agalign.products.sidecar.file import read_sidecar
from agalign.values.alignment import Alignment


def read_alignment(sidecar: str | Path, band: str) -> Alignment:
    """Return the alignment of a moving band as a sidecar and the raster of its parallax store it.

    Its `map`, `inverse` and `warp` are those of the run, between the raw pixels of the files. Raises SidecarError for a
    file that is not a sidecar or lacks the mapping, NoSuchBandError for a band that is not a moving band of the
    capture, UnreadableFileError for a parallax that cannot be read.
    """
    path = Path(sidecar)
    content = read_sidecar(path)
    moving = [b.band for b in content.bands if b.status != "reference"]
    if band not in moving:
        raise NoSuchBandError(f"{path}: no moving band {band!r}; choose from {', '.join(moving)}")
    relief = read_relief(content, path.parent)
    if relief is None and any(b.relief is not None for b in content.bands if b.band == band):
        raise SidecarError(f"{path}: its parallax was not written; run again with --overwrite")
    alignments = content.alignments(relief)
    if band not in alignments:
        raise SidecarError(f"{path}: has no mapping of the band {band!r}")
    return alignments[band]
