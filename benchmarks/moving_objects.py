"""Plants objects that move between the bands into real captures, and prints how much of them is flagged as moved.

    python benchmarks/moving_objects.py TARGET SOURCE [--repeats 2]

The first capture of the folder TARGET is aligned alone as it is, and with objects: squares of 40 to 220 px, each
displaced by 2 to 36 px between the reference and the bands, at random places and in random directions, with random
brightness, and with a contrast that may be reversed in a band. Their texture is cut from the aligned bands of the first
capture of SOURCE, which has as many bands, or is noise, equal in all bands. An object counts as found if 70 % of its
pixels, where the reference or the band shows it, are flagged in three of four bands. The displacement field of a
capture without its flight may follow a large object, which is then aligned and not flagged.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from common import cell, print_head, print_row, run
from numpy.typing import NDArray

from agalign.batch.capture_task import quiet
from agalign.cameras.discover import discover
from agalign.capture.align_bands import align_capture_bands
from agalign.config import Settings
from agalign.pixels.raster import ReadTile, read_tile, with_facts_of_pixels
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture
from agalign.values.image import FloatImage, Mask, Tile
from agalign.values.moved_area import moved_px

SIZES_PX, SHIFTS_PX = (40, 60, 100, 220), (2, 4, 9, 36)
MIN_FOUND, MIN_BANDS = 0.7, 0.75
"""Share of the pixels of an object that must be flagged, in this share of the bands."""
MARGIN_PX = 70
"""Between objects, and to the edges of the image."""
ROUNDS_OF_SIZE = {220: 4}
"""Images over which the shifts are distributed, by default 1: with two large objects, a band is `predicted`."""


@dataclass(frozen=True)
class Planted:
    """A square object: its place in the reference, its shift, and its texture by band, mean 0, standard deviation 1."""

    x: int
    y: int
    shift_px: NDArray[np.float64]
    texture: Mapping[str, FloatImage]

    def is_at(self, shape: tuple[int, ...]) -> Mask:
        """Return the pixels of the reference (height, width) where it or the band shows the object."""
        size, result = len(next(iter(self.texture.values()))), np.zeros(shape, bool)
        for dx, dy in (np.zeros(2), self.shift_px):
            x, y = round(self.x + dx), round(self.y + dy)
            result[y : y + size, x : x + size] = True
        return result


@dataclass
class Aligned:
    """A capture, its pixels by band, and its alignments."""

    capture: Capture
    pixels: dict[str, NDArray[np.generic]]
    alignments: dict[str, Alignment]

    @classmethod
    def of(cls, folder: Path) -> "Aligned":
        """Align the first capture of a folder."""
        capture = with_facts_of_pixels(discover(folder).captures[0], read_tile)
        pixels = {b.name: read_tile(b, Tile(0, 0, *b.size_px))[0] for b in capture.bands}
        return cls(capture, pixels, align_capture_bands(capture, Settings(), None, quiet))

    def patch(self, size_px: int, rng: np.random.Generator) -> list[FloatImage]:
        """Cut a square out of the reference and the bands in its place, where all show it."""
        width, height = self.capture.reference.size_px
        while True:
            x, y = (int(rng.integers(MARGIN_PX, n - size_px - MARGIN_PX)) for n in (width, height))
            at = np.s_[y : y + size_px, x : x + size_px]
            cut = [self.pixels[self.capture.reference.name][at].astype(np.float32)]
            for band in self.capture.moving:
                warped, valid = self.alignments[band.name].warp(self.pixels[band.name], interpolation="bilinear")
                cut += [warped[at].astype(np.float32)] if valid[at].all() else []
            if len(cut) == len(self.capture.bands):
                return [(one - one.mean()) / max(float(one.std()), 1e-6) for one in cut]

    def with_objects(self, objects: list[Planted], rng: np.random.Generator) -> ReadTile:
        """Return a reader of the pixels of the capture with objects."""
        planted = {name: pixels.copy() for name, pixels in self.pixels.items()}
        for one in objects:
            for band in self.capture.bands:
                self._plant(one, band, planted[band.name], rng)

        def read(band: Band, tile: Tile) -> tuple[NDArray[np.generic], Mask]:
            _, valid = read_tile(band, tile)
            return planted[band.name][tile.y0 : tile.y0 + tile.height, tile.x0 : tile.x0 + tile.width], valid

        return read

    def _plant(self, one: Planted, band: Band, pixels: NDArray[np.generic], rng: np.random.Generator) -> None:
        texture, is_reference = one.texture[band.name], band is self.capture.reference
        size, shift_px = len(texture), np.zeros(2) if is_reference else one.shift_px
        first_px = np.array([one.x, one.y]) + shift_px
        corners_px = first_px + size * np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        if not is_reference:
            corners_px = self.alignments[band.name].map(corners_px)
        left, top = np.floor(corners_px.min(axis=0)).astype(int) - 2
        right, bottom = np.ceil(corners_px.max(axis=0)).astype(int) + 2
        at_px = np.stack(np.meshgrid(np.arange(left, right), np.arange(top, bottom)), axis=-1).astype(np.float64)
        if not is_reference:
            at_px = self.alignments[band.name].inverse(at_px)
        on_object = (at_px - first_px).astype(np.float32)
        inside = ((on_object >= 0) & (on_object <= size - 1)).all(axis=-1)
        sampled = cv2.remap(texture, on_object, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        area = pixels[top:bottom, left:right]
        ground = area.astype(np.float32)
        contrast = max(float(ground.std()), 0.05 * float(ground.mean())) * rng.choice([-1.0, 1.0])
        values = ground.mean() * rng.uniform(0.8, 1.3) + contrast * sampled
        max_value = (band.saturation_value or float(np.iinfo(pixels.dtype).max)) - 1
        area[inside] = values.clip(1, max_value)[inside].astype(pixels.dtype)


def objects_of(
    target: Aligned, source: Aligned | None, size_px: int, shifts_px: tuple[int, ...], rng: np.random.Generator
) -> list[Planted]:
    """Return an object for each shift, at places without overlap; without a source, their texture is noise."""
    result: list[Planted] = []
    width, height = target.capture.reference.size_px
    reference_first = [target.capture.reference, *target.capture.moving]
    for length_px in shifts_px:
        angle = rng.uniform(0, 2 * np.pi)
        shift_px = np.rint(length_px * np.array([np.cos(angle), np.sin(angle)]))
        shift_px = shift_px if np.hypot(*shift_px) >= length_px else shift_px + np.sign(shift_px)
        if source is None:
            noise = cv2.GaussianBlur(rng.normal(size=(size_px, size_px)).astype(np.float32), (0, 0), 2)
            textures = [noise / noise.std()] * len(reference_first)
        else:
            textures = source.patch(size_px, rng)
        for _ in range(1000):
            x, y = (int(rng.integers(MARGIN_PX, n - size_px - MARGIN_PX)) for n in (width, height))
            if all(max(abs(x - o.x), abs(y - o.y)) > size_px + MARGIN_PX for o in result):
                by_band = {b.name: t for b, t in zip(reference_first, textures, strict=True)}
                result.append(Planted(x, y, shift_px, by_band))
                break
    return result


def flagged(target: Aligned, alignments: Mapping[str, Alignment]) -> Iterator[Mask]:
    """Yield the pixels (height, width) of each moving band in areas that moved."""
    width, height = target.capture.reference.size_px
    for band in target.capture.moving:
        error = alignments[band.name].error
        yield moved_px(() if error is None else error.moved, np.arange(width), np.arange(height)[:, None]) > 0


def main(target: Path, source: Path, repeats: Annotated[int, typer.Option()] = 2) -> None:
    aligned, from_source = Aligned.of(target), Aligned.of(source)
    plain = [float(mask.mean()) for mask in flagged(aligned, aligned.alignments)]
    print(f"{target.name}, as it is: at most {max(plain):.3%} of a band flagged as moved\n")
    print_head("texture", "size, px", "shift, px", "objects", "found", "flagged, median", "elsewhere, per object")
    for texture, size_px in ((t, s) for t in (from_source, None) for s in SIZES_PX):
        found: dict[int, list[bool]] = {shift: [] for shift in SHIFTS_PX}
        shares: dict[int, list[float]] = {shift: [] for shift in SHIFTS_PX}
        elsewhere: list[float] = []
        for repeat in range(repeats * ROUNDS_OF_SIZE.get(size_px, 1)):
            rng = np.random.default_rng((size_px, repeat))
            rounds = ROUNDS_OF_SIZE.get(size_px, 1)
            shifts_px = SHIFTS_PX[repeat % rounds :: rounds]
            objects = objects_of(aligned, texture, size_px, shifts_px, rng)
            read = aligned.with_objects(objects, rng)
            masks = list(flagged(aligned, align_capture_bands(aligned.capture, Settings(), None, quiet, read)))
            truth = [one.is_at(masks[0].shape) for one in objects]
            for length_px, mask in zip(shifts_px, truth, strict=False):
                of_bands = [float(band[mask].mean()) for band in masks]
                found[length_px].append(np.mean(np.array(of_bands) >= MIN_FOUND) >= MIN_BANDS)
                shares[length_px] += of_bands
            union = np.logical_or.reduce(truth)
            elsewhere += [float((band & ~union).sum() / union.sum()) for band in masks]
        for length_px in SHIFTS_PX:
            counts = len(found[length_px]), f"{sum(found[length_px])}"
            kind = "noise" if texture is None else source.name
            print_row(kind, size_px, length_px, *counts, cell(shares[length_px], ".0%"), cell(elsewhere, ".0%"))


if __name__ == "__main__":
    run(main)
