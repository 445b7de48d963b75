"""The pictures of the README: before and after of the demo and of a real capture, and the report in a browser.

    python tools/readme_figures.py [DEMO [ALIGNED]]

DEMO is the output of an earlier `agalign demo`, else one is run. ALIGNED is the output of a run on the row crop
(`DATA/flights/rededge_m_rowcrop`, --ground-elevation 92). Writes demo.jpg, report.jpg and, with ALIGNED, row-crop.jpg
to docs/figures. The report needs playwright and a Chromium.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
WIDTH_PX, SCREEN_PX = 880, (1100, 1150)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        demo = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder)
        if len(sys.argv) == 1:
            subprocess.run([sys.executable, "-m", "agalign", "demo", str(demo), "--captures", "12"], check=True)
        aligned = demo / "aligned"
        save(Image.open(aligned / "0000SET" / "000" / "IMG_0001.png"), "demo.jpg", 78)
        if len(sys.argv) > 2:
            save(Image.open(Path(sys.argv[2]) / "IMG_0009.png"), "row-crop.jpg", 78)
        with sync_playwright() as playwright:
            path = shutil.which("chromium") or shutil.which("google-chrome")
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = browser.new_page(viewport=dict(zip(("width", "height"), SCREEN_PX, strict=True)))
            page.goto((aligned / "index.html").absolute().as_uri() + "#capture=0000SET%2F000%2FIMG_0001")
            page.wait_for_timeout(1000)
            page.screenshot(path=Path(folder) / "report.png")
            browser.close()
        save(Image.open(Path(folder) / "report.png"), "report.jpg", 72)


def save(picture: Image.Image, name: str, quality: int) -> None:
    """Write a picture in the width of the figures."""
    size = WIDTH_PX, round(picture.height * WIDTH_PX / picture.width)
    smaller = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    smaller.save(FIGURES / name, quality=quality, optimize=True)


if __name__ == "__main__":
    main()
