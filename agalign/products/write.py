"""The files of a capture's aligned bands: a stack of all bands, a file for each input file, or both."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agalign.cameras.pix4d import FromSource
from agalign.cameras.tag_transfer import TransferredTags, band_tags, capture_tags
from agalign.config import WriteSettings
from agalign.pixels.raster import TIFF_SUFFIXES
from agalign.products.layout import Layer
from agalign.products.raster_file import write_raster
from agalign.values import geometry
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping

_FOUND_PX = 0.1


@dataclass(frozen=True)
class Written:
    """What was written of a capture."""

    folder: Path
    grid: OutputGrid
    stack: Path | None
    contents: Mapping[Path, tuple[str, ...]]
    """Of every file, the names of its bands in their order."""
    nodata: Mapping[Path, float | None]
    """Of every file, the value that it declares."""
    gaps: frozenset[str]
    """Bands that are all nodata in the stack."""

    @property
    def band_files(self) -> list[Path]:
        """All files but the stack."""
        return [path for path in self.contents if path != self.stack]

    @property
    def places(self) -> dict[str, tuple[Path, int]]:
        """By band that holds something: a file, the stack where there is one, and its index there, from 1."""
        return {
            name: (path, index)
            for path in [*self.band_files, *([self.stack] if self.stack is not None else [])]
            for index, name in enumerate(self.contents[path], start=1)
            if name not in self.gaps
        }


def write_capture(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, stack: Path, settings: WriteSettings
) -> Written:
    """Write what the layout asks for, each file complete or not at all; `stack` is the stack's path.

    Raises OutputError, or UnreadableFileError for an input.
    """
    contents: dict[Path, tuple[str, ...]] = {}
    nodata: dict[Path, float | None] = {}

    def write(path: Path, some: Sequence[Layer], tags: TransferredTags) -> None:
        nodata[path] = write_raster(capture, some, grid, path, settings, tags)
        contents[path] = tuple(layer.band.name for layer in some)

    reference = capture.reference
    if settings.layout != "stack":
        names = band_file_names(capture)
        for name in dict.fromkeys(names.values()):
            some = [layer for layer in layers if names[layer.band.name] == name and not layer.is_gap]
            if some:
                source, back = some[0].band.path, _from_source(some[0], grid)
                write(
                    stack.parent / name, some,
                    band_tags(source, reference, grid, back, radiometry=settings.radiometry != "off"),
                )  # fmt: skip
    if settings.layout != "bands":
        write(stack, layers, capture_tags(reference, grid))
    gaps = frozenset(layer.band.name for layer in layers if layer.is_gap)
    return Written(stack.parent, grid, stack if stack in contents else None, contents, nodata, gaps)


def band_file_names(capture: Capture) -> dict[str, Path]:
    """By band: the file for it in layout `bands`, below the capture's output folder.

    It keeps the name of the file it comes from; where several bands of a file have lenses of their own, or the bands'
    folders tell them apart, those are part of it.
    """
    several = {b.path for b in capture.bands if sum(b.path == o.path for o in capture.bands) > 1 and not b.one_lens}
    folders = {b.path.parent for b in capture.bands}
    same_name = len({b.path.stem for b in capture.bands}) < len({b.path for b in capture.bands})
    names: dict[str, Path] = {}
    taken: dict[Path, Path] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{_in_file_name(band.name)}" if band.path in several else band.path.stem
        folder = band.path.parent.name if same_name and len(folders) > 1 else ""
        suffix = band.path.suffix if band.path.suffix.lower() in TIFF_SUFFIXES else ".tif"
        name = Path(folder, f"{stem}{suffix}")
        # The stack has its own name, and so has each file.
        if name == Path(f"{capture.name}.tif") or taken.get(name, band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[name] = band.path
        names[band.name] = name
    return names


def _in_file_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "-." else "_" for c in text)


def _from_source(layer: Layer, grid: OutputGrid) -> FromSource:
    """Where a pixel of the layer's file lies in the reference's pixels: the mapping the other way, by iteration."""
    to_file = PixelMapping(geometry.identity()) if layer.mapping is None else layer.mapping
    middle = np.array([grid.x0 + grid.width / 2, grid.y0 + grid.height / 2])

    def from_source(x: float, y: float) -> tuple[float, float]:
        at = middle
        try:
            for _ in range(20):
                here = to_file(at)
                step = np.stack([to_file(at + d) - here for d in np.eye(2)], axis=-1)
                at = at + np.linalg.solve(step, np.array([x, y]) - here)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        if not np.abs(to_file(at) - (x, y)).max() < _FOUND_PX:
            return math.nan, math.nan
        return (at[0] + 0.5) / grid.scale_xy[0] - 0.5, (at[1] + 0.5) / grid.scale_xy[1] - 0.5

    return from_source
