"""Opening of files by GDAL: the one place that gives it a name, its environment, and its messages."""

import ctypes
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import rasterio
from rasterio import crs
from rasterio.errors import NotGeoreferencedWarning

from agalign.host.held_sizes import GDAL_CACHE_BYTES
from agalign.host.text import name_problem

_ENVIRONMENT = {
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_NUM_THREADS": "ALL_CPUS",
    "GDAL_CACHEMAX": GDAL_CACHE_BYTES,
}
"""GDAL neither writes auxiliary files next to the images nor reads them: x.tif.ovr may contain anything, such as a
description that refers to other files or to a server.
"""
with suppress(AttributeError, OSError):  # builds of GDAL with a libtiff of their own may hide it
    # libtiff prints failed reads and writes of files to standard error, past GDAL's and rasterio's handlers. The caller
    # gets an exception or an incomplete file.
    ctypes.CDLL(crs.__file__).TIFFSetErrorHandler(None)


def gdal_name(path: Path, page: int = 0) -> str:
    """Return the name by which GDAL opens a local file, or a page of a TIFF (from 1): its absolute path.

    GDAL and rasterio parse names. A relative path such as `s3:/x`, `file:/x` or `GTIFF_DIR:1:x.tif` is an address or
    another file, and a path below `/vsi…` a virtual one.
    """
    name = str(path.absolute())
    if name_problem(name):  # that of the working folder, which a relative path does not need
        name = os.path.join(os.curdir, path)  # noqa: PTH118 - a Path drops the dot
    if name.startswith(("/vsi", "//")):
        name = f"/./{name.lstrip('/')}"
    return f"GTIFF_DIR:{page}:{name}" if page else name


@contextmanager
def open_local(path: Path, mode: str = "r", *, page: int = 0, **options: Any) -> Iterator[Any]:
    """Open a local file, or a page of a TIFF (from 1), with these options of `rasterio.open`.

    Raises the errors of rasterio and UnicodeEncodeError.
    """
    with (
        without_warnings(),
        rasterio.Env(**_ENVIRONMENT),
        rasterio.open(gdal_name(path, page), mode, **options) as dataset,
    ):
        yield dataset


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress rasterio's warning about images without a georeference, which drone images do not have.

    Warning filters apply to the whole process. Code that reads in several threads needs this context around all of
    them, so that no thread restores the filter while another one reads.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def is_gdal_error(error: BaseException) -> bool:
    """Return True for an error of rasterio or GDAL: some of their classes are not public."""
    return type(error).__module__.startswith("rasterio.")


def innermost_cause(error: BaseException) -> str:
    """Return the first line of the innermost cause, GDAL's message; rasterio's own message is generic."""
    while error.__cause__ is not None:
        error = error.__cause__
    return next(iter(str(error).splitlines()), type(error).__name__)


def gdal_version() -> str:
    """Return the version of rasterio's GDAL."""
    return str(rasterio.__gdal_version__)
