"""Co-registers the bands of multispectral drone cameras by learning a descriptor on the images themselves.

import agalign
result = agalign.align(green, nir)                  # two arrays
flight = agalign.align_folder("flight/", "out/")    # everything below a folder
bands = agalign.open_capture("out/IMG_0007.json")   # an xarray Dataset
"""

from importlib import import_module

from agalign._version import __version__ as __version__

TYPE_CHECKING = False  # `python -m agalign` would import `typing` from the working folder
if TYPE_CHECKING:
    from typing import Any

    from agalign.api import align as align
    from agalign.api import align_capture as align_capture
    from agalign.api import align_folder as align_folder
    from agalign.api import export as export
    from agalign.api import indices as indices
    from agalign.api import onto as onto
    from agalign.api import warp_onto as warp_onto
    from agalign.batch.capture_report import CaptureReport as CaptureReport
    from agalign.batch.capture_report import FlightReports as FlightReports
    from agalign.batch.workers import dask_executor as dask_executor
    from agalign.cameras.discover import FolderScan as FolderScan
    from agalign.cameras.discover import discover as discover
    from agalign.config import CheckSettings as CheckSettings
    from agalign.config import DiscoverOptions as DiscoverOptions
    from agalign.config import FlightSettings as FlightSettings
    from agalign.config import JointSettings as JointSettings
    from agalign.config import ReliefSettings as ReliefSettings
    from agalign.config import RunOptions as RunOptions
    from agalign.config import SeedSettings as SeedSettings
    from agalign.config import Settings as Settings
    from agalign.config import WriteSettings as WriteSettings
    from agalign.errors import AgalignError as AgalignError
    from agalign.errors import ConfigurationError as ConfigurationError
    from agalign.errors import GeometryError as GeometryError
    from agalign.errors import InputError as InputError
    from agalign.errors import NoContrastError as NoContrastError
    from agalign.errors import NoSuchBandError as NoSuchBandError
    from agalign.errors import NotEnoughTextureError as NotEnoughTextureError
    from agalign.errors import OutputError as OutputError
    from agalign.errors import SidecarError as SidecarError
    from agalign.errors import UnreadableFileError as UnreadableFileError
    from agalign.errors import WorkerError as WorkerError
    from agalign.exports.dataset import open_capture as open_capture
    from agalign.exports.dataset import open_flight as open_flight
    from agalign.exports.programs import ExportReport as ExportReport
    from agalign.rasters.read_alignment import read_alignment as read_alignment
    from agalign.spectral_indices.rasters import IndexReport as IndexReport
    from agalign.values.alignment import Alignment as Alignment
    from agalign.values.alignment import Prediction as Prediction
    from agalign.values.alignment import Seed as Seed
    from agalign.values.capture import Capture as Capture
    from agalign.values.mapping_error import MappingError as MappingError
    from agalign.values.moved_area import MovedArea as MovedArea
    from agalign.values.residual import Residual as Residual

_NAMES = {
    "api": "align align_capture align_folder export indices onto warp_onto",
    "batch.capture_report": "CaptureReport FlightReports",
    "batch.workers": "dask_executor",
    "cameras.discover": "FolderScan discover",
    "config": "CheckSettings DiscoverOptions FlightSettings JointSettings ReliefSettings RunOptions SeedSettings "
    "Settings WriteSettings",
    "errors": "AgalignError ConfigurationError GeometryError InputError NoContrastError "
    "NoSuchBandError NotEnoughTextureError OutputError SidecarError UnreadableFileError WorkerError",
    "exports.dataset": "open_capture open_flight",
    "exports.programs": "ExportReport",
    "spectral_indices.rasters": "IndexReport",
    "rasters.read_alignment": "read_alignment",
    "values.alignment": "Alignment Prediction Seed",
    "values.capture": "Capture",
    "values.mapping_error": "MappingError",
    "values.moved_area": "MovedArea",
    "values.residual": "Residual",
}
"""Public names by module. A module is imported at the first use of one of its names (PEP 562): torch takes seconds."""
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted([*_MODULES, "__version__"])


def __getattr__(name: str) -> "Any":
    if name not in _MODULES:
        raise AttributeError(f"module 'agalign' has no attribute '{name}'")
    return getattr(import_module(f"agalign.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
