"""Attack what the program is given: strange images, rasters that change while they are read, ordinary captures that
must not be left out, and images that are hard to search for panels and relief.

    python benchmarks/reliability/inputs.py [--images 60] [--changes 40] [--captures 500] [--data FOLDER]
        [--figures]

Each file of a strange capture is in a sidecar or in a message. An index is that of an undisturbed run, or a message
names its capture. The captures of `--data` are cropped,
darkened and turned, in a folder named after the sky: none is one of the sky or of a panel. A search hangs that takes
over three times the CPU time of a texture of the same size.
"""

import os
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import command, ended, read_band, run, table, timed
from figures_csv import FiguresOption, TableRow, write_figures
from kills import HUNG_S, contents
from synthetic_flights.aligned import make_aligned

from agalign.cameras.discover import discover
from agalign.fit.dense import DenseMatching, View
from agalign.flight.panel_readings import with_panels
from agalign.flight.sky import sky_captures
from agalign.pixels.panel_detection import find_panel
from agalign.records.sidecar_file import find_sidecars
from agalign.values.capture import Capture
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

Image = NDArray[np.generic]
Writer = Callable[[Path, Image], object]


FAULTS = "tracebacks", "silent losses", "hangs"
ROWS = {
    "images": "images of unusual formats and sizes",
    "rasters that change": "rasters that change while indices are computed",
    "ordinary captures": "ordinary captures mistaken for panel or sky",
    "search for a panel": "images that are slow to search for a panel",
    "relief": "images that are slow to search for parallax",
}
"""Names of the attacks in docs/figures/figures.csv."""


@dataclass
class Attack:
    """A row of the table."""

    name: str
    unit: str
    tried: int = 0
    worst_s: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)

    def count(self, kind: str, what: object) -> None:
        self.faults[kind] += 1
        print(f"{self.name}: {kind}: {what}", flush=True)

    def program(self, argv: list[str], disturb: Callable[[object], object] = lambda _: None) -> str:
        """Run the command line, disturbed by a function, and return standard error."""
        ending = ended(argv, HUNG_S, disturb)
        self.worst_s = max(self.worst_s, ending.seconds)
        if ending.code is None:
            self.count("hangs", argv)
        of_libraries = [line for line in ending.errors.splitlines() if not line.startswith(("agalign: ", "{"))]
        if ending.code not in (None, 0, 1, 3) or ending.has_traceback or of_libraries:
            self.count("tracebacks", of_libraries or ending.errors)
        return ending.errors


# ---- images


def texture(rng: np.random.Generator, size_px: tuple[int, int]) -> Image:
    """Values from 0 to 1."""
    noise = cv2.GaussianBlur(rng.random(size_px[::-1], np.float32), (0, 0), 2)
    return cv2.normalize(noise, None, 0, 1, cv2.NORM_MINMAX)


def tiff(dtype: str, top: float, bits: int | None = None) -> Writer:
    def write(path: Path, image: Image) -> None:
        planes = np.atleast_3d(image).transpose(2, 0, 1)
        count, height, width = planes.shape
        profile = {"width": width, "height": height, "count": count, "dtype": dtype, "driver": "GTiff", "nbits": bits}
        with rasterio.open(path, "w", **{k: v for k, v in profile.items() if v}) as dataset:
            dataset.write((planes * top).astype(dtype.replace("complex_int16", "complex64")))

    return write


def tagged(**options: object) -> Writer:
    return lambda path, image: tifffile.imwrite(path, (image * 250).astype(np.uint8), **options)


def encoded(suffix: str, dtype: type, options: tuple[int, ...] = (), keep: float = 1.0) -> Writer:
    """A writer of a file that ends after this share of its bytes."""

    def write(path: Path, image: Image) -> None:
        data = cv2.imencode(suffix, (image * np.iinfo(dtype).max).astype(dtype), options)[1].tobytes()
        path.with_suffix(suffix).write_bytes(data[: int(keep * len(data))])

    return write


USUAL = tiff("uint16", 60000)
WRITERS = {f"{n} bits": tiff(f"uint{max(8, 1 << (n - 1).bit_length())}", 2**n - 1, n) for n in (1, 2, 4, 7, 12, 24, 32)}
WRITERS |= {f"{d} to {top:g}": tiff(d, top) for d, top in (("uint64", 2.0**63), ("int8", 127), ("float64", 1e308))}
WRITERS |= {"half float": tiff("float32", 1, 16), **{d: tiff(d, 999) for d in ("complex64", "complex_int16", "int16")}}
WRITERS |= {f"orientation {n}": tagged(extratags=[(274, 3, 1, n, True)]) for n in (3, 6, 8, 99)}
WRITERS["palette"] = tagged(photometric="palette", colormap=np.arange(768, dtype=np.uint16).reshape(3, 256))
PROGRESSIVE = cv2.IMWRITE_JPEG_PROGRESSIVE, 1
FORMATS = (".png", np.uint16, ()), (".jp2", np.uint16, ()), (".jpg", np.uint8, ()), (".jpg", np.uint8, PROGRESSIVE)
for keep in (1.0, 0.95, 0.5, 0.02):
    WRITERS |= {f"{keep:.0%} of {f[0]} {f[2]}": encoded(*f, keep) for f in (*FORMATS, (".tif", np.uint16, ()))}
SIZES_PX = (1, 1), (1, 5000), (5000, 1), (2, 2), (16, 16), (33, 700), (7300, 5480)


def write_strange(folder: Path, number: int, rng: np.random.Generator) -> None:
    """Write a capture: bands in a strange format, one of them or all, or one of a strange size, or one file."""
    write, image = list(WRITERS.values())[number % len(WRITERS)], texture(rng, (320, 240))
    if number % 9 == 8:
        USUAL(folder / f"c{number}.tif", np.dstack([image] * (30 if number % 2 else 1)))
        return
    for band in ("green", "red", "nir"):
        size_px = SIZES_PX[rng.integers(len(SIZES_PX))] if band == "red" and number % 4 == 3 else (320, 240)
        one = write if band == "nir" or number % 2 else USUAL
        one(folder / f"c{number}_{band}.tif", np.resize(image, size_px[::-1]))


def attack_images(count: int, rng: np.random.Generator, folder: Path) -> Iterator[Attack]:
    result, model = Attack("images", "images", count), []
    for first in range(-9, count, 9):
        flight, out = folder / f"flight{first}", folder / f"out{first}"
        flight.mkdir()
        for number in range(max(first, 0), min(first + 9, count)):
            write_strange(flight, number, rng)
        for band in ("green", "red", "nir"):
            USUAL(flight / f"usual_{band}.tif", texture(np.random.default_rng(0), (320, 240)))
        errors = result.program(command(flight, out, "--log-json", "-j", "1", "--qa", "--relief", "never", *model))
        model = model or ["--model", str(next((out / "models").iterdir()))]
        known = errors + "".join(p.read_text() for p in find_sidecars(out))
        failed = re.findall(r'"capture": "(\w+)", "state": "error"', errors)
        for path in flight.iterdir():
            if path.name not in known and path.name.split("_")[0] not in failed:
                kind = list(WRITERS)[int(re.findall(r"\d+", path.name)[0]) % len(WRITERS)]
                result.count("silent losses", f"{path.name}: {kind}")
    yield result


# ---- rasters that change


def attack_rasters(count: int, rng: np.random.Generator, folder: Path) -> Iterator[Attack]:
    """Change a third of the stacks at random times of `agalign indices`."""
    result, captures = Attack("rasters that change", "rasters"), 12
    aligned, out, expected = folder / "aligned", folder / "indices", {}
    make_aligned(aligned, captures, (1600, 1200))
    while result.tried < count:
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(aligned, out)
        stacks = rng.choice(sorted(out.rglob("IMG_????.tif")), captures // 3 if expected else 0, replace=False)

        def change(_: object, stacks: Iterable[Path] = stacks) -> None:
            for path in stacks:
                time.sleep(rng.uniform(0, 6 * result.worst_s / captures))
                if rng.random() < 0.5:
                    os.truncate(path, rng.integers(path.stat().st_size))
                else:
                    path.unlink()

        argv = [sys.executable, "-m", "agalign", "indices", str(out), "--log-json", "-j", "1"]
        errors = result.program(argv, change)
        written = {path.name: contents(path) for path in out.rglob("*_ndvi.tif")}
        expected = expected or written
        result.tried += len(stacks)
        for name in expected:
            is_reported = name not in written and name.removesuffix("_ndvi.tif") in errors
            if not is_reported and written.get(name) != expected[name]:
                result.count("silent losses", name)
    yield result


# ---- exclusions


def derived(capture: Capture, folder: Path, rng: np.random.Generator) -> Capture:
    """Return a capture cropped, darkened and turned alike in all bands, with its tags."""
    side, gain, turns = rng.uniform(0.3, 1.0), rng.uniform(0.03, 1.0), int(rng.integers(4))
    at, bands = rng.uniform(0, 1 - side, 2), []
    for number, band in enumerate(capture.bands):
        pixels = read_band(band.path, band.band_index)
        (y, x), (height, width) = ((v * pixels.shape).astype(int) for v in (at, np.array((side, side))))
        black = 0.0 if band.radiometry is None else band.radiometry.black_level
        dark = np.rot90(black + (pixels[y : y + height, x : x + width].clip(black) - black) * gain, turns)
        path, (height, width) = folder / f"{number}.tif", dark.shape
        tifffile.imwrite(path, dark.astype(pixels.dtype))
        bands.append(replace(band, path=path, band_index=1, width_px=width, height_px=height, panel=None, overviews=()))
    return replace(capture, folder=Path("Big Sky Farm"), bands=tuple(bands))


def exclusion(capture: Capture) -> str:
    sky, others = sky_captures([capture])
    panels = any(c.is_of_a_panel for c in with_panels(others, without_code=True))
    return "sky" if sky else "panel" if panels else ""


def attack_exclusions(count: int, rng: np.random.Generator, folder: Path, data: Path) -> Iterator[Attack]:
    """Derive captures from those of the data that are neither of the sky nor of a panel."""
    result = Attack("ordinary captures", "captures", count)
    found = [c for part in ("captures", "flights") for c in discover(data / part).captures]
    ordinary = [c for c in with_panels(sky_captures(found)[1]) if c.panel is None]
    for number in range(count):
        capture = derived(ordinary[number % len(ordinary)], folder, rng)
        seconds, excluded = timed(exclusion, capture)
        result.worst_s = max(result.worst_s, seconds)
        if excluded:
            result.count("silent losses", f"{capture.name} as {excluded}")
    yield result


# ---- searches


def hostile(size_px: tuple[int, int], rng: np.random.Generator) -> dict[str, Image]:
    """Images (height, width) that may be harder to search than a field, after two textures."""
    width, height = size_px
    mark, squares = np.pad(np.pad(np.ones((5, 5)), 1, constant_values=0), 1), np.pad(np.ones((100, 100)), 10)
    mark[3:6, 3:6] = 0
    tiles = {f"checks of {n} px": np.kron(np.eye(2), np.ones((n, n))) for n in (1, 2, 8)} | {"squares": squares}
    tiles |= {f"marks of {9 * n} px": np.kron(mark, np.ones((n, n))) for n in (1, 2, 4, 12)}
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    images = {f"texture {k}": texture(rng, size_px) for k in range(2)} | {"noise": rng.random((height, width))}
    images |= {k: np.tile(t, (height // len(t) + 1, width // len(t) + 1))[:height, :width] for k, t in tiles.items()}
    images |= {"nested squares": np.maximum(abs(x), abs(y)) * 100 % 2 // 1, "rings": np.hypot(x, y) * 100 % 2 // 1}
    return images | {"ramp": x + y, "black": 0 * x, "rows": np.sin(x * 300), "infinite": np.where(x > 0, np.inf, 1)}


def relief(image: Raster) -> object:
    moved = Raster(np.roll(image.pixels, 3, axis=1), image.valid, None)
    views = [View(moved, PixelMapping(np.eye(3)), direction) for direction in ((1.0, 0.0), (0.0, 1.0))]
    return DenseMatching(image, views, (-4.0, 4.0)).matched(range(2))


def cpu_seconds(function: Callable[[Raster], object], image: Raster) -> float:
    """Return the CPU time of a call, to which other programs add nothing."""
    began_s = time.process_time()
    function(image)
    return time.process_time() - began_s


def attack_searches(rng: np.random.Generator) -> Iterator[Attack]:
    for name, function in (("search for a panel", lambda i: find_panel(i, without_code=True)), ("relief", relief)):
        images = {k: np.asarray(pixels, np.float32) for k, pixels in hostile((1600, 1200), rng).items()}
        seconds = {k: cpu_seconds(function, Raster(i, np.isfinite(i), None)) for k, i in images.items()}
        result, normal_s = Attack(name, "images", len(images), worst_s=max(seconds.values())), seconds["texture 1"]
        for kind, s in seconds.items():
            if s > 3 * normal_s:
                result.count("hangs", f"{kind}: {s:.2f} s, {s / normal_s:.1f} times as long as a texture")
        yield result


def main(
    images: int = 60,
    changes: int = 40,
    captures: int = 500,
    data: Path | None = None,
    *,
    figures: FiguresOption = False,
) -> None:
    rng = np.random.default_rng(0)
    warnings.simplefilter("ignore")
    head = "attack", "tried", *FAULTS, "worst, s"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        attacks = [attack_searches(rng), attack_rasters(changes, rng, folder), attack_images(images, rng, folder)]
        if data:
            attacks.append(attack_exclusions(captures, rng, folder, data))
        done = list(chain(*attacks))
    print(table([head, *((a.name, a.tried, *(a.faults[kind] for kind in FAULTS), f"{a.worst_s:.2f}") for a in done)]))
    if figures:
        rows = [
            TableRow("reliability", ROWS[a.name], f"{a.tried} {a.unit}", {"failures": a.faults.total()}) for a in done
        ]
        write_figures(rows, "DATA", [data] if data else [])


if __name__ == "__main__":
    run(main)
