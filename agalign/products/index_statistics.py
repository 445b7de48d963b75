"""Statistics of the values of an index raster, which its tag INDEX_STATISTICS contains."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agalign.errors import AgalignError
from agalign.pixels.raster import open_raster

STATISTICS_TAG = "INDEX_STATISTICS"


@dataclass(frozen=True)
class IndexStatistics:
    """The values of an index raster; nan if no pixel is valid."""

    median: float = math.nan
    p5: float = math.nan
    p95: float = math.nan
    valid_share: float = 0.0
    unit: str = ""
    """Unit of the bands: reflectance, radiance, or raw numbers."""
    low: float = math.nan
    """Value at the lower end of the colour scale of the picture."""
    high: float = math.nan
    """Value at the upper end of the colour scale."""

    def as_json(self) -> dict[str, float | str | None]:
        """Return the fields by name, with null for nan, which JSON does not have."""
        return {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in vars(self).items()}


NO_STATISTICS = IndexStatistics()
"""Of a raster that was not written."""


def statistics_in(tags: Mapping[str, str]) -> IndexStatistics | None:
    """Return the statistics in the tags of a raster; None if there are none."""
    try:
        fields: dict[str, Any] = json.loads(tags[STATISTICS_TAG])
        unit = str(fields.pop("unit"))
        return IndexStatistics(unit=unit, **{k: math.nan if v is None else float(v) for k, v in fields.items()})
    except (KeyError, ValueError, TypeError):
        return None


def read_statistics(path: Path) -> IndexStatistics | None:
    """Return the statistics of an index raster; None for another file, or one that cannot be read."""
    try:
        with open_raster(path) as source:
            return statistics_in(source.tags())
    except AgalignError:
        return None
