"""Scores of a capture with depth by its exact geometry: residuals, range, occlusions."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from common import WRONG_PX
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from synthetic_flights.depth import BandTruth, Truth

from agalign.pixels.raster import without_warnings
from agalign.products.sidecar.file import find_sidecars

Map = NDArray[np.float64]
"""(height, width, 2): raw px of the moving image for each raw px of the reference."""
Window = tuple[slice, slice]
"""Rows and columns of the reference."""
WHOLE: Window = (slice(None), slice(None))

_TOLERANCE_PX = 1
"""An occluded pixel counts as found, and a masked one as right, where the other is this near: truth is decided at
pixel centres."""


@dataclass(frozen=True)
class Score:
    """One band of one capture by one method. Values are nan where nothing can be measured."""

    method: str
    kind: str
    close: bool
    scene: int
    band: str = ""
    status: str = "-"
    """`-` for a method that does not verify."""
    median_px: float = np.nan
    p90_px: float = np.nan
    beyond_1_px: float = np.nan
    """Share of the pixels."""
    range_error: float = np.nan
    """Median relative error of the relief's range."""
    density: float = np.nan
    """Share of the written pixels that have a range."""
    precision: float = np.nan
    recall: float = np.nan
    """Of the pixels without data in the stack, against the occluded ones."""
    seconds: float = np.nan
    """Processing time of the whole capture."""

    @property
    def wrong(self) -> bool:
        """True for a wrong acceptance: the band is misaligned, or does not show the scene."""
        return self.status == "aligned" and not self.p90_px <= WRONG_PX

    @property
    def place(self) -> str:
        """Kind and distance of the scene."""
        return f"{self.kind}, {'close' if self.close else 'far'}, scene {self.scene}"


@dataclass(frozen=True)
class Sidecar:
    """Outputs of a run for a capture."""

    path: Path
    content: dict[str, Any]

    @property
    def moving(self) -> list[dict[str, Any]]:
        """The bands but for the reference."""
        return [band for band in self.content["bands"] if band["status"] != "reference"]

    @property
    def window(self) -> Window:
        """Rows and columns of the reference in the output."""
        x0, y0, width, height = self.content["output"]["crop"]
        return slice(y0, y0 + height), slice(x0, x0 + width)


def read_sidecar(out: Path) -> Sidecar:
    """Return the one sidecar below the output of a run."""
    (path,) = find_sidecars(out)
    return Sidecar(path, json.loads(path.read_text(encoding="utf-8")))


def mapping_of(sidecar: Sidecar, band: dict[str, Any]) -> Map | None:
    """The mapping of a band at every pixel of the reference, as its sidecar has it: from `relief` and the raster that
    it names, nan outside the written area, else from `grid`. None where it has neither.
    """
    relief, grid = band.get("relief"), band.get("grid")
    if relief and relief["file"]:
        plane_px, slope = (_interpolated(sidecar, relief["reference_px"], relief[k]) for k in ("plane_px", "slope"))
        parallax_px = np.full(plane_px.shape[:2], np.nan)
        parallax_px[sidecar.window] = layer(sidecar.path.parent / relief["file"], "parallax")
        return np.asarray(plane_px + parallax_px[..., None] * slope)
    return _interpolated(sidecar, grid["reference_px"], grid["moving_px"]) if grid else None


def _interpolated(sidecar: Sidecar, nodes_px: list[list[float]], values: list[list[float]]) -> Map:
    """A cubic spline at every pixel of the reference, through values on a lattice of nodes, row by row."""
    here, there = np.array(nodes_px, np.float64), np.array(values, np.float64)
    x, y = np.unique(here[:, 0]), np.unique(here[:, 1])
    columns, rows = (np.arange(sidecar.content["reference"][name]) for name in ("width", "height"))
    lattice = there.reshape(len(y), len(x), 2)
    return np.stack([RectBivariateSpline(y, x, lattice[..., k])(rows, columns) for k in (0, 1)], axis=-1)


def layer(path: Path, name: str) -> NDArray[np.float64] | None:
    """(height, width) of a relief's raster, nan where it has no data; None where it has no such layer."""
    with without_warnings(), rasterio.open(path) as dataset:
        names = dataset.descriptions
    return _read(path, names.index(name) + 1) if name in names else None


def written(sidecar: Sidecar, name: str) -> NDArray[np.float64]:
    """(height, width) of a band of the stack, nan where it has no data."""
    (place,) = (band["place"] for band in sidecar.content["bands"] if band["band"] == name)
    return _read(sidecar.path.parent / place["file"], place["band_index"])


def _read(path: Path, index: int) -> NDArray[np.float64]:
    with without_warnings(), rasterio.open(path) as dataset:
        return np.asarray(dataset.read(index, masked=True).astype(np.float64).filled(np.nan))


def residuals(mapping: Map | None, truth: BandTruth, window: Window = WHOLE) -> dict[str, float]:
    """Return median, 90th percentile and share beyond 1 px of the distance to the truth, as fields of a score, over
    pixels of a window that the band shows and that did not move.
    """
    some = truth.scored[window]
    if mapping is None or not some.any():
        return {}
    error_px = np.linalg.norm(mapping[window][some] - truth.moving_px[window][some], axis=-1)
    # A pixel without a mapping is infinitely far off, which no interpolating quantile can express.
    error_px = np.sort(np.where(np.isfinite(error_px), error_px, np.inf))
    median, p90 = (float(error_px[int(share * (len(error_px) - 1))]) for share in (0.5, 0.9))
    return {"median_px": median, "p90_px": p90, "beyond_1_px": float((error_px > 1).mean())}


def range_errors(sidecar: Sidecar, truth: Truth) -> tuple[float, float]:
    """(median relative error, density) of the range in <capture>.relief.tif, which has it with --relief-map."""
    relief = sidecar.path.with_suffix(".relief.tif")
    range_m = layer(relief, "range") if relief.is_file() else None
    if range_m is None:
        return np.nan, np.nan
    expected = truth.range_m[sidecar.window]
    some = np.isfinite(range_m) & (range_m > 0)
    if not some.any():
        return np.nan, 0.0
    return float(np.median(np.abs(range_m[some] / expected[some] - 1))), float(some.mean())


def occlusion_scores(sidecar: Sidecar, band: dict[str, Any], truth: BandTruth) -> dict[str, float]:
    """Return precision and recall, as fields of a score, of the pixels without data in the stack, where the truth is
    inside the moving image.
    """
    place = band.get("place")
    if place is None:
        return {}
    masked = np.isnan(_read(sidecar.path.parent / place["file"], place["band_index"]))
    inside = truth.inside[sidecar.window]
    masked, hidden = masked & inside, truth.hidden[sidecar.window] & inside
    return {"precision": _share(masked, _grown(hidden)), "recall": _share(hidden, _grown(masked))}


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    side = 2 * _TOLERANCE_PX + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _share(some: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(of[some].mean()) if some.any() else np.nan
