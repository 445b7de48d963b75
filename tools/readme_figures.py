"""Make the pictures of the pages: NDVI of a real capture and a part of it before and after alignment, the capture, one
of the demo, and, in a browser, the report of a demo flight with two damaged files.

    python tools/readme_figures.py [DEMO [FLIGHT ALIGNED]]

DEMO is the output of an earlier `agalign demo`; without it, a demo is run. FLIGHT is the row crop
(`DATA/flights/rededge_m_rowcrop`), ALIGNED the output of `agalign FLIGHT -o ALIGNED --radiometry auto --qa` and
`agalign indices ALIGNED --mask-qa`. Writes demo.jpg, report.jpg and, with FLIGHT, ndvi.jpg and row-crop.jpg to
docs/figures. The report needs playwright and a Chromium; without them report.jpg is not written.
"""

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from PIL import Image

from agalign.cameras.discover import discover
from agalign.pixels.radiometry import calibrated
from agalign.rasters.drawing import with_text
from agalign.records.sidecar_file import read_sidecar
from agalign.spectral_indices.formulas import INDICES, compute
from agalign.values.capture import Band

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
WIDTH_PX, SCREEN_PX = 880, (1000, 900)
CAPTURE = Path("0000SET/000/IMG_0001")
ROW_CROP, PART_PX, ENLARGED = "IMG_0009", (338, 665, 100, 100), 3
"""Capture, the part of its stack (left, top, width, height), and the side of its pixels in the picture."""
FALSE_COLOUR = "NIR", "Red", "Green"
"""Bands that are shown red, green and blue."""
_RAMP = np.array([(140, 81, 10), (223, 194, 125), (245, 245, 220), (120, 190, 90), (0, 90, 50)], float)
"""Colours of NDVI from 0 to 1."""


def main() -> None:
    """Make the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        demo = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder)
        if len(sys.argv) == 1:
            agalign("demo", demo)
        save(Image.open((demo / "aligned" / CAPTURE).with_suffix(".png")), "demo.jpg", 72)
        if len(sys.argv) > 3:
            save(ndvi_before_and_after(Path(sys.argv[2]), Path(sys.argv[3])), "ndvi.jpg", 80)
            save(Image.open(Path(sys.argv[3]) / f"{ROW_CROP}.png"), "row-crop.jpg", 78)
        if importlib.util.find_spec("playwright"):
            flight, damaged = damaged_flight(demo / "flight", Path(folder) / "damaged"), Path(folder) / "with-problems"
            model = next((demo / "aligned" / "models").glob("*.safetensors"))
            options = "--relief", "never", "--radiometry", "auto", "--index", "ndvi", "--error-map"
            agalign("align", flight, "-o", damaged, "--model", model, *options, code=3)
            save(screenshot(damaged, Path(folder) / "report.png"), "report.jpg", 40)


def agalign(*arguments: str | Path, code: int = 0) -> None:
    """Run the program, which must return this exit code."""
    done = subprocess.run([sys.executable, "-m", "agalign", *arguments], check=False)
    if done.returncode != code:
        raise SystemExit(f"agalign {arguments[0]}: exit code {done.returncode} instead of {code}")


def ndvi_before_and_after(flight: Path, aligned: Path) -> Image.Image:
    """Return NDVI of the row crop, and a part of it in false colour and NDVI: above by raw files, below by stack and
    index raster.
    """
    bands = {b.name: b for c in discover(flight).captures if c.name == ROW_CROP for b in c.bands}
    x0, y0, width, height = read_sidecar(aligned / f"{ROW_CROP}.json").output.crop
    before = [reflectance(bands[name])[y0 : y0 + height, x0 : x0 + width] for name in FALSE_COLOUR]
    with rasterio.open(aligned / f"{ROW_CROP}.tif") as stack, rasterio.open(aligned / f"{ROW_CROP}_ndvi.tif") as index:
        after = [stack.read(stack.descriptions.index(name) + 1) for name in FALSE_COLOUR]
        ndvi_after = index.read(1)
    limits = [np.nanpercentile(band, (1, 99)) for band in after]
    rows = [
        row_of_pictures("before", compute(INDICES["ndvi"], before[:2]), false_colour(before, limits)),
        row_of_pictures("after", ndvi_after, false_colour(after, limits)),
    ]
    return Image.fromarray(np.vstack(rows))


def row_of_pictures(when: str, ndvi: NDArray[np.float32], colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return NDVI of a capture, its part in false colour and in NDVI, and the scale of NDVI, side by side."""
    left, top, columns, rows = PART_PX
    part, height_px = np.s_[top : top + rows, left : left + columns], rows * ENLARGED
    scale = height_px / len(ndvi)
    whole = cv2.resize(coloured(ndvi), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    corners = [(round(x * scale), round(y * scale)) for x, y in ((left, top), (left + columns, top + rows))]
    cv2.rectangle(whole, *corners, (0, 0, 0), 3)
    pictures = {f"NDVI {when} alignment": whole, "NIR, red, green": colours[part], "NDVI": coloured(ndvi[part])}
    gap = np.full((height_px + 48, 12, 3), 255, np.uint8)
    sides = []
    for title, picture in pictures.items():
        large = picture if picture is whole else picture.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
        sides += [with_title(large, title), gap]
    return np.hstack([*sides, colour_bar(height_px)])


def false_colour(bands: list[NDArray[np.float32]], limits: list[NDArray[np.float64]]) -> NDArray[np.uint8]:
    """Return three bands as RGB, each from its lower limit (0) to its upper limit (255)."""
    scaled = [(band - low) / (high - low) for band, (low, high) in zip(bands, limits, strict=True)]
    return (np.clip(np.nan_to_num(np.dstack(scaled)), 0, 1) * 255).round().astype(np.uint8)


def with_title(image: NDArray[np.uint8], title: str) -> NDArray[np.uint8]:
    """Return an image below its title."""
    sheet = np.full((image.shape[0] + 48, *image.shape[1:]), 255, np.uint8)
    sheet[48:] = image
    return with_text(sheet, title, (8, 32), 28)


def colour_bar(height_px: int) -> NDArray[np.uint8]:
    """Return the colours of NDVI from 1 (top) to 0 with numbers, beside images of this height with titles."""
    sheet = np.full((height_px + 48, 130, 3), 255, np.uint8)
    sheet[48:, :40] = coloured(np.linspace(1, 0, height_px, dtype=np.float32)[:, None])
    for value in np.linspace(0, 1, 6):
        y = 48 + round((1 - value) * (height_px - 28)) + 24
        sheet = with_text(sheet, f"{value:.1f}", (52, y), 28)
    return sheet


def reflectance(band: Band) -> NDArray[np.float32]:
    """Return the reflectance of a band's raw pixels by the light sensor."""
    with rasterio.open(band.path) as raster:
        return calibrated(raster.read(1), band.radiometry, 0, 0) * band.radiometry.by_sun.value


def coloured(ndvi: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return NDVI from 0 (brown) to 1 (green) as RGB; NaN is grey."""
    stops = np.linspace(0, 1, len(_RAMP))
    result = np.stack([np.interp(np.nan_to_num(ndvi), stops, c) for c in _RAMP.T], axis=-1)
    result[np.isnan(ndvi)] = 160
    return result.round().astype(np.uint8)


def damaged_flight(flight: Path, copy: Path) -> Path:
    """Copy a demo flight: NIR of the second capture becomes noise, and the file of Red of the third is cut off."""
    shutil.copytree(flight, copy)
    second, third = (copy / CAPTURE.with_name(f"IMG_000{number}") for number in (2, 3))
    with tifffile.TiffFile(second.with_name("IMG_0002_4.tif"), mode="r+b") as file:
        page = file.pages[0]
        pixels = page.asarray()
        noise = np.random.default_rng(0).normal(pixels.mean(), pixels.std(), pixels.shape)
        # Raw numbers of this camera are multiples of 16.
        file.filehandle.seek(page.dataoffsets[0])
        file.filehandle.write((noise.clip(0, 65535).astype(pixels.dtype) // 16 * 16).tobytes())
    cut_off = third.with_name("IMG_0003_3.tif")
    cut_off.write_bytes(cut_off.read_bytes()[:60_000])
    return copy


def screenshot(aligned: Path, picture: Path) -> Image.Image:
    """Return a report down to the pictures of the first capture, with NDVI before and after alignment."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page(viewport=dict(zip(("width", "height"), SCREEN_PX, strict=True)))
        page.goto((aligned / "index.html").absolute().as_uri() + f"#capture={str(CAPTURE).replace('/', '%2F')}")
        page.wait_for_timeout(1500)
        page.get_by_label("Overlay", exact=True).select_option("index:ndvi")
        page.wait_for_timeout(1000)
        end = page.locator("input[type=range]").first.bounding_box()
        height = end["y"] + end["height"] + page.evaluate("window.scrollY") + 8
        clip = {"x": 0, "y": 0, "width": SCREEN_PX[0], "height": height}
        page.screenshot(path=picture, full_page=True, clip=clip)
        browser.close()
    return Image.open(picture)


def save(picture: Image.Image, name: str, quality: int) -> None:
    """Write a picture in the width of the figures."""
    size = WIDTH_PX, round(picture.height * WIDTH_PX / picture.width)
    smaller = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    smaller.save(FIGURES / name, quality=quality, optimize=True)


if __name__ == "__main__":
    main()
