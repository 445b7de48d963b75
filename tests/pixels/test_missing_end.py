"""Files whose end is missing, as a broken transfer leaves them: their pixels are nodata, and others are kept."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio

import agalign
from agalign.pixels.capture_pixels import CapturePixels
from agalign.pixels.masks import missing_end, without_parts
from agalign.pixels.raster import probe, read_for_alignment, read_tile, with_facts_of_pixels
from agalign.rasters.alignment_maps import Quality
from agalign.records.cautions import RunFacts
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values.capture import Capture
from agalign.values.image import Tile

from ..conftest import seeded, write_band, write_capture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
WIDTH, HEIGHT = 96, 80
STRIPS = WIDTH, HEIGHT


def scene(low: int = 4800, high: int = 60000, dtype: str = "uint16") -> np.ndarray:
    return np.random.default_rng(0).integers(low, high, (HEIGHT, WIDTH)).astype(dtype)


def cut(pixels: np.ndarray, pixel: int, value: int = 0) -> np.ndarray:
    """The image with one value from a pixel on, in the order of rows."""
    result = pixels.copy()
    result.ravel()[pixel:] = value
    return result


def cut_tiles(pixels: np.ndarray, tiles: int, rows: int, side: int = 32) -> np.ndarray:
    """The image without its last tiles, and without the last rows of the tile before."""
    result = pixels.copy()
    places = [(y, x) for y in range(0, HEIGHT, side) for x in range(0, WIDTH, side)]
    for y, x in places[len(places) - tiles :]:
        result[y : y + side, x : x + side] = 0
    y, x = places[len(places) - tiles - 1]
    result[y + side - rows : y + side, x : x + side] = 0
    return result


@pytest.mark.parametrize("share", [0.02, 0.4, 0.9])
@pytest.mark.parametrize("value", [0, 255])
def test_rows_of_one_value_at_the_end_are_missing(share: float, value: int) -> None:
    begin = round((1 - share) * WIDTH * HEIGHT)
    pixels = cut(scene(), begin, value)
    parts = missing_end(pixels, STRIPS, 65535.0)
    mask = ~without_parts(np.ones(pixels.shape, bool), parts, Tile(0, 0, WIDTH, HEIGHT))
    np.testing.assert_array_equal(mask.ravel(), np.arange(mask.size) >= begin)


@pytest.mark.parametrize(("tiles", "rows"), [(1, 0), (3, 5), (4, 31)])
def test_the_rest_of_a_tiled_file_is_missing(tiles: int, rows: int) -> None:
    pixels = cut_tiles(scene(), tiles, rows)
    parts = missing_end(pixels, (32, 32), 65535.0)
    np.testing.assert_array_equal(
        ~without_parts(np.ones(pixels.shape, bool), parts, Tile(0, 0, WIDTH, HEIGHT)), pixels == 0
    )


KEPT: dict[str, tuple[np.ndarray, float | None]] = {
    "saturated rows": (cut(scene(), 5000, 65520), 65520.0),
    "a saturated sky of 12 bits": (cut(scene(300, 4000), 5000, 4095), 4095.0),
    "a blank image": (np.zeros((HEIGHT, WIDTH), np.uint16), 65535.0),
    "a dark image of 8 bits": (cut(scene(0, 3, "uint8"), 7000), 255.0),
    "black water below a bright shore": (np.where(np.arange(HEIGHT)[:, None] > 40, 0, scene(0, 9, "uint8")), 255.0),
    "one row": (cut(scene(), WIDTH * HEIGHT - 10), 65535.0),
    "a complete image": (scene(), 65535.0),
}


@pytest.mark.parametrize("name", KEPT)
def test_other_constant_rows_are_kept(name: str) -> None:
    pixels, saturation = KEPT[name]
    assert missing_end(pixels, STRIPS, saturation) == []


def test_a_part_of_a_window_is_masked_in_its_scale() -> None:
    parts = [Tile(0, 60, 96, 20), Tile(40, 59, 56, 1)]
    mask = without_parts(np.ones((20, 24), bool), parts, Tile(0, 0, 96, 80))
    assert (mask[:14].all(), mask[15:].any()) == (True, False)
    inside = without_parts(np.ones((10, 10), bool), parts, Tile(0, 0, 10, 10))
    assert inside.all()


def capture_of(path: Path) -> Capture:
    return Capture("f", Path(), (*probe(path),), 0)


FILLED: dict[str, dict[str, object]] = {
    "a map": {"crs": "EPSG:32631", "transform": rasterio.Affine(1, 0, 500000, 0, -1, 5000000)},
    "a declared nodata value": {"nodata": 1},
}


@pytest.mark.parametrize("name", FILLED)
def test_fill_of_maps_and_declared_nodata_are_not_missing(tmp_path: Path, name: str) -> None:
    write_band(tmp_path / "f.tif", cut(scene(), 4000), **FILLED[name])
    assert with_facts_of_pixels(capture_of(tmp_path / "f.tif"), read_tile).bands[0].missing == ()


def test_fill_of_stacks_and_floats_is_not_missing(tmp_path: Path) -> None:
    write_band(tmp_path / "stack.tif", np.stack([cut(scene(), 4000)] * 3))
    write_band(tmp_path / "float.tif", cut(scene(), 4000).astype(np.float32))
    for name in ("stack", "float"):
        assert not any(b.missing for b in with_facts_of_pixels(capture_of(tmp_path / f"{name}.tif"), read_tile).bands)


def test_missing_pixels_are_invalid_at_every_resolution(tmp_path: Path) -> None:
    write_band(tmp_path / "f.tif", cut(scene(), 48 * WIDTH, 77))
    read = CapturePixels().read
    (band,) = with_facts_of_pixels(capture_of(tmp_path / "f.tif"), read).bands
    assert band.missing_rows == 32
    _, valid = read(band, Tile(0, 40, WIDTH, 40))
    assert (valid[:8].all(), valid[8:].any()) == (True, False)
    for longest_px in (WIDTH, WIDTH // 2):
        image = read_for_alignment(band, longest_px, read)
        assert image.valid.mean() == pytest.approx(0.6, abs=0.02)


LEAVES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rows": lambda p: cut(p, round(0.6 * p.shape[0]) * p.shape[1]),
    "half a row": lambda p: cut(p, round(0.75 * p.size) + 31),
}


@pytest.mark.parametrize("name", LEAVES)
@pytest.mark.parametrize("broken", ["nir", "green"])
def test_missing_rows_are_nodata_in_all_outputs(tmp_path: Path, name: str, broken: str) -> None:
    """Green is the reference, whose pixels are copied."""
    write_capture(tmp_path / "in", "green", "red", "nir")
    path = tmp_path / "in" / f"f_{broken}.tif"
    with rasterio.open(path, "r+") as file:
        pixels = LEAVES[name](file.read(1))
        file.write(pixels, 1)
    lost = pixels == 0
    settings = seeded("identity", qa=True, crop="none")
    (_,) = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    with rasterio.open(tmp_path / "out" / "f.tif") as stack:
        index = [*stack.descriptions].index(broken) + 1
        np.testing.assert_array_equal(stack.read_masks(index) == 0, lost)
    with rasterio.open(tmp_path / "out" / "f.qa.tif") as flags:
        flagged = flags.read(1 + [*flags.descriptions].index(broken)) & Quality.NODATA.value > 0
        np.testing.assert_array_equal(flagged, lost)
    (sidecar,) = map(read_sidecar, find_sidecars(tmp_path / "out"))
    rows = math.ceil(lost.sum() / lost.shape[1])
    assert {b.band: b.missing_rows for b in sidecar.bands if b.missing_rows} == {broken: rows}
    (said,) = [c for c in RunFacts().cautions(sidecar) if c.band == broken and "rows" in c.reason]
    assert said.reason == f"the last {rows} rows of f_{broken}.tif are empty, all of one value: copy it again"
