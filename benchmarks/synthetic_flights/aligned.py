"""Output folders of runs, with stacks and sidecars of aligned captures of a field of rows, without aligning any."""

import json
from pathlib import Path

import numpy as np
import rasterio

from agalign.pixels.gdal import without_warnings
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import file_part, read_sidecar, write_sidecar

BANDS = {"Green": (560, 0.12, 0.1), "Red": (668, 0.2, 0.05), "NIR": (842, 0.3, 0.52), "Red edge": (717, 0.24, 0.3)}
"""Wavelength in nm, and reflectance of soil and of vegetation."""
_FULL = 40000
"""Raw number of a reflectance of 1."""


def make_aligned(folder: Path, captures: int, size_px: tuple[int, int] = (160, 120), *, raw: bool = False) -> None:
    """Write captures of a field of rows below `folder`/0000SET, as reflectance or as raw numbers."""
    rng = np.random.default_rng(0)
    crop = (np.sin(np.arange(size_px[0]) / 3) > 0) * np.ones((size_px[1], 1))
    target = folder / "0000SET"
    target.mkdir(parents=True)
    for number in range(1, captures + 1):
        name = f"IMG_{number:04d}"
        cover = (crop + rng.normal(0, 0.05, crop.shape)).clip(0, 1)
        write_stack(target / f"{name}.tif", reflectances(cover), raw=raw)
        list_stack(target / f"{name}.json", sidecar_of(name, number, size_px, raw=raw))


def list_stack(path: Path, sidecar: Sidecar | None = None) -> None:
    """Write a sidecar, by default the one at `path`, with size and checksum of the stack beside it."""
    products = [file_part("stack", path.with_suffix(".tif"), path.parent)]
    write_sidecar(path, (sidecar or read_sidecar(path)).model_copy(update={"products": products}))


def reflectances(cover: np.ndarray) -> np.ndarray:
    """Return (4, height, width) of the bands for shares (height, width) of vegetation."""
    return np.stack([soil + (vegetation - soil) * cover for _, soil, vegetation in BANDS.values()])


def write_stack(path: Path, planes: np.ndarray, *, raw: bool = False) -> None:
    """Write reflectances (4, height, width) as a stack of agalign, or raw numbers in proportion to them."""
    count, height, width = planes.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": count, "compress": "zstd"}
    profile |= {"dtype": "uint16"} if raw else {"dtype": "float32", "nodata": np.nan}
    of_stack, of_band = ({}, {}) if raw else ({"RADIOMETRY": "reflectance"}, {"QUANTITY": "reflectance"})
    with without_warnings(), rasterio.open(path, "w", **profile) as dataset:
        dataset.write((planes * _FULL if raw else planes).astype(profile["dtype"]))
        dataset.descriptions = tuple(BANDS)
        dataset.update_tags(TIFFTAG_DATETIME="2026:06:21 10:00:00", **of_stack)
        for index, (wavelength_nm, *_) in enumerate(BANDS.values(), start=1):
            dataset.update_tags(index, wavelength=wavelength_nm, wavelength_units="nm", **of_band)


def sidecar_of(name: str, number: int, size_px: tuple[int, int], *, raw: bool) -> Sidecar:
    """The sidecar of aligned.json with another name, time, place and size."""
    width, height = size_px
    content = json.loads(Path(__file__).with_name("aligned.json").read_text(encoding="utf-8").replace("IMG_0001", name))
    content["captured_at"] = f"2026-06-21T10:{number // 60 % 60:02d}:{number % 60:02d}"
    content["position"]["longitude"] += 1e-4 * number
    content["reference"] |= {"width": width, "height": height}
    content["output"]["crop"] = 0, 0, width, height
    if raw:
        content["output"] |= {"radiometry": None, "nodata": None}
    return Sidecar.model_validate_json(json.dumps(content))
