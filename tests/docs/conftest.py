"""What a reader of the documents has on his desk."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from synthetic_flights.cameras import ALTUM

from agalign.synthetic import flight as synthetic

from ..cli.test_onto import TRUTH, write_mosaic
from ..conftest import textured_pair


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a reader has before he begins: a flight, and whatever else the documents speak of."""
    folder = tmp_path_factory.mktemp("desk")
    synthetic.make_flight(folder / "flight", captures=3, size_px=(480, 360), rng_seed=3)
    synthetic.make_flight(folder / "altum", captures=3, size_px=(640, 480), rng_seed=4, camera=ALTUM)
    for name, image, off_m in zip(("spring", "summer"), textured_pair(TRUTH, 640, 520), ((0, 0), (3, -4)), strict=True):
        write_mosaic(folder / f"{name}.tif", image, off_m, bands=2)
    (folder / "mosaics").mkdir()
    write_mosaic(folder / "mosaics" / "field.tif", textured_pair(TRUTH, 400, 320)[0], (0, 0), bands=3)
    with rasterio.open(folder / "mosaics" / "field.tif", "r+") as field:
        field.descriptions = ("green", "red", "nir")
    for number, seed in enumerate((1, 2), start=1):
        for side, image in zip("ab", textured_pair(TRUTH, 240, 200, seed), strict=True):
            cv2.imwrite(str(folder / f"{number}{side}.png"), (image * 40 + 128).clip(1, 254).astype(np.uint8))
        np.savetxt(folder / f"{number}.txt", TRUTH)
    (folder / "pairs.csv").write_text("fixed,moving,homography\n1a.png,1b.png,1.txt\n2a.png,2b.png,2.txt\n")
    return folder
