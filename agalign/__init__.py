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
    from agalign.errors import AgalignError
    from agalign.products.dataset import open_capture, open_flight

__all__ = [
    "AgalignError",
    "__version__",
    "align",
    "align_capture",
    "align_folder",
    "open_capture",
    "open_flight",
    "warp_onto",
]

_HOMES = {
    "align": "agalign.api",
    "align_capture": "agalign.api",
    "align_folder": "agalign.api",
    "warp_onto": "agalign.api",
    "open_capture": "agalign.products.dataset",
    "open_flight": "agalign.products.dataset",
    "AgalignError": "agalign.errors",
}


def __getattr__(name: str) -> Any:
    """Torch takes seconds to import, so nothing that needs it is imported before it is asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'agalign' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
