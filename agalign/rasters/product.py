"""The interface `Product` of each kind of output of a capture, and its arguments and results."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from agalign.config import Settings, WriteSettings
from agalign.host.files import file_checksum
from agalign.pixels.raster import ReadTile, open_raster, read_tile
from agalign.rasters.drawing import Grey, ReducedBands, read_reduced_bands
from agalign.rasters.geotiff import Block, LayerDescription, compressed, write_on_grid
from agalign.rasters.output_grid import Layer
from agalign.records.sidecar import PreviewPart, Sidecar
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.image import Mask, OutputGrid
from agalign.values.residual import Residual


@dataclass(frozen=True)
class CapturePaths:
    """The paths of a capture's files: OUT/<relative folder>/<capture><suffix>."""

    folder: Path
    name: str

    @classmethod
    def of(cls, capture: Capture, out: Path) -> "CapturePaths":
        """Return the paths of a capture below the output folder of a run."""
        return cls(out / capture.folder, capture.name)

    def file(self, suffix: str) -> Path:
        """Return the file of the capture with this suffix, such as `.png`."""
        return self.folder / f"{self.name}{suffix}"

    @property
    def sidecar(self) -> Path:
        """The capture's sidecar."""
        return self.file(".json")

    def relative(self, path: Path) -> str:
        """Return a path below the folder of the capture, relative to it and with forward slashes."""
        return path.relative_to(self.folder).as_posix()


@dataclass(frozen=True)
class WrittenFile:
    """A complete file that a product has written."""

    kind: str
    """The product's `kind`."""
    path: Path
    bands: tuple[str, ...] = ()
    """Names of the bands in a file of aligned pixels, in the order of the file."""
    nodata: float | None = None
    """Nodata value of a file of aligned pixels."""
    preview: PreviewPart | None = None
    """Layout of the preview; None for other files."""
    is_flat: bool = False
    """The vignetting of raw numbers is corrected in the pixels."""
    index_before: tuple[str, Grey] | None = None
    """Of an index raster, the name of the index and its values in the unaligned bands, if these have the pixels of the
    grid, as `ReducedBands.indices_before`."""

    @property
    def nodata_in_json(self) -> float | str | None:
        """The nodata value, with the text "nan" for nan, which JSON does not have."""
        return "nan" if self.nodata is not None and math.isnan(self.nodata) else self.nodata

    @cached_property
    def sha256(self) -> str:
        """Checksum of the file. Raises OutputError."""
        return file_checksum(self.path)


class LostFile(NamedTuple):
    """A file of an earlier command that cannot be written again."""

    path: Path
    reason: str


@dataclass(frozen=True)
class RenderOptions:
    """What the rasters of a capture share with those of its flight."""

    captures: int = 1
    """Number of captures of the run, whose previews together have a limited size."""
    common: OutputGrid | None = None
    """Grid of the captures of the camera, if they share one."""
    fine: OutputGrid | None = None
    """The same area in pixels of the finest band, for pan-sharpened files."""


@dataclass(frozen=True)
class ProductContext:
    """The input of products: one capture, its alignments, and the grid of its output."""

    capture: Capture
    paths: CapturePaths
    settings: Settings
    sidecar: Sidecar
    """The result of the estimation."""
    alignments: Mapping[str, Alignment]
    """By moving band, including failed ones."""
    layers: Sequence[Layer]
    """One for each of the capture's `stack_bands`; empty if no moving band can be written."""
    grid: OutputGrid
    """Grid of all rasters; that of the reference's file if there are no layers."""
    options: RenderOptions = RenderOptions()
    written: Sequence[WrittenFile] = ()
    """Files of the products before this one in `PRODUCTS`, to which the rendering adds those of each product."""
    read: ReadTile = read_tile
    """Reads the pixels of the files of the capture."""
    ties: Mapping[str, Residual] = field(default_factory=dict)
    """Windows by moving band, measured under the mapping; empty unless tie points are written."""

    @property
    def is_raw(self) -> bool:
        """True if raw numbers are written, without radiometric calibration."""
        return self.settings.write.radiometry == "off"

    @property
    def with_pixels(self) -> dict[str, Alignment]:
        """The alignments that did not fail, by band, in the order of the capture's bands."""
        return {b.name: a for b in self.capture.moving if (a := self.alignments[b.name]).status != "failed"}

    @property
    def usable(self) -> dict[str, Alignment]:
        """The alignments of the aligned bands, and of predicted bands with an accepted standard error."""
        limit_px = self.settings.check.accept_predicted_px
        usable = {b.band for b in self.sidecar.bands if b.is_usable(limit_px)}
        return {name: a for name, a in self.with_pixels.items() if name in usable}

    @property
    def places(self) -> dict[str, tuple[WrittenFile, int]]:
        """File and index, from 1, of the pixels of each band that has any; the stack if there is one."""
        gaps = {layer.band.name for layer in self.layers if layer.is_gap}
        return {
            name: (file, index)
            for file in self.written
            for index, name in enumerate(file.bands, start=1)
            if name not in gaps
        }

    @cached_property
    def clipped(self) -> dict[str, Mask]:
        """By band, True (height, width) where its raw numbers with corrected vignetting have the largest value of their
        type: the corners of bright images exceed it. Raises UnreadableFileError.
        """
        result: dict[str, Mask] = {}
        for file in (file for file in self.written if file.is_flat):
            with open_raster(file.path) as source:
                bands = dict(zip(file.bands, source.read(), strict=True))
            for name, pixels in bands.items():
                if pixels.dtype.kind in "ui":
                    largest = np.iinfo(pixels.dtype).max
                    result[name] = pixels == (largest - 1 if file.nodata == largest else largest)
        return result

    @cached_property
    def reduced_bands(self) -> ReducedBands:
        """The bands as reduced grey images, before and after alignment. Raises UnreadableFileError."""
        places = {name: (file.path, index) for name, (file, index) in self.places.items()}
        bands = read_reduced_bands(self.capture, places, self.grid, self.read)
        return replace(bands, indices_before=dict(file.index_before for file in self.written if file.index_before))


class Product(ABC):
    """One kind of output of a capture.

    A new product is a module with a subclass, and an entry in `batch/products.py`. Its files are then listed in the
    sidecar with size and checksum, verified when a run resumes, rendered again with changed settings, and protected
    against two captures with the same name.
    """

    kind: ClassVar[str]
    """Name in the sidecar's `products`."""
    suffix: ClassVar[str]
    """End of the file name, after the name of the capture."""
    is_required: ClassVar[bool] = True
    """False if a failure is only reported and the capture counts as done."""
    needs_layers: ClassVar[bool] = True
    """False if the product is also written for captures without usable moving bands."""
    option: ClassVar[str | None] = None
    """Name of the setting in `WriteSettings` that requests the product, and later commands need not repeat; None of the
    pictures, and of the rasters that `layout` chooses."""
    text_starts: ClassVar[tuple[bytes, ...]] = ()
    """How its text files start; images have a mark instead (`host/own_files.py`)."""

    def is_enabled(self, settings: WriteSettings) -> bool:
        """Return True if the settings request the product."""
        return self.option is None or bool(getattr(settings, self.option))

    def check(self, capture: Capture) -> None:  # noqa: B027
        """Raise an AgalignError if the capture or the installation lacks something that the product needs.

        It is called before the capture is aligned, and only if the product is enabled.
        """

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return every file that a run with these settings may write or remove, also if the product is not enabled."""
        return [paths.file(self.suffix)]

    @abstractmethod
    def write(self, context: ProductContext) -> Iterable[WrittenFile | LostFile]:
        """Write the files, each atomically, and return them, with those that are lost; none if the capture lacks the
        input for them.

        Raises OutputError, or UnreadableFileError for an input.
        """

    def write_layers(
        self,
        context: ProductContext,
        layers: Sequence[LayerDescription],
        blocks: Iterable[Block],
        tags: Mapping[str, str] = {},
        *,
        dtype: str = "float32",
        options: Mapping[str, Any] = {"nodata": math.nan},
    ) -> list[WrittenFile]:
        """Write one raster on the grid of the capture, with these creation options and the compression that is set, and
        return it.

        Raises OutputError.
        """
        path, georeference = context.paths.file(self.suffix), context.capture.reference.georeference
        options = {**compressed(dtype, context.settings.write.compression), **options}
        write_on_grid(path, context.grid, georeference, layers, blocks, tags=tags, dtype=dtype, options=options)
        return [WrittenFile(self.kind, path)]
