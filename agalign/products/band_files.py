"""An aligned file for each input file, with its name and tags, for photogrammetry programs."""

import math
from collections import Counter
from pathlib import Path

import numpy as np

from agalign.cameras.pix4d import FromSource
from agalign.cameras.tag_transfer import band_tags
from agalign.config import WriteSettings
from agalign.pixels.raster import TIFF_SUFFIXES
from agalign.products.layout import Layer
from agalign.products.product import CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import media_type, write_raster
from agalign.values import geometry
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping

_MAX_INVERSE_ERROR_PX = 0.1
"""Larger errors of an inverse mapping mean that Newton's method did not converge."""
_INVERSE_STEPS = 20
"""Newton's method converges in 3 to 5 steps through a lens model."""


class BandFiles(Product):
    """An aligned raster for each input file; none if its bands failed."""

    kind = "band"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only the stack is written."""
        return settings.layout != "stack"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:
        """Return the files if they are enabled. Otherwise other files, such as stacks, may have these names."""
        names = dict.fromkeys(band_file_names(capture).values()) if self.is_enabled(settings) else ()
        return [paths.folder / name for name in names]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write the files of all bands with pixels."""
        names = band_file_names(context.capture)
        by_file: dict[Path, list[Layer]] = {}
        for layer in context.layers:
            if not layer.is_gap:
                by_file.setdefault(names[layer.band.name], []).append(layer)
        return [
            self._write_file(context, name, by_file[name]) for name in dict.fromkeys(names.values()) if name in by_file
        ]

    def _write_file(self, context: ProductContext, name: Path, layers: list[Layer]) -> WrittenFile:
        settings, grid, path = context.write_settings, context.grid, context.paths.folder / name
        tags = band_tags(
            layers[0].band.path, context.capture.reference, grid, _from_source(layers[0], grid),
            radiometry=settings.radiometry != "off",
        )  # fmt: skip
        nodata = write_raster(context.capture, layers, grid, path, settings, tags)
        asset = StacAsset(name.as_posix(), media_type(settings), ("data",))
        return WrittenFile(self.kind, path, asset, tuple(layer.band.name for layer in layers), nodata)


def band_file_names(capture: Capture) -> dict[str, Path]:
    """Return the file of each band in layout `bands`, relative to the capture's output folder.

    It has the name of the input file, with the band's name if several bands of that file have a lens each, and with the
    folder if input files of the same name are in several folders.
    """
    split = _files_to_split(capture)
    by_folder = _needs_folders(capture)
    names: dict[str, Path] = {}
    taken: dict[Path, Path] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{_safe_name(band.name)}" if band.path in split else band.path.stem
        folder = band.path.parent.name if by_folder else ""
        name = Path(folder, f"{stem}{_tiff_suffix(band)}")
        # The name of the stack, or of another input file with a different suffix.
        if name == Path(f"{capture.name}.tif") or taken.get(name, band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[name] = band.path
        names[band.name] = name
    return names


def _files_to_split(capture: Capture) -> set[Path]:
    """Input files of several bands with a lens each."""
    bands_per_file = Counter(b.path for b in capture.bands)
    return {b.path for b in capture.bands if not b.one_lens and bands_per_file[b.path] > 1}


def _needs_folders(capture: Capture) -> bool:
    """True if input files in several folders have the same name."""
    files = {b.path for b in capture.bands}
    return len({p.stem for p in files}) < len(files) and len({p.parent for p in files}) > 1


def _tiff_suffix(band: Band) -> str:
    return band.path.suffix if band.path.suffix.lower() in TIFF_SUFFIXES else ".tif"


def _safe_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "-." else "_" for c in text)


def _from_source(layer: Layer, grid: OutputGrid) -> FromSource:
    """Return the mapping from pixels of the layer's file to pixels of the reference, inverted by Newton's method."""
    to_file = PixelMapping(geometry.identity()) if layer.mapping is None else layer.mapping
    centre = np.array([grid.x0 + grid.width / 2, grid.y0 + grid.height / 2])

    def from_source(x: float, y: float) -> tuple[float, float]:
        position = centre
        try:
            for _ in range(_INVERSE_STEPS):
                mapped = to_file(position)
                jacobian = np.stack([to_file(position + d) - mapped for d in np.eye(2)], axis=-1)
                position = position + np.linalg.solve(jacobian, np.array([x, y]) - mapped)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        if not np.abs(to_file(position) - (x, y)).max() < _MAX_INVERSE_ERROR_PX:  # nan fails too
            return math.nan, math.nan
        x_px, y_px = grid.scale.inverse.positions(position).tolist()
        return x_px, y_px

    return from_source
