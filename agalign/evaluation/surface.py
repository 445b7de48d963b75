"""The training loss over known misalignments (Dong et al. 2018, Fig. 2): its minimum is at the alignment."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.config import JointSettings
from agalign.errors import NoContrastError, NotEnoughTextureError
from agalign.method.device import one_memory_error, one_thread
from agalign.method.levels import make_level
from agalign.method.paper import Training, descend
from agalign.method.state import JointState, MovingImage
from agalign.rasters.drawing import with_text, write_png
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

_LONGEST_SIDE_PX = 512
"""Larger images are reduced to this: each point of a surface is the training of a network."""


def loss_surface(
    fixed: Raster,
    moving: Raster,
    truth: Matrix,
    offsets_px: NDArray[np.float64],
    settings: JointSettings,
    training: Training,
    progress: Callable[[float], None] = lambda _: None,
) -> NDArray[np.float64]:
    """Return the mean loss per keypoint after training with psi fixed at the truth shifted by each (x, y): (n, n).

    Rows are along y; nan if too few keypoints remain. Each network is trained from the same random weights by recipe
    paper, on images reduced to _LONGEST_SIDE_PX. Offsets are px of the full resolution.
    """
    scale = min(1.0, _LONGEST_SIDE_PX / max(fixed.size_px))
    result = np.full((len(offsets_px), len(offsets_px)), np.nan)
    for row, dy in enumerate(offsets_px):
        for column, dx in enumerate(offsets_px):
            start = geometry.compose(truth, geometry.translation(float(dx), float(dy)))
            state = JointState(settings, lambda *_: None)
            with suppress(NotEnoughTextureError, NoContrastError), one_thread(), one_memory_error():
                level = make_level(state, fixed, [MovingImage(moving, start)], scale)
                net = state.random_descriptor([fixed.channels, moving.channels])
                _, loss, _ = descend(state, net, level, level.trainable, training, update_psi=False)
                result[row, column] = loss
        progress((row + 1) / len(offsets_px))
    return result


def draw_surface(surface: NDArray[np.float64], offsets_px: NDArray[np.float64], path: Path) -> None:
    """Write a picture of a loss surface (n, n) over offsets (n,), dark where the loss is low. Raises OutputError."""
    side, margin = 440, 56
    low, high = np.nanmin(surface), np.nanmax(surface)
    shade = np.nan_to_num((surface - low) / max(high - low, 1e-12), nan=1.0) * 255
    field = cv2.resize(shade.astype(np.uint8), (side, side), interpolation=cv2.INTER_CUBIC)
    sheet = np.full((side + 2 * margin, side + 2 * margin, 3), 255, np.uint8)
    sheet[margin : margin + side, margin : margin + side] = cv2.applyColorMap(field, cv2.COLORMAP_VIRIDIS)
    sheet = np.ascontiguousarray(sheet[..., ::-1])

    def write(text: str, x: int, y: int) -> None:
        sheet[:] = with_text(sheet, text, (x, y), anchor="ms")

    half = side / (2 * len(offsets_px))
    for k in np.linspace(0, len(offsets_px) - 1, 5).round().astype(int):
        at = margin + round(half + k * (side - 2 * half) / (len(offsets_px) - 1))
        write(f"{offsets_px[k]:g}", at, margin + side + 18)
        write(f"{offsets_px[k]:g}", margin // 2, at + 4)
    write("offset along x, px", margin + side // 2, margin + side + 42)
    write(f"loss per keypoint, {low:.3f} (dark) to {high:.3f}; offset along y at the left", margin + side // 2, 32)
    write_png(sheet, path)
