"""The alignments of a capture, from its sidecar."""

from pathlib import Path

from agalign.errors import SidecarError
from agalign.rasters.parallax_file import read_relief
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import read_sidecar
from agalign.values.alignment import Alignment
from agalign.values.arguments import checked
from agalign.values.band_names import no_such_band


def alignments_of(sidecar: Sidecar, folder: Path) -> dict[str, Alignment]:
    """Return the alignments of the moving bands by name, given the folder of the sidecar.

    Raises SidecarError and UnreadableFileError for the parallax map.
    """
    return sidecar.alignments(sidecar.mappings(read_relief(sidecar, folder)))


@checked
def read_alignment(sidecar: str | Path, band: str) -> Alignment:
    """Read the alignment of a band from the sidecar of its capture and, if there is one, the parallax map.

    Parameters
    ----------
    sidecar
        The sidecar, <capture>.json.
    band
        Name of a moving band.

    Returns
    -------
    Alignment
        The mapping of the run, from raw pixels of the reference band's file to raw pixels of the band's file.

    Raises
    ------
    SidecarError
        `sidecar` is missing or not a sidecar, or lacks the mapping of the band, or its parallax map is missing or not
        the one that was written.
    NoSuchBandError
        The capture has no moving band of this name.
    UnreadableFileError
        The parallax map cannot be read.

    Examples
    --------
    >>> result = agalign.read_alignment("aligned/0000SET/000/IMG_0001.json", "NIR")
    >>> result.status, result.size_px
    ('aligned', (480, 360))
    >>> result.map([[0, 0], [479, 359]]).shape
    (2, 2)
    """
    path = Path(sidecar)
    content = read_sidecar(path)
    moving = [b.band for b in content.moving]
    if band not in moving:
        raise no_such_band(path, band, moving, kind="moving band")
    if content.parallax is None and any(b.relief is not None for b in content.bands if b.band == band):
        raise SidecarError(f"{path}: its parallax was not written; run again with --overwrite")
    alignments = alignments_of(content, path.parent)
    if band not in alignments:
        raise SidecarError(f"{path}: has no mapping of the band {band!r}")
    return alignments[band]
