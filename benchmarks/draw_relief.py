"""The picture of a parallax map in docs/explanation/method.md.

    python benchmarks/draw_relief.py [PICTURE]

A synthetic scene with depth: the reference band, the parallax map, and near infra-red, red and green as the colours of
an enlarged part, aligned by homographies alone and with the parallax map.
"""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from common import align, flight_and_out, layer, only_sidecar, pyplot, run, window_of
from numpy.typing import NDArray
from PIL import Image
from synthetic_flights.depth import write_capture
from synthetic_flights.relief import make_scene

from agalign.pixels.band_resampling import eight_bit

SCENE, SCENE_SIZE_PX = 1001, (960, 720)
"""Boxes on a bench and on the floor next to it, 0.95 to 1.75 m away."""
DETAIL = np.s_[115:225, 205:381]
"""Enlarged part of the scene, px of the reference: the upper corner of a box, and the bench's edge."""
NO_DATA = 90
"""Grey level of pixels that a band does not show."""


def detail(out: Path) -> NDArray[np.uint8]:
    """Return (height, width, 3) of the enlarged part in false colours; grey where one of the bands has no data."""
    path, sidecar = only_sidecar(out)
    bands = np.stack([layer(path.with_suffix(".tif"), name) for name in ("NIR", "Red", "Green")], axis=-1)
    image = np.dstack([stretched(band) for band in np.moveaxis(bands, -1, 0)])
    image[np.isnan(bands).any(axis=-1)] = NO_DATA
    whole = np.zeros((*SCENE_SIZE_PX[::-1], 3), np.uint8)
    whole[window_of(sidecar)] = image
    return np.asarray(cv2.resize(whole[DETAIL], None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST))


def stretched(pixels: NDArray[np.float64]) -> NDArray[np.uint8]:
    return eight_bit(np.nan_to_num(pixels), np.isfinite(pixels))


def main(picture: Annotated[Path, typer.Argument()] = Path("docs/figures/relief.png")) -> None:
    with flight_and_out() as (flight, out):
        scene = make_scene("boxes", SCENE, width_px=SCENE_SIZE_PX[0])
        write_capture(flight, scene, size_px=SCENE_SIZE_PX, rng_seed=SCENE)
        for use in ("auto", "never"):
            align(flight, out / use, "--relief", use)
        path, sidecar = only_sidecar(out / "auto")
        x0, y0, width, height = sidecar.output.crop
        extent = (x0, x0 + width, y0 + height, y0)
        plt, panels = pyplot(), [["reference", "relief", "before"], ["reference", "relief", "after"]]
        style = {"figsize": (10.4, 3.0), "width_ratios": (3.6, 3.95, 1.95), "layout": "constrained"}
        figure, axes = plt.subplot_mosaic(panels, **style)
        axes["reference"].imshow(stretched(layer(path.with_suffix(".tif"), "Green")), cmap="gray", extent=extent)
        parallax_px = layer(path.with_suffix(".relief.tif"), "parallax")
        shown = axes["relief"].imshow(parallax_px, cmap="viridis", extent=extent)
        axes["before"].imshow(detail(out / "never"))
        axes["after"].imshow(detail(out / "auto"))
    figure.colorbar(shown, ax=axes["relief"], fraction=0.05, pad=0.02, label="parallax, px (far → near)")
    titles = "reference band", "parallax map", "homographies alone", "with the parallax map"
    for axis, title in zip(axes.values(), titles, strict=True):
        axis.set(xticks=[], yticks=[], title=title)
    rows, columns = DETAIL
    corner, size = (columns.start, rows.start), (columns.stop - columns.start, rows.stop - rows.start)
    for name in ("reference", "relief"):
        axes[name].add_patch(plt.Rectangle(corner, *size, fill=False, edgecolor="#ff4d4d", linewidth=1.6))
    figure.savefig(picture, dpi=100)
    Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)  # a third of the size


if __name__ == "__main__":
    run(main)
