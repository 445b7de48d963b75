"""Tiles of a flight for PyTorch, with a mask of the usable pixels; the flight was aligned with `--qa`.

python examples/training_tiles.py OUT

All bands have the pixels of the reference, so one label raster fits all of them. Neighbouring captures overlap: split
by flight, or by position with a gap between the parts as here, not by tile. The gap must be wider than an image.
"""

import json
import sys
from pathlib import Path

import numpy as np
import rasterio
import torch
from rasterio.windows import Window

MASKED = 847
"""All quality flags except `predicted` (16) and `error_over_half_px` (32), as `agalign indices --mask-qa` masks."""


class Tiles(torch.utils.data.Dataset):
    """Tiles of stacks: pixels (float32) and usable pixels (bool), each (bands, side, side), in the order of the bands.

    All stacks of a camera have the same bands. Narrower rests at the right and lower edges are dropped.
    """

    def __init__(self, stacks, side_px=256):
        self.tiles = []
        for path in stacks:
            with rasterio.open(path) as stack:
                corners = np.ndindex(stack.height // side_px, stack.width // side_px)
            self.tiles += [(path, Window(x * side_px, y * side_px, side_px, side_px)) for y, x in corners]

    def __len__(self):
        return len(self.tiles)

    def __getitem__(self, number):
        path, window = self.tiles[number]
        with rasterio.open(path) as stack, rasterio.open(path.with_suffix(".qa.tif")) as quality:
            bands = stack.read(window=window).astype("float32")
            flags = quality.read(range(2, quality.count + 1), window=window)
        usable = (flags & MASKED) == 0
        return np.nan_to_num(bands), usable & np.isfinite(bands)


def longitude(stack):
    """Return the position of a capture from its sidecar."""
    position = json.loads(stack.with_suffix(".json").read_text(encoding="utf-8"))["position"]
    if position is None:
        sys.exit(f"{stack}: has no GPS position; split by flight")
    return position["longitude"]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/training_tiles.py OUT")
    stacks = [path.with_name(path.name.replace(".qa", "")) for path in Path(sys.argv[1]).rglob("*.qa.tif")]
    stacks.sort(key=longitude)  # from west to east; captures in between are not used
    training, validation = Tiles(stacks[: len(stacks) * 6 // 10]), Tiles(stacks[len(stacks) * 8 // 10 :])
    print(f"{len(training)} tiles for training, {len(validation)} for validation")
    for bands, usable in torch.utils.data.DataLoader(training, batch_size=8):
        loss = ((bands - bands.mean()) ** 2 * usable).sum() / usable.sum()
        print(f"{tuple(bands.shape)}: {float(loss):.3g}")
