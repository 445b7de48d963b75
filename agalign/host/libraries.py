"""Versions of the libraries that are used, from their metadata: no library is imported."""

import platform
from importlib import metadata

REQUIRED = ("torch", "numpy", "opencv-python-headless", "rasterio", "tifffile", "scikit-image", "scipy", "pydantic")
OPTIONAL = ("distributed", "itk-elastix", "rioxarray", "spyndex", "xarray")
"""Libraries of extras."""


def library_versions() -> dict[str, str]:
    """Return the versions of Python, of the main libraries, and of the installed libraries of extras, by name."""
    versions = {name: _version(name) for name in (*REQUIRED, *OPTIONAL)}
    known = {name: version or "not installed" for name, version in versions.items() if version or name in REQUIRED}
    return {"python": platform.python_version()} | known


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
