"""The figures in docs/explanation/ that are made of synthetic images: matches, loss surface, relief.

    python benchmarks/figures.py [FOLDER]

Writes matches.jpg, loss-surface.png and relief.png to FOLDER, by default docs/figures.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from common import align, flight_and_out, layer, only_sidecar, pyplot, read_ties, run, window_of
from numpy.typing import NDArray
from synthetic_flights.depth import write_capture
from synthetic_flights.relief import make_scene

from agalign.config import JointSettings
from agalign.evaluation.evaluate import method_named
from agalign.evaluation.image_pairs import read_image
from agalign.evaluation.surface import draw_surface, loss_surface
from agalign.method.match import sift_keypoints, to_8_bit, visible_in_both
from agalign.method.paper import Training
from agalign.pixels.band_resampling import eight_bit
from agalign.rasters.drawing import with_text
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster

SIZE_PX = (800, 600)
DRAWN = 60
GREEN, RED = (80, 200, 60), (60, 60, 230)
SCENE, SCENE_SIZE_PX = 1001, (960, 720)
"""Boxes on a bench and on the floor next to it, 0.95 to 1.75 m away."""
DETAIL = np.s_[115:225, 205:381]
"""Enlarged part of the scene, px of the reference: the upper corner of a box, and the bench's edge."""
NO_DATA = 90
"""Grey level of pixels that a band does not show."""


def straight_pair(folder: Path) -> tuple[Raster, Raster, Matrix]:
    """Return green and near infrared of one synthetic capture without lens distortion, and the true homography."""
    straight = replace(cameras.REDEDGE, bands=tuple(replace(b, distortion=(0.0,) * 5) for b in cameras.BANDS))
    truth = read_ties(synthetic.make_flight(folder, 1, SIZE_PX, rng_seed=11, camera=straight))
    fixed, moving = (read_image(folder / "0000SET" / "000" / f"IMG_0001_{index}.tif") for index in (2, 4))
    return fixed, moving, np.array(truth["IMG_0001_4.tif"]["fixed_to_moving"])


def matches(fixed: Raster, moving: Raster, truth: Matrix) -> NDArray[np.uint8]:
    """Return a picture of the nearest neighbours of some keypoints by a descriptor; correct ones are green."""
    rng = np.random.default_rng(0)
    start = geometry.compose(truth, geometry.translation(0.04 * SIZE_PX[0], 0.03 * SIZE_PX[0]))
    keypoints = visible_in_both(sift_keypoints(fixed), truth, fixed, moving)
    drawn = rng.choice(len(keypoints), DRAWN, replace=False)
    rows = []
    for name, title in (("fast:pseudo-siamese", "learned on this pair"), ("sift", "SIFT")):
        describe, _ = method_named(name).apply(fixed, moving, start)
        assert describe is not None
        f, f_prime = describe(keypoints, truth)
        nearest = ((f[:, None] - f_prime[None]) ** 2).sum(-1).argmin(1).numpy()
        right = nearest == np.arange(len(keypoints))
        xy = keypoints.xy.numpy().astype(np.float64)
        here, there = xy[drawn], geometry.apply(truth, xy[nearest[drawn]])
        text = f"{title}: {right.mean():.0%} of {len(right)} keypoints find their own patch"
        strip = with_text(np.full((34, 2 * SIZE_PX[0], 3), 255, np.uint8), text, (6, 24), 20)
        rows += [strip, draw_matches(fixed, moving, here, there, right[drawn])]
    return np.vstack(rows)


def draw_matches(fixed: Raster, moving: Raster, here: Points, there: Points, right: NDArray) -> NDArray[np.uint8]:
    """Return both images next to each other, with lines between corresponding rows of `here` and `there`, (N, 2)."""
    sheet = np.hstack([cv2.cvtColor(to_8_bit(r), cv2.COLOR_GRAY2BGR) for r in (fixed, moving)])
    ends = np.stack([here, np.add(there, (fixed.size_px[0], 0.0))], axis=1).round().astype(int)
    for line, colour in zip(ends.tolist(), np.where(right[:, None], GREEN, RED).tolist(), strict=True):
        cv2.line(sheet, *line, colour, 1, cv2.LINE_AA)
        for end in line:
            cv2.circle(sheet, end, 4, colour, 1, cv2.LINE_AA)
    return sheet


def relief(path: Path) -> None:
    """Draw a scene with depth: reference band, parallax, and three bands by homographies and by the relief."""
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
    figure.colorbar(shown, ax=axes["relief"], fraction=0.05, pad=0.02, label="far → near")
    titles = "reference band", "relief: parallax, px", "homographies", "with the relief"
    for axis, title in zip(axes.values(), titles, strict=True):
        axis.set(xticks=[], yticks=[], title=title)
    rows, columns = DETAIL
    corner, size = (columns.start, rows.start), (columns.stop - columns.start, rows.stop - rows.start)
    for name in ("reference", "relief"):
        axes[name].add_patch(plt.Rectangle(corner, *size, fill=False, edgecolor="#ff4d4d", linewidth=1.6))
    figure.savefig(path, dpi=100)


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


def main(out: Annotated[Path, typer.Argument()] = Path("docs/figures")) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        fixed, moving, truth = straight_pair(folder)
        drawn = cv2.resize(matches(fixed, moving, truth), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(out / "matches.jpg"), drawn, [cv2.IMWRITE_JPEG_QUALITY, 40])
        offsets = np.linspace(-100, 100, 17)
        settings = JointSettings(recipe="paper")
        surface = loss_surface(fixed, moving, truth, offsets, settings, Training(epochs=2))
        draw_surface(surface, offsets, out / "loss-surface.png")
    relief(out / "relief.png")


if __name__ == "__main__":
    run(main)
