"""Tiles of a flight for PyTorch, with a mask of the usable pixels; the flight was aligned with `--qa`.

python examples/training_tiles.py OUT

OUT has stacks and quality flags (`--layout stack`, `--qa`). All bands have the pixels of the reference, so one label
raster fits all of them: draw it over `<capture>.tif`, save it as `<capture>.labels.tif`, and read it by
`Tiles(stacks, labels=True)`. In a loss per pixel, use `usable[k].all(0)` of the bands k
that the network gets.

Neighbouring captures overlap: the split is by position, and no capture for validation has ground of one for training.
That needs the footprints of `OUT/flight.geojson` (GPS position, altitude, yaw and focal length in the tags). With
several flights, validate on one over other ground.
"""

import json
import sys
from pathlib import Path

import numpy as np
import rasterio
import torch
from rasterio.windows import Window

MASKED = 863
"""All quality flags except `error_over_half_px` (32): bands of blur and noise are `predicted` (16). 847 keeps them, as
`agalign indices --mask-qa` does.
"""


class Tiles(torch.utils.data.Dataset):
    """Tiles of stacks: pixels (float32) and usable pixels (bool), each (bands, side, side), in the order of the bands;
    with `labels` also those (int64), (side, side).

    All stacks of a camera have the same bands. Narrower rests at the right and lower edges are dropped.
    """

    def __init__(self, stacks, side_px=256, labels=False):
        self.tiles, self.labels = [], labels
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
        usable = ((flags & MASKED) == 0) & np.isfinite(bands)
        if not self.labels:
            return np.nan_to_num(bands), usable
        with rasterio.open(path.with_suffix(".labels.tif")) as file:
            return np.nan_to_num(bands), usable, file.read(1, window=window).astype("int64")


def box(feature):
    """Return the west, south, east and north ends of a footprint, degrees, with its standard error as a margin."""
    if feature["geometry"] is None or feature["geometry"]["type"] != "Polygon":
        sys.exit(f"{feature['id']}: has no footprint (GPS position, altitude, yaw or focal length); split by flight")
    corners = np.array(feature["geometry"]["coordinates"][0])
    margin_lat = (feature["properties"]["accuracy_m"] or 0) / 111_000
    margin = np.array([margin_lat / np.cos(np.radians(corners[0, 1])), margin_lat])
    return np.concatenate([corners.min(axis=0) - margin, corners.max(axis=0) + margin])


def split(boxes, share=0.6):
    """Return the western captures for training, and those captures for validation that overlap none of them."""
    names = sorted(boxes, key=lambda name: boxes[name][0] + boxes[name][2])
    training, others = names[: int(len(names) * share)], names[int(len(names) * share) :]
    west, south, east, north = np.array([boxes[name] for name in training]).reshape(-1, 4).T

    def is_apart(box):
        return not np.any((west < box[2]) & (box[0] < east) & (south < box[3]) & (box[1] < north))

    return training, [name for name in others if is_apart(boxes[name])]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/training_tiles.py OUT")
    out = Path(sys.argv[1])
    stacks = {path.with_name(path.name.replace(".qa", "")) for path in out.rglob("*.qa.tif")}
    if not stacks:
        sys.exit(f"{out}: has no quality flags; align with --qa")
    flight_map = out / "flight.geojson"
    if not flight_map.is_file():
        sys.exit(f"{flight_map}: is missing, as no capture has a GPS position; split by flight")
    features = json.loads(flight_map.read_text(encoding="utf-8"))["features"]
    boxes = {out / f["properties"]["stack"]: box(f) for f in features if f["properties"].get("stack")}
    training, validation = split({stack: boxes[stack] for stack in stacks & boxes.keys()})
    unused = len(stacks) - len(training) - len(validation)
    print(f"captures: {len(training)} for training, {len(validation)} for validation, {unused} unused")
    if not training or not validation:
        sys.exit("all captures of the eastern part overlap one for training; use a larger flight, or split by flight")
    training, validation = Tiles(training), Tiles(validation)
    print(f"{len(training)} tiles for training, {len(validation)} for validation")
    for bands, usable in torch.utils.data.DataLoader(training, batch_size=8):
        loss = ((bands - bands.mean()) ** 2 * usable).sum() / usable.sum().clamp(min=1)
        print(f"{tuple(bands.shape)}: {float(loss):.3g}")
