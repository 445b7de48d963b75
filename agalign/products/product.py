"""What every kind of output of a capture has in common: the interface `Product` and what travels through it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from agalign.config import Settings, WriteSettings
from agalign.flight.rig import Rig
from agalign.products.layout import Layer
from agalign.products.reduced_bands import ReducedBands, read_reduced_bands
from agalign.products.sidecar import PreviewPart
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import FixedFilePx


@dataclass(frozen=True)
class CapturePaths:
    """The names of a capture's files: OUT/<relative folder>/<capture><suffix>."""

    folder: Path
    name: str

    @classmethod
    def of(cls, capture: Capture, out: Path) -> "CapturePaths":
        """The paths of a capture below the output folder of a run."""
        return cls(out / capture.folder, capture.name)

    def file(self, suffix: str) -> Path:
        """The file of the capture with this suffix, such as `.png`."""
        return self.folder / f"{self.name}{suffix}"

    @property
    def sidecar(self) -> Path:
        """The capture's sidecar."""
        return self.file(".json")


@dataclass(frozen=True)
class StacAsset:
    """How a file appears in the capture's STAC item."""

    key: str
    media_type: str
    roles: tuple[str, ...]


@dataclass(frozen=True)
class WrittenFile:
    """One file that a product has written, complete."""

    kind: str
    """The product's `kind`."""
    path: Path
    asset: StacAsset | None = None
    """None for a file that the STAC item leaves out."""
    bands: tuple[str, ...] = ()
    """The bands with aligned pixels in it, in the order of the file."""
    nodata: float | None = None
    """The value that it declares."""
    preview: PreviewPart | None = None
    """Where its pictures are, for the preview only."""


@dataclass(frozen=True)
class ProductContext:
    """What products are made of: one capture, its alignments, and the grid of its output."""

    capture: Capture
    paths: CapturePaths
    settings: Settings
    alignments: Mapping[str, Alignment[FixedFilePx]]
    """By moving band; failed ones included."""
    layers: Sequence[Layer]
    """Of all bands, in their order; empty where no moving band can be written."""
    grid: OutputGrid
    """What all rasters are written on; the reference's own where there are no layers."""
    rig: Rig | None
    """Of the flight, where one is known."""
    max_preview_bytes: int
    written: list[WrittenFile] = field(default_factory=list)
    """The files of the products before this one in `PRODUCTS`."""

    @property
    def write_settings(self) -> WriteSettings:
        """The settings of the outputs."""
        return self.settings.write

    @property
    def usable(self) -> dict[str, Alignment[FixedFilePx]]:
        """The alignments that did not fail, by band, in the order of the capture's bands."""
        return {b.name: a for b in self.capture.moving if (a := self.alignments[b.name]).status != "failed"}

    @property
    def places(self) -> dict[str, tuple[Path, int]]:
        """By band with pixels: a file, the stack where there is one, and the band's index there, from 1."""
        gaps = {layer.band.name for layer in self.layers if layer.is_gap}
        return {
            name: (file.path, index)
            for file in self.written
            for index, name in enumerate(file.bands, start=1)
            if name not in gaps
        }

    @cached_property
    def reduced_bands(self) -> ReducedBands:
        """The bands as small grey images, before and after. Raises UnreadableFileError."""
        return read_reduced_bands(self.capture, self.places, self.grid)


class Product(ABC):
    """One kind of output of a capture.

    A new one is a module with a subclass, and an entry in `products/registry.py`. Its files are then listed in the
    sidecar with size and checksum, checked when a run resumes, removed before a capture is done again, protected
    from two captures with one name, and part of the STAC item.
    """

    kind: ClassVar[str]
    """Its name in the sidecar's `products`."""
    suffix: ClassVar[str]
    """What follows the capture's name in the name of its file."""
    is_required: ClassVar[bool] = True
    """False for a convenience: where it fails, the run reports that and the capture counts as done."""
    needs_layers: ClassVar[bool] = True
    """False for what is written even where no moving band can be."""

    def is_enabled(self, settings: WriteSettings) -> bool:  # noqa: ARG002
        """True where these settings ask for it."""
        return True

    def check(self, capture: Capture) -> None:  # noqa: B027
        """Raise an AgalignError if the capture or the installation lacks what it needs.

        It is called before the capture is aligned, and only where the product is enabled.
        """

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Every file that a run with these settings may write or remove, enabled or not."""
        return [paths.file(self.suffix)]

    @abstractmethod
    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write its files, each atomically, and return them; none if nothing can be made.

        Raises OutputError, or UnreadableFileError for an input.
        """
