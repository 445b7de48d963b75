"""The raster of the parallax of a capture at every pixel of the reference: a part of the result of the estimation.

The relief raster on the grid of the stack is rendered from it, as that grid may be another one.
"""

from pathlib import Path

import numpy as np

from agalign.errors import SidecarError
from agalign.pixels.raster import open_raster
from agalign.rasters.geotiff import LayerDescription, compressed, write_on_grid
from agalign.records.listed_files import file_problem
from agalign.records.sidecar import Sidecar
from agalign.values.capture import Georeference
from agalign.values.image import OutputGrid
from agalign.values.parallax import RELIEF_STEP, Relief

PARALLAX_KIND, PARALLAX_SUFFIX = "parallax", ".parallax.tif"
_LAYERS = {"parallax": "px", "confidence": "1", "standard error": "px"}
"""Units by layer; the last one is written if it is known."""


def write_parallax(path: Path, relief: Relief, georeference: Georeference | None) -> None:
    """Write a relief at the pixels of the reference. Raises OutputError."""
    values = [relief.parallax_px, relief.confidence, *([] if relief.std_px is None else [relief.std_px])]
    height, width = relief.parallax_px.shape
    layers = [
        LayerDescription(name, unit, scale_offset=(RELIEF_STEP, 0.0))
        for name, unit in list(_LAYERS.items())[: len(values)]
    ]
    steps = (np.rint(layer.astype(np.float64) / RELIEF_STEP).astype(np.int32) for layer in values)
    blocks = ((layer, index, 0, 0) for index, layer in enumerate(steps, start=1))
    grid, options = OutputGrid(0, 0, width, height), compressed("int32") | {"interleave": "band"}
    write_on_grid(path, grid, georeference, layers, blocks, dtype="int32", options=options)


def read_relief(sidecar: Sidecar, folder: Path) -> Relief | None:
    """Return the relief of a capture, given the folder of its sidecar; None if it has none.

    Raises SidecarError for a file that is missing or not the one that the sidecar lists, UnreadableFileError.
    """
    if sidecar.parallax is None:
        return None
    path = folder / sidecar.parallax.file
    if problem := file_problem(path, sidecar.parallax):
        raise SidecarError(problem)
    with open_raster(path) as file:
        if (file.width, file.height) != sidecar.reference.size_px or file.count < len(_LAYERS) - 1:
            raise SidecarError(f"{path}: is not the parallax of {sidecar.capture}; run again with --overwrite")
        steps = file.read()[: len(_LAYERS)].astype(np.float64)
        parallax_px, confidence, *std_px = (steps * RELIEF_STEP).astype(np.float32)
    return Relief(parallax_px, confidence, std_px=std_px[0] if std_px else None)
