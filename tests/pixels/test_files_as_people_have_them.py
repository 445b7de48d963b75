"""Full scale, channels and colours of files by other software and of cameras that state little."""

from collections.abc import Sequence
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
from agalign.pixels.raster import probe, read_for_alignment, read_tile, with_facts_of_pixels
from agalign.records.sidecar_file import find_sidecars, read_checked
from agalign.values.capture import Band, Capture
from agalign.values.choices import Quality
from agalign.values.image import Tile

from ..cameras.test_vendors import packet, tagged
from ..conftest import textured_image, write_band, write_capture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def texture_numbers(bright: float = 0.0, seed: int = 0) -> np.ndarray:
    return (1600 + 400 * (textured_image(320, 240, seed) + bright)).clip(1, 60000).astype(np.uint16)


def saturation_of(path: Path, pixels: np.ndarray, **profile: object) -> float | None:
    write_band(path, pixels, **profile)
    capture = Capture("a", Path(), probe(path), 0)
    return with_facts_of_pixels(capture, read_tile).bands[0].saturation_value


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
    shares = {b.band: b.saturated for b in read_checked(sidecar).without_tables().bands}
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


def generic_bands(path: Path, tags: Tags | None = None) -> Sequence[Band]:
    return Generic().bands(path, tags or Tags(), probe(path))


def test_colours_without_names_are_named_by_their_interpretation(tmp_path: Path) -> None:
    planes = np.stack([texture_numbers(seed=k) for k in range(4)])
    planes[3] = 65535
    write_band(tmp_path / "ortho.tif", planes)
    with rasterio.open(tmp_path / "ortho.tif", "r+") as file:
        file.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    assert [b.name for b in generic_bands(tmp_path / "ortho.tif")] == ["Red", "Green", "Blue"]
    listed = Tags(xmp={(NAMESPACE, "BandName"): ("Green", "Red", "NIR")})
    assert [b.name for b in generic_bands(tmp_path / "ortho.tif", listed)] == ["Green", "Red", "NIR"]
    with rasterio.open(tmp_path / "ortho.tif", "r+") as file:
        file.descriptions = ("a", "b", "c", "")
    assert [b.name for b in generic_bands(tmp_path / "ortho.tif")] == ["a", "b", "c"]


def write_pages(path: Path, bands: Sequence[tuple[str, int]], *, thumbnail: bool = False, mask: bool = False) -> None:
    """A page for each band, of one scene; a thumbnail is before them, a mask behind."""
    scene = texture_numbers()
    with tifffile.TiffWriter(path) as tiff:
        if thumbnail:
            tiff.write(scene[::4, ::4], subfiletype=1, metadata=None)
        for number, (name, nm) in enumerate(bands):
            xmp = packet(tagged(NAMESPACE, BandName=name, CentralWavelength=str(nm)), "attributes")
            tags = [(700, 1, len(xmp), xmp, True)] if name else []
            tiff.write(np.roll(scene, number, axis=1) + number, metadata=None, extratags=tags)
        if mask:
            tiff.write(scene > 0, subfiletype=4, metadata=None)


@pytest.mark.parametrize(("thumbnail", "mask"), [(False, False), (True, True)])
def test_pages_with_tags_of_their_own_are_bands(tmp_path: Path, thumbnail: bool, mask: bool) -> None:
    bands = {"Green": 560, "Red": 668, "NIR": 840}
    (tmp_path / "in").mkdir()
    write_pages(tmp_path / "in" / "a.tif", [*bands.items()], thumbnail=thumbnail, mask=mask)
    (capture,) = discover(tmp_path / "in").captures
    assert {b.name: b.wavelength_nm for b in capture.bands} == bands
    assert len({b.band_index for b in capture.bands}) == 3
    settings = agalign.Settings(
        write=agalign.WriteSettings(layout="both", crop="none"), seed=agalign.SeedSettings(only=True, force="identity")
    )
    list(agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings))
    with rasterio.open(tmp_path / "out" / "a.tif") as stack:
        for number, name in enumerate(bands):
            expected = np.roll(texture_numbers(), number, axis=1) + number
            np.testing.assert_array_equal(stack.read(stack.descriptions.index(name) + 1), expected)
    for name in bands:
        assert probe(tmp_path / "out" / f"a_{name}.tif")[0].name == name


def test_an_image_behind_its_thumbnail_is_read(tmp_path: Path) -> None:
    write_pages(tmp_path / "f_green.tif", [("", 0)], thumbnail=True)
    write_pages(tmp_path / "f_red.tif", [("", 0)], mask=True)
    (capture,) = discover(tmp_path).captures
    assert {b.name: b.size_px for b in capture.bands} == {"green": (320, 240), "red": (320, 240)}


def test_pages_without_names_are_refused(tmp_path: Path) -> None:
    write_pages(tmp_path / "a.tif", [("", 0), ("", 0)])
    write_capture(tmp_path, "green", "red")
    (problem,) = discover(tmp_path).problems
    assert "a.tif: has 2 pages of one size without names of bands; write each page to a file of its own" in problem.text


def test_an_inverted_image_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", texture_numbers(), photometric="miniswhite")
    with pytest.raises(UnreadableFileError, match=r"a\.tif: is stored inverted .* export it with 0 as black"):
        probe(tmp_path / "a.tif")


@pytest.mark.parametrize(("bands", "alpha"), [(1, 2), (3, 4), (4, 5), (5, 1), (5, 6), (9, 3)])
def test_an_alpha_band_is_the_mask_of_any_number_of_bands(tmp_path: Path, bands: int, alpha: int) -> None:
    planes = np.stack([texture_numbers(seed=k) for k in range(bands + 1)])
    planes[alpha - 1] = 0
    planes[alpha - 1, :, 100:] = 65535
    write_band(tmp_path / "a.tif", planes)
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        colours = [ColorInterp.gray] + [ColorInterp.undefined] * bands
        colours[alpha - 1] = ColorInterp.alpha
        file.colorinterp = colours
    stored = probe(tmp_path / "a.tif")
    assert [b.band_index for b in stored] == [k for k in range(1, bands + 2) if k != alpha]
    assert all(b.has_mask for b in stored)
    for band in stored:
        _, valid = read_tile(band, Tile(0, 0, 320, 240))
        assert valid[:, 100:].all()
        assert not valid[:, :100].any()
        assert not read_for_alignment(band, 160).valid[:, :48].any()


@pytest.mark.parametrize(
    ("name", "is_band"), [("NIR", True), ("NIR 840", True), ("LWIR", True), ("Alpha", False), ("B4", False)]
)
def test_a_spectral_band_that_is_marked_as_alpha_is_a_band(tmp_path: Path, name: str, is_band: bool) -> None:
    """As programs export four bands: the fourth of an RGB image."""
    planes = np.stack([texture_numbers(seed=k) for k in range(4)])
    planes[3, :, :100] = 0
    write_band(tmp_path / "a.tif", planes)
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
        file.descriptions = names = "Red", "Green", "Blue", name
    stored = probe(tmp_path / "a.tif")
    assert [(b.name, b.has_mask) for b in stored] == [(one, not is_band) for one in names[: 3 + is_band]]
    _, valid = read_tile(stored[0], Tile(0, 0, 320, 240))
    assert valid.all() == is_band
    if is_band:
        np.testing.assert_array_equal(read_tile(stored[3], Tile(0, 0, 320, 240))[0], planes[3])
    else:
        with rasterio.open(tmp_path / "a.tif", "r+") as file:
            file.update_tags(4, wavelength="840")
        assert len(probe(tmp_path / "a.tif")) == 4


@pytest.mark.parametrize(("name", "dtype"), [("f.tif", "uint8"), ("f_RGB.tif", "uint8"), ("f_RGB.tif", "uint16")])
def test_colour_images_of_one_lens_are_companions_of_the_bands(tmp_path: Path, name: str, dtype: str) -> None:
    write_capture(tmp_path, "green", "red", "nir")
    colours = np.stack([texture_numbers(seed=k) // 16 for k in range(3)], axis=-1).astype(dtype)
    tifffile.imwrite(tmp_path / name, colours, photometric="rgb")
    (capture,) = discover(tmp_path).captures
    assert {b.name for b in capture.bands} == {"green", "red", "nir"}
    (capture,) = discover(tmp_path, agalign.DiscoverOptions(with_rgb=True)).captures
    assert {b.name for b in capture.bands if b.is_from_photograph} == {"RGB Red", "RGB Green", "RGB Blue"}
    tifffile.imwrite(tmp_path / "ortho_rgb.tif", colours, photometric="rgb")
    assert {c.name for c in discover(tmp_path).captures} == {"f", "ortho_rgb"}
