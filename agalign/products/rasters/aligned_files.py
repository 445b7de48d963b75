"""The rasters of the aligned bands: a stack, or a file for each input file for photogrammetry programs."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras.metadata import read_tags
from agalign.cameras.pix4d import GridVignetting, vignetting_of, vignetting_on_grid
from agalign.cameras.tag_transfer import TransferredTags, band_tags, capture_tags
from agalign.config import WriteSettings
from agalign.errors import UnreadableFileError
from agalign.pixels.raster import suffix_format
from agalign.products.product import GEOTIFF, CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.rasters.layout import Layer, is_inside
from agalign.products.rasters.raster_file import write_raster
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Radiometry
from agalign.values.files import file_name
from agalign.values.image import OutputGrid

_MAX_VIGNETTING_ERROR = 0.01
"""Limit for the tags of aligned files, p95 of corrected pixels: a fifth of the accuracy of the cameras' calibration."""


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
        layers = [layer for layer in context.layers if not layer.is_gap]
        vignettings = {} if context.settings.write.radiometry != "off" else _vignettings(layers, context.grid)
        if any(v.error > _MAX_VIGNETTING_ERROR for v in vignettings.values()):
            # A program that corrects some bands of a capture only would change its indices.
            layers = [replace(layer, vignetting=_correction(layer.band)) for layer in layers]
            vignettings = {}
        by_file: dict[Path, list[Layer]] = {}
        for layer in layers:
            by_file.setdefault(names[layer.band.name], []).append(layer)
        return [
            self._write_file(context, name, by_file[name], vignettings.get(by_file[name][0].band.name))
            for name in dict.fromkeys(names.values())
            if name in by_file
        ]

    def _write_file(
        self, context: ProductContext, name: Path, layers: list[Layer], vignetting: GridVignetting | None
    ) -> WrittenFile:
        reference, is_raw = context.capture.reference, context.settings.write.radiometry == "off"
        tags = band_tags(layers[0].band, reference, context.grid, vignetting, radiometry=not is_raw)
        return _written(self.kind, context, layers, context.paths.folder / name, name.as_posix(), tags)


def band_file_names(capture: Capture) -> dict[str, Path]:
    """Return the file of each band in layout `bands`, relative to the capture's output folder.

    It has the name of the input file, with the band's name if several bands of that file have a lens each, and with the
    folder if input files of the same name are in several folders.
    """
    bands_per_file = Counter(b.path for b in capture.bands)
    # Files of several bands with a lens each.
    split = {b.path for b in capture.bands if not b.one_lens and bands_per_file[b.path] > 1}
    files = bands_per_file.keys()
    has_namesakes = len({p.stem for p in files}) < len(files)
    by_folder = has_namesakes and len({p.parent for p in files}) > 1
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


def _vignettings(layers: Sequence[Layer], grid: OutputGrid) -> dict[str, GridVignetting]:
    """The vignetting of bands on the output grid; none for bands without its tags or without pixels."""
    result = {}
    output_px = geometry.lattice(grid.width, grid.height, 25, 19)
    min_points = 30  # pixels of the lattice of 25 x 19 that must be inside a band: a polynomial has six coefficients
    for layer in layers:
        correction = _correction(layer.band)
        positions_px = layer.positions(output_px, grid)
        inside = is_inside(positions_px, layer.band)
        if correction is not None and np.count_nonzero(inside) >= min_points:
            result[layer.band.name] = vignetting_on_grid(correction, output_px[inside], positions_px[inside])
    return result


def _correction(band: Band) -> Radiometry | None:
    """The correction of a band's vignetting by its tags."""
    with suppress(UnreadableFileError):
        return vignetting_of(read_tags(band.path, band.page), band.size_px)
    return None


class Stack(Product):
    """A raster of all bands in the capture's order; a band that failed is all nodata."""

    kind = "stack"
    suffix = ".tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only files of single bands are written."""
        return settings.layout != "bands"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.tif."""
        tags = capture_tags(context.capture.reference, context.grid)
        return [_written(self.kind, context, context.layers, context.paths.file(self.suffix), "stack", tags)]


def _written(
    kind: str, context: ProductContext, layers: Sequence[Layer], path: Path, key: str, tags: TransferredTags
) -> WrittenFile:
    """Write layers as the bands of one file, and return it with its asset `key`."""
    settings = context.settings.write
    nodata = write_raster(context.capture, layers, context.grid, path, settings, tags)
    media_type = f"{GEOTIFF}; profile=cloud-optimized" if settings.format == "cog" else GEOTIFF
    bands, is_flat = tuple(layer.band.name for layer in layers), any(layer.vignetting for layer in layers)
    return WrittenFile(kind, path, StacAsset(key, media_type, ("data",)), bands, nodata, is_flat=is_flat)
