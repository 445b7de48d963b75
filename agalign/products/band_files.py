"""A file for each input file, with the input's name and tags: what photogrammetry programs expect."""

import math
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
"""An inverse mapping that misses its target by more has not converged."""
_MAX_INVERSE_STEPS = 20
"""Newton's method takes 3 to 5 steps through a lens model."""


class BandFiles(Product):
    """An aligned raster for each input file; none for a band that failed."""

    kind = "band"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only the stack is written."""
        return settings.layout != "stack"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:
        """The files where they are asked for: otherwise images may have these names."""
        names = dict.fromkeys(band_file_names(capture).values()) if self.is_enabled(settings) else ()
        return [paths.folder / name for name in names]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write the files of all bands with pixels."""
        names = band_file_names(context.capture)
        by_file: dict[Path, list[Layer]] = {}
        for layer in context.layers:
            if not layer.is_gap:
                by_file.setdefault(names[layer.band.name], []).append(layer)
        in_order = [name for name in dict.fromkeys(names.values()) if name in by_file]
        return [self._write_file(context, name, by_file[name]) for name in in_order]

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
    """By band: its file in layout `bands`, relative to the capture's output folder.

    It has the name of the input file. The band's name is part of it where several bands of that file have lenses of
    their own, and the folder where only the folders distinguish the input files.
    """
    split = _files_to_split(capture)
    by_folder = _needs_folders(capture)
    names: dict[str, Path] = {}
    taken: dict[Path, Path] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{_safe_name(band.name)}" if band.path in split else band.path.stem
        folder = band.path.parent.name if by_folder else ""
        name = Path(folder, f"{stem}{_tiff_suffix(band)}")
        # The stack has its own name, and so has each file.
        if name == Path(f"{capture.name}.tif") or taken.get(name, band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[name] = band.path
        names[band.name] = name
    return names


def _files_to_split(capture: Capture) -> set[Path]:
    """Input files of several bands, each with its own lens."""
    return {b.path for b in capture.bands if not b.one_lens and sum(b.path == o.path for o in capture.bands) > 1}


def _needs_folders(capture: Capture) -> bool:
    """True where input files in several folders have the same name."""
    files = {b.path for b in capture.bands}
    return len({p.stem for p in files}) < len(files) and len({p.parent for p in files}) > 1


def _tiff_suffix(band: Band) -> str:
    return band.path.suffix if band.path.suffix.lower() in TIFF_SUFFIXES else ".tif"


def _safe_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "-." else "_" for c in text)


def _from_source(layer: Layer, grid: OutputGrid) -> FromSource:
    """Return the mapping from pixels of the layer's file to the reference's, the inverse by Newton's method."""
    to_file = PixelMapping(geometry.identity()) if layer.mapping is None else layer.mapping
    middle = np.array([grid.x0 + grid.width / 2, grid.y0 + grid.height / 2])

    def from_source(x: float, y: float) -> tuple[float, float]:
        at = middle
        try:
            for _ in range(_MAX_INVERSE_STEPS):
                mapped = to_file(at)
                jacobian = np.stack([to_file(at + d) - mapped for d in np.eye(2)], axis=-1)
                at = at + np.linalg.solve(jacobian, np.array([x, y]) - mapped)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        if not np.abs(to_file(at) - (x, y)).max() < _MAX_INVERSE_ERROR_PX:
            return math.nan, math.nan
        x_px, y_px = grid.scale.inverse.positions(at).tolist()
        return x_px, y_px

    return from_source
