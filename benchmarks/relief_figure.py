"""Draw a scene with depth: the reference band, the parallax of its relief, and bands by homographies and by the relief.

    python benchmarks/relief_figure.py FIGURE.png [FOLDER]

The scene is rendered, and aligned by the command line twice; FOLDER keeps what was made for the next call.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import rasterio
import typer
from common import align, pyplot, run
from numpy.typing import NDArray
from PIL import Image
from relief_score import Sidecar, read_sidecar
from synthetic_flights.depth import write_capture
from synthetic_flights.relief import make_scene

from agalign.pixels.raster import without_warnings

SIZE_PX, SCENE = (960, 720), 1001
"""Boxes on a bench and on the floor next to it, 0.95 to 1.75 m away."""
COMPOSITE = "NIR", "Red", "Green"
_DETAIL = 205, 115, 176, 110
"""x, y, width, height of the enlarged part, px of the reference: the upper corner of a box, and the bench's edge."""
_HIDDEN = 90
"""Grey of pixels that a band does not show."""


def main(figure: Path, folder: Annotated[Path | None, typer.Argument()] = None) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = folder or Path(temporary)
        if not (folder / "flight").is_dir():
            scene = make_scene("boxes", SCENE, close=True, width_px=SIZE_PX[0])
            write_capture(folder / "flight", scene, size_px=SIZE_PX, rng_seed=SCENE)
        aligned, flat = (aligned_by(folder, name, use) for name, use in (("aligned", "auto"), ("flat", "never")))
        draw(aligned, flat, figure)


def aligned_by(folder: Path, name: str, use: str) -> Sidecar:
    """The sidecar of an alignment."""
    if not (folder / name).is_dir():
        align(folder / "flight", folder / name, "--relief", use)
    return read_sidecar(folder / name)


def draw(aligned: Sidecar, flat: Sidecar, path: Path) -> None:
    x0, y0, width, height = aligned.content["output"]["crop"]
    extent = (x0, x0 + width, y0 + height, y0)
    relief = aligned.path.with_suffix(".relief.tif")
    plt, panels = pyplot(), [["reference", "relief", "before"], ["reference", "relief", "after"]]
    style = {"figsize": (10.4, 3.0), "width_ratios": (3.6, 3.95, 1.95), "layout": "constrained"}
    figure, axes = plt.subplot_mosaic(panels, **style)
    axes["reference"].imshow(stretched(band(aligned, "Green")), cmap="gray", extent=extent)
    axes["reference"].set_title("reference band")
    with without_warnings(), rasterio.open(relief) as dataset:
        shown = axes["relief"].imshow(dataset.read(1), cmap="viridis", extent=extent)
    axes["relief"].set_title("relief: parallax, px")
    figure.colorbar(shown, ax=axes["relief"], fraction=0.05, pad=0.02, label="far → near")
    left, top, columns, rows = _DETAIL
    for name, sidecar, title in (("before", flat, "homographies"), ("after", aligned, "with the relief")):
        axes[name].imshow(detail(sidecar))
        axes[name].set_title(title)
    for name in ("reference", "relief"):
        frame = plt.Rectangle((left, top), columns, rows, fill=False, edgecolor="#ff4d4d", linewidth=1.6)
        axes[name].add_patch(frame)
    for axis in axes.values():
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=100)
    # A palette is a third of the size.
    Image.open(path).convert("RGB").quantize(160, dither=Image.Dither.NONE).save(path, optimize=True)


def detail(sidecar: Sidecar) -> NDArray[np.uint8]:
    """(height, width, 3) of the enlarged part in false colours; grey where one of the bands has no data."""
    x0, y0 = sidecar.content["output"]["crop"][:2]
    left, top, width, height = _DETAIL
    part = slice(top - y0, top - y0 + height), slice(left - x0, left - x0 + width)
    bands = [band(sidecar, name) for name in COMPOSITE]
    image = np.stack([stretched(b) for b in bands], axis=-1)[part]
    missing = np.any([np.isnan(b) for b in bands], axis=0)[part]
    image[missing] = _HIDDEN
    return np.asarray(cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST))


def band(sidecar: Sidecar, name: str) -> NDArray[np.float32]:
    """(height, width) of a band of the stack, nan where it has no data."""
    place = next(b["place"] for b in sidecar.content["bands"] if b["band"] == name)
    with without_warnings(), rasterio.open(sidecar.path.parent / place["file"]) as dataset:
        pixels = dataset.read(place["band_index"], masked=True)
    return np.asarray(pixels.astype(np.float32).filled(np.nan))


def stretched(pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    low, high = np.nanpercentile(pixels, (1, 99))
    return np.asarray(np.nan_to_num((pixels - low) / (high - low)).clip(0, 1) * 255, np.uint8)


if __name__ == "__main__":
    run(main)
