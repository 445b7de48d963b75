"""Coordinate reference systems: the data of PROJ, WKT, and transformation of map coordinates."""

import os
from functools import cache
from threading import Lock

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio import warp
from rasterio.errors import CRSError

from agalign.errors import ConfigurationError, GeometryError
from agalign.host.text import shortened

_PROJ_VARIABLES = "PROJ_DATA", "PROJ_LIB"
"""Folders of PROJ's data. rasterio uses them instead of its own, whenever one of its environments starts, even if they
belong to another version of PROJ: conda, OSGeo4W and QGIS set these variables."""
_LOCK = Lock()


def ensure_proj_data() -> None:
    """Unset the environment variables of PROJ's data in this process if this PROJ cannot read those data.

    rasterio then uses its own. Without data, files lose their coordinate reference system without an error: call this
    before a file is opened. Raises ConfigurationError if there are no other data.
    """
    with _LOCK:
        _ensure_proj_data()


@cache
def _ensure_proj_data() -> None:
    given = {name: os.environ[name] for name in _PROJ_VARIABLES if name in os.environ}
    if not given or _has_usable_data():
        return
    for name in given:
        del os.environ[name]
    if not _has_usable_data():
        os.environ.update(given)
        name, folder = next(iter(given.items()))
        raise ConfigurationError(f"{name}={folder}: is not the data of this installation of PROJ; unset {name}")


def _has_usable_data() -> bool:
    with rasterio.Env():  # otherwise GDAL prints the error
        try:
            rasterio.CRS.from_epsg(4326)
        except CRSError:
            return False
    return True


def crs_wkt(code: str) -> str:
    """Return the WKT of a coordinate reference system such as EPSG:32613. Raises ConfigurationError."""
    ensure_proj_data()
    return str(rasterio.CRS.from_user_input(code).to_wkt())


def metres_per_unit(crs: str) -> float:
    """Return the unit of the coordinates of a CRS (WKT or EPSG:number), which is not one of degrees, m."""
    return float(rasterio.CRS.from_user_input(crs).units_factor[1])


def transformed(points: NDArray[np.float64], from_crs: str, to_crs: str) -> NDArray[np.float64]:
    """Transform map coordinates (n, 2), x or longitude first, to another CRS (WKT or EPSG:number).

    Raises GeometryError if GDAL cannot transform them, and ConfigurationError.
    """
    ensure_proj_data()
    try:
        source, target = (rasterio.CRS.from_user_input(system) for system in (from_crs, to_crs))
        x, y = warp.transform(source, target, points[:, 0], points[:, 1])
    except Exception as error:  # GDAL's errors have no public class
        cause = shortened(" ".join(f"{error}".split()))  # PROJ's has a description of both systems
        raise GeometryError(f"coordinates cannot be transformed ({cause})") from None
    return np.stack([x, y], axis=-1)
