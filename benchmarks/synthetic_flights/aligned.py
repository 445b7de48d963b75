"""The output folder of a run, with stacks and sidecars of aligned captures, made without aligning any."""

import json
from pathlib import Path

import numpy as np
import rasterio

from agalign.products.sidecar import Sidecar
from agalign.products.sidecar_file import write_sidecar

BANDS = {"Green": 560.0, "Red": 668.0, "NIR": 842.0, "Red edge": 717.0}
_FULL = 40000
"""Of a raw number."""


def make_aligned(
    folder: Path, captures: int, size_px: tuple[int, int] = (160, 120), *, raw: bool = False, rng_seed: int = 0
) -> None:
    """Write captures of a field of rows below `folder`/0000SET, as reflectance or as raw numbers."""
    rng = np.random.default_rng(rng_seed)
    width, height = size_px
    crop = (np.sin(np.arange(width) / 3) > 0) * np.ones((height, 1))
    target = folder / "0000SET"
    target.mkdir(parents=True)
    profile = {"driver": "GTiff", "width": width, "height": height, "count": len(BANDS), "compress": "zstd"}
    profile |= {"dtype": "uint16"} if raw else {"dtype": "float32", "nodata": np.nan}
    for number in range(1, captures + 1):
        cover = (crop + rng.normal(0, 0.05, crop.shape)).clip(0, 1)
        levels = {"Green": (0.12, 0.1), "Red": (0.2, 0.05), "NIR": (0.3, 0.52), "Red edge": (0.24, 0.3)}
        name = f"IMG_{number:04d}"
        with rasterio.open(target / f"{name}.tif", "w", **profile) as dataset:
            for index, (low, high) in enumerate(levels.values(), start=1):
                values = low + (high - low) * cover
                dataset.write((values * _FULL).astype(np.uint16) if raw else values.astype(np.float32), index)
            dataset.descriptions = tuple(levels)
            if not raw:
                dataset.update_tags(RADIOMETRY="reflectance")
        write_sidecar(target / f"{name}.json", sidecar_of(name, number, size_px, raw=raw))


def sidecar_of(name: str, number: int, size_px: tuple[int, int], *, raw: bool) -> Sidecar:
    """The sidecar of aligned.json with another name, time, place and size."""
    width, height = size_px
    text = (Path(__file__).parent / "aligned.json").read_text(encoding="utf-8").replace("IMG_0001", name)
    content = json.loads(text)
    content["captured_at"] = f"2026-06-21T10:{number // 60 % 60:02d}:{number % 60:02d}"
    content["position"]["longitude"] += 1e-4 * number
    content["reference"] |= {"width": width, "height": height}
    content["output"]["crop"] = 0, 0, width, height
    if raw:
        content["output"] |= {"radiometry": None, "nodata": None}
    content["products"][0]["sha256"] = f"{number:064x}"
    return Sidecar.model_validate(content)
