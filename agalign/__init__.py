"""Co-registers the bands of multispectral drone cameras by learning a descriptor on the images themselves.

import agalign
result = agalign.align(green, nir)                  # two arrays
flight = agalign.align_folder("flight/", "out/")    # everything below a folder
bands = agalign.open_capture("out/IMG_0007.json")   # an xarray Dataset
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from agalign._version import __version__

if TYPE_CHECKING:
    from agalign.api import align, align_capture, align_folder, warp_onto
    from agalign.batch import CaptureReport, FlightReports, RunOptions
    from agalign.cameras.discover import DiscoverOptions, FolderScan, discover
    from agalign.config import (
        CheckSettings,
        FlightSettings,
        JointSettings,
        ReliefSettings,
        SeedSettings,
        Settings,
        WriteSettings,
    )
    from agalign.errors import (
        AgalignError,
        ConfigurationError,
        GeometryError,
        InputError,
        MemoryLimitError,
        NoContrastError,
        NoSuchBandError,
        NotEnoughTextureError,
        OutputError,
        SidecarError,
        UnreadableFileError,
        WorkerError,
    )
    from agalign.products.dataset import open_capture, open_flight
    from agalign.products.read_alignment import read_alignment
    from agalign.values.alignment import Alignment, Prediction, Residual, Seed
    from agalign.values.pixel_units import FixedFilePx, FixedImagePx, MovingFilePx

__all__ = [
    "AgalignError",
    "Alignment",
    "CaptureReport",
    "CheckSettings",
    "ConfigurationError",
    "DiscoverOptions",
    "FixedFilePx",
    "FixedImagePx",
    "FlightReports",
    "FlightSettings",
    "FolderScan",
    "GeometryError",
    "InputError",
    "JointSettings",
    "MemoryLimitError",
    "MovingFilePx",
    "NoContrastError",
    "NoSuchBandError",
    "NotEnoughTextureError",
    "OutputError",
    "Prediction",
    "ReliefSettings",
    "Residual",
    "RunOptions",
    "Seed",
    "SeedSettings",
    "Settings",
    "SidecarError",
    "UnreadableFileError",
    "WorkerError",
    "WriteSettings",
    "__version__",
    "align",
    "align_capture",
    "align_folder",
    "discover",
    "open_capture",
    "open_flight",
    "read_alignment",
    "warp_onto",
]

_OTHER_MODULES = {
    "agalign.api": ("align", "align_capture", "align_folder", "warp_onto"),
    "agalign.batch": ("CaptureReport", "FlightReports", "RunOptions"),
    "agalign.cameras.discover": ("DiscoverOptions", "FolderScan", "discover"),
    "agalign.products.dataset": ("open_capture", "open_flight"),
    "agalign.products.read_alignment": ("read_alignment",),
    "agalign.values.alignment": ("Alignment", "Prediction", "Residual", "Seed"),
    "agalign.values.pixel_units": ("FixedFilePx", "FixedImagePx", "MovingFilePx"),
}
"""Modules of the public names that are neither settings nor errors."""


def __getattr__(name: str) -> Any:
    """Import the module of a public name at its first use (PEP 562): importing torch takes seconds."""
    if name not in __all__:
        raise AttributeError(f"module 'agalign' has no attribute '{name}'")
    rest = "agalign.config" if name.endswith("Settings") else "agalign.errors"
    module = next((module for module, names in _OTHER_MODULES.items() if name in names), rest)
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return sorted(__all__)
