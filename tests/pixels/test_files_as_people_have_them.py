"""Full scale, channels and colours of files by other software and of cameras that state little."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from rasterio.enums import ColorInterp

import agalign
from agalign.cameras.discover import discover
from agalign.cameras.generic import Generic
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import NAMESPACE
from agalign.errors import UnreadableFileError
from agalign.pixels.raster import probe, with_saturation_values
from agalign.products.sidecar_file import find_sidecars, read_result
from agalign.values.capture import Band, Capture
from agalign.values.quality import Quality

from ..conftest import textured_image, write_band, write_capture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def texture_numbers(bright: float = 0.0, seed: int = 0) -> np.ndarray:
    return (1600 + 400 * (textured_image(320, 240, seed) + bright)).clip(1, 60000).astype(np.uint16)


def saturation_of(path: Path, pixels: np.ndarray, **profile: object) -> float | None:
    write_band(path, pixels, **profile)
    capture = Capture("a", Path(), probe(path), 0)
    return with_saturation_values(capture).bands[0].saturation_value


@pytest.mark.parametrize(("bits", "shift"), [(10, 0), (12, 0), (12, 4), (14, 2)])
def test_saturated_pixels_show_the_full_scale_of_the_sensor(tmp_path: Path, bits: int, shift: int) -> None:
    full = 2**bits - 1
    light = texture_numbers(4.0) * (full / 4095)
    clipped = np.minimum(light, full).astype(np.uint16)
    assert 0.005 < (clipped == full).mean() < 0.5
    assert saturation_of(tmp_path / "a.tif", clipped << shift) == full << shift


def test_bright_objects_and_constant_images_show_no_saturation(tmp_path: Path) -> None:
    bright = texture_numbers()
    bright[:60, :80] = np.random.default_rng(0).integers(8000, 9000, (60, 80))
    for pixels in (texture_numbers(), bright, np.full((240, 320), 4095, np.uint16)):
        assert saturation_of(tmp_path / "a.tif", pixels) == 65535


def test_declared_bits_are_the_full_scale(tmp_path: Path) -> None:
    assert saturation_of(tmp_path / "a.tif", texture_numbers(), nbits=12) == 4095


def test_masks_flags_and_totals_have_the_same_saturated_pixels(tmp_path: Path) -> None:
    write_capture(tmp_path / "in", "green", "red")
    with rasterio.open(tmp_path / "in" / "f_green.tif", "r+") as green:
        pixels = green.read(1)
        limit = int(np.quantile(pixels, 0.9))
        green.write(np.minimum(pixels, limit), 1)
    settings = agalign.Settings(write=agalign.WriteSettings(qa=True), seed=agalign.SeedSettings(force="identity"))
    list(agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings))
    (sidecar,) = find_sidecars(tmp_path / "out")
    shares = {b.band: b.saturated for b in read_result(sidecar).bands}
    assert shares["green"] == pytest.approx(0.1, abs=0.02)
    assert shares["red"] == 0
    with rasterio.open(tmp_path / "out" / "f.qa.tif") as flags:
        assert max((flags.read(k) & Quality.SATURATED > 0).mean() for k in flags.indexes) == pytest.approx(
            0.1, abs=0.03
        )


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_equal_channels_are_one_band(tmp_path: Path, dtype: str) -> None:
    for seed, name in enumerate(("green", "red")):
        grey = (texture_numbers(seed=seed) // (16 if dtype == "uint8" else 1)).astype(dtype)
        tifffile.imwrite(tmp_path / f"field_{name}.tif", np.stack([grey] * 3, axis=-1), photometric="rgb")
    (capture,) = discover(tmp_path).captures
    assert [b.name for b in capture.bands] == ["green", "red"]


def test_channels_that_differ_anywhere_are_kept(tmp_path: Path) -> None:
    grey = texture_numbers()
    tifffile.imwrite(tmp_path / "a.tif", np.stack([grey, grey, grey + 1], axis=-1), photometric="rgb")
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((240, 320, 3), np.uint16), photometric="rgb")
    assert [len(probe(tmp_path / name)) for name in ("a.tif", "b.tif")] == [3, 3]


def test_colours_without_names_are_named_by_their_interpretation(tmp_path: Path) -> None:
    planes = np.stack([texture_numbers(seed=k) for k in range(4)])
    planes[3] = 65535
    write_band(tmp_path / "ortho.tif", planes)
    with rasterio.open(tmp_path / "ortho.tif", "r+") as file:
        file.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    assert [b.name for b in probe(tmp_path / "ortho.tif")] == ["Red", "Green", "Blue"]
    with rasterio.open(tmp_path / "ortho.tif", "r+") as file:
        file.descriptions = ("a", "b", "c", "")
    assert [b.name for b in probe(tmp_path / "ortho.tif")] == ["a", "b", "c"]


def test_an_inverted_image_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", texture_numbers(), photometric="miniswhite")
    with pytest.raises(UnreadableFileError, match=r"a\.tif: is stored inverted .* export it with 0 as black"):
        probe(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("names", "wavelengths", "expected"),
    [
        (("Green", "Red", "NIR"), ("560", "668", "840"), [("Green", 560), ("Red", 668), ("NIR", 840)]),
        (("Green",), ("560",), [("band_1", None), ("band_2", None), ("band_3", None)]),  # unknown channel
        (("Green", "Red"), ("560", "668"), [("band_1", None), ("band_2", None), ("band_3", None)]),
    ],
)
def test_lists_in_tags_have_an_item_for_each_channel(
    names: tuple[str, ...], wavelengths: tuple[str, ...], expected: list[tuple[str, float | None]]
) -> None:
    stored = [Band("", Path("a.tif"), k, 64, 48, "uint16") for k in (1, 2, 3)]
    tags = Tags(xmp={(NAMESPACE, "BandName"): names, (NAMESPACE, "CentralWavelength"): wavelengths})
    assert [(b.name, b.wavelength_nm) for b in Generic().bands(Path("a.tif"), tags, stored)] == expected
