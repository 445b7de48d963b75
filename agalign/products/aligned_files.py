"""The rasters of the aligned bands: a stack, or a file for each input file for photogrammetry programs."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agalign.cameras.pix4d import FromSource
from agalign.cameras.tag_transfer import band_tags, capture_tags
from agalign.config import WriteSettings
from agalign.pixels.raster import suffix_format
from agalign.products.layout import Layer
from agalign.products.product import CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import media_type, write_raster
from agalign.values import geometry
from agalign.values.capture import Capture
from agalign.values.files import file_name
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping


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
        reference, from_source = context.capture.reference, _from_source(layers[0], grid)
        tags = band_tags(layers[0].band.path, reference, grid, from_source, radiometry=settings.radiometry != "off")
        nodata = write_raster(context.capture, layers, grid, path, settings, tags)
        asset = StacAsset(name.as_posix(), media_type(settings), ("data",))
        return WrittenFile(self.kind, path, asset, tuple(layer.band.name for layer in layers), nodata)


def band_file_names(capture: Capture) -> dict[str, Path]:
    """Return the file of each band in layout `bands`, relative to the capture's output folder.

    It has the name of the input file, with the band's name if several bands of that file have a lens each, and with the
    folder if input files of the same name are in several folders.
    """
    bands_per_file = Counter(b.path for b in capture.bands)
    # Files of several bands with a lens each.
    split = {b.path for b in capture.bands if not b.one_lens and bands_per_file[b.path] > 1}
    by_folder = _has_namesakes_in_folders([*bands_per_file])
    names: dict[str, Path] = {}
    taken: dict[Path, Path] = {}
    band_names: dict[str, str] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{file_name(band.name, band_names)}" if band.path in split else band.path.stem
        folder = band.path.parent.name if by_folder else ""
        suffix = band.path.suffix if suffix_format(band.path) == "TIFF" else ".tif"
        name = Path(folder, f"{stem}{suffix}")
        # The name of the stack, or of another input file with a different suffix.
        if name == Path(f"{capture.name}.tif") or taken.get(name, band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[name] = band.path
        names[band.name] = name
    return names


def _has_namesakes_in_folders(files: Sequence[Path]) -> bool:
    """True if files of the same name are in several folders."""
    return len({p.stem for p in files}) < len(files) and len({p.parent for p in files}) > 1


def _from_source(layer: Layer, grid: OutputGrid) -> FromSource:
    """Return the mapping from pixels of the layer's file to pixels of the reference, inverted by Newton's method."""
    to_file = PixelMapping(geometry.identity()) if layer.mapping is None else layer.mapping
    centre = np.array([grid.x0 + grid.width / 2, grid.y0 + grid.height / 2])

    def from_source(x: float, y: float) -> tuple[float, float]:
        position = centre
        try:
            for _ in range(20):  # it converges in 3 to 5 steps through a lens model
                mapped = to_file(position)
                jacobian = np.stack([to_file(position + d) - mapped for d in np.eye(2)], axis=-1)
                position = position + np.linalg.solve(jacobian, np.array([x, y]) - mapped)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        if not np.abs(to_file(position) - (x, y)).max() < 0.1:  # it did not converge; nan fails too
            return math.nan, math.nan
        x_px, y_px = grid.scale.inverse.positions(position).tolist()
        return x_px, y_px

    return from_source


class Stack(Product):
    """A raster of all bands in the capture's order; a band that failed is all nodata."""

    kind = "stack"
    suffix = ".tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only files of single bands are written."""
        return settings.layout != "bands"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.tif."""
        settings, path = context.write_settings, context.paths.file(self.suffix)
        tags = capture_tags(context.capture.reference, context.grid)
        nodata = write_raster(context.capture, context.layers, context.grid, path, settings, tags)
        asset = StacAsset("stack", media_type(settings), ("data",))
        return [WrittenFile(self.kind, path, asset, tuple(la.band.name for la in context.layers), nodata)]
