from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import tifffile
from synthetic_flights.cameras import ALTUM_PT
from synthetic_flights.troubles import make_two_headings

import agalign
from agalign.pixels.raster import open_raster
from agalign.rasters.output_grid import at_finest_scale
from agalign.rasters.pan_sharpen import (
    PanSharpened,
    brovey_ratio,
    panchromatic,
    scale_of_earlier,
    sharpened,
    weights_of,
)
from agalign.rasters.product import RenderOptions
from agalign.values import geometry
from agalign.values.alignment import Prediction
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale

from ..conftest import textured_image, write_band
from ..run_outputs import aligned, context_of

pytestmark = pytest.mark.slow


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Two bands of half the resolution, brought to that of the panchromatic that is made of them."""
    fine = [2000 + 300 * textured_image(320, 240, seed) for seed in (1, 2)]
    coarse = [cv2.resize(cv2.resize(f, (160, 120), interpolation=cv2.INTER_AREA), (320, 240)) for f in fine]
    return np.stack(coarse), (0.7 * fine[0] + 0.2 * fine[1]).astype(np.float32)


def test_weights_are_those_that_the_panchromatic_is_made_with() -> None:
    bands, pan = scene()
    np.testing.assert_allclose(weights_of(bands, pan, 2.0), [0.7, 0.2], atol=0.03)
    missing = np.where(np.arange(320) < 50, np.float32(np.nan), bands)
    np.testing.assert_allclose(weights_of(missing, pan, 2.0), [0.7, 0.2], atol=0.04)
    nothing = np.full_like(bands, np.nan)
    np.testing.assert_allclose(weights_of(nothing, pan, 2.0), [0.5, 0.5])


def test_bands_keep_their_brightness_if_the_photograph_is_not_linear() -> None:
    """Bands outside its range are not sharpened: the ratios to them would change."""
    bands, pan = scene()
    bands, photograph = bands - 1100.0, 255 * ((pan - 990.0) / pan.max()) ** 0.3
    ratio = brovey_ratio(bands, photograph, weights_of(bands, photograph, 2.0))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)


def test_the_result_equals_that_of_gdal(tmp_path: Path) -> None:
    bands, pan = scene()
    place = {"crs": "EPSG:32631", "transform": rasterio.Affine(0.1, 0, 5e5, 0, -0.1, 5.8e6)}
    names = {tmp_path / "a.tif": bands[0], tmp_path / "b.tif": bands[1], tmp_path / "pan.tif": pan}
    for path, pixels in names.items():
        write_band(path, pixels, **place)
    sources = [f"<SourceFilename>{path}</SourceFilename><SourceBand>1</SourceBand>" for path in names]
    vrt = (
        '<VRTDataset subClass="VRTPansharpenedDataset"><PansharpeningOptions><Algorithm>WeightedBrovey</Algorithm>'
        "<AlgorithmOptions><Weights>0.7,0.2</Weights></AlgorithmOptions>"
        f'<PanchroBand>{sources[2]}</PanchroBand><SpectralBand dstBand="1">{sources[0]}</SpectralBand>'
        f'<SpectralBand dstBand="2">{sources[1]}</SpectralBand></PansharpeningOptions></VRTDataset>'
    )
    with rasterio.open(vrt) as file:
        expected = file.read()
    ratio = brovey_ratio(bands, pan, np.array([0.7, 0.2]))
    np.testing.assert_allclose(bands * ratio, expected, rtol=1e-4)


@pytest.mark.full
def test_sharpening_keeps_brightness_and_adds_detail(tmp_path: Path) -> None:
    make_two_headings(tmp_path / "in", 1, (640, 480), camera=ALTUM_PT, line=1, lakes=False)
    settings = agalign.Settings(write=agalign.WriteSettings(pan_sharpen=True, crop="none", statistics=True))
    (report,) = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
    assert report.error is None
    folder = tmp_path / "out" / "0000SET" / "000"
    with rasterio.open(folder / "IMG_0001.tif") as stack, rasterio.open(folder / "IMG_0001.pan.tif") as sharp:
        assert sharp.descriptions == ("Blue", "Green", "Red", "NIR", "Red edge")
        assert sharp.width == pytest.approx(2 * stack.width, rel=0.04)
        assert sharp.dtypes[0] == "uint16"
        assert sharp.tags(2)["PANSHARPENED"].startswith("weighted Brovey by Panchro")
        assert sharp.tags(4)["wavelength"] == "840"
        assert not [name for name in sharp.tags(4) if name.startswith("STATISTICS")]  # of the bands before
        before, after = stack.read(2).astype(float), sharp.read(2).astype(float)
    # Of a dark level and light: the light is as much as it was.
    dark = 4800
    assert np.median(after) - dark == pytest.approx(np.median(before) - dark, rel=0.02)
    plain = cv2.resize(before, after.shape[::-1], interpolation=cv2.INTER_CUBIC)
    assert np.std(cv2.Laplacian(after, -1)) > 1.3 * np.std(cv2.Laplacian(plain, -1))


def capture_of(*bands: Band) -> Capture:
    return Capture("a", Path(), bands, 0)


def test_what_sees_the_others_light_together() -> None:
    def band(name: str, width_nm: float | None = None, **more: object) -> Band:
        return Band(name, Path("x.tif"), 1, 64, 48, "uint16", bandwidth_nm=width_nm, **more)

    def pan(*bands: Band) -> list[str]:
        return [b.name for b in panchromatic(capture_of(*bands))]

    colours = [band(f"RGB {c}", is_from_photograph=True) for c in ("Red", "Green", "Blue")]
    assert pan(band("Green", 20), band("Panchro", 463)) == ["Panchro"]
    thermal = band("Green", 20), band("LWIR", 6000, wavelength_nm=11000.0)
    assert pan(*thermal) == []
    assert pan(band("Green", 20), *colours) == ["RGB Red", "RGB Green", "RGB Blue"]
    assert pan(band("Green", 20), band("pan"), *colours) == ["pan"]
    with pytest.raises(agalign.InputError, match="--with-rgb"):
        PanSharpened().check(capture_of(*thermal))


@pytest.mark.parametrize(("nodata", "dtype"), [(0, np.uint16), (-9999.0, np.float32)])
def test_gaps_keep_nodata_and_unseen_bands_are_not_sharpened(tmp_path: Path, nodata: float, dtype: type) -> None:
    _, pan = scene()
    planes = np.stack([np.full_like(pan, 3000), np.full_like(pan, 2000), pan]).astype(dtype)
    planes[:, :20] = nodata
    write_band(tmp_path / "layers.tif", planes, nodata=nodata)
    bands = [
        Band(name, tmp_path, 1, 320, 240, "uint16", wavelength_nm=nm, bandwidth_nm=width_nm)
        for name, nm, width_nm in (("Green", 560.0, 20.0), ("NIR", 900.0, 40.0), ("Panchro", 634.5, 463.0))
    ]
    with open_raster(tmp_path / "layers.tif") as file:
        _, blocks = sharpened(file, bands[:2], bands[2:], 2.0, is_raw=False)
        result = np.stack([pixels for pixels, *_ in blocks])
    assert (result[:, :20] == nodata).all()
    assert result[0, 30:].std() > 100
    assert (result[1, 20:] == 2000).all()


def test_numbers_with_an_offset_are_sharpened_by_their_values(tmp_path: Path) -> None:
    """The sharpened file has the scales and offsets of the bands."""
    (green, red), pan = scene()
    bands = [Band(name, tmp_path, 1, 320, 240, "uint16") for name in ("Green", "Red", "Panchro")]
    planes, results, offset = np.stack([green, red, pan]), list[np.ndarray](), 1000
    for number, offsets in ((0, (0.0,) * 3), (offset, (-0.1,) * 3)):
        path = tmp_path / f"{number}.tif"
        write_band(path, planes.astype(np.uint16) + np.uint16(number))
        with rasterio.open(path, "r+") as file:
            file.scales, file.offsets = (1e-4,) * 3, offsets
        with open_raster(path) as file:
            descriptions, blocks = sharpened(file, bands[:2], bands[2:], 2.0, is_raw=True)
            results.append(np.stack([pixels for pixels, *_ in blocks]).astype(float))
        assert [layer.scale_offset for layer in descriptions] == [(1e-4, offsets[0])] * 2
    np.testing.assert_allclose(results[1] - offset, results[0], atol=1)


@pytest.mark.parametrize(
    ("pan", "wavelength_nm", "status", "std_px", "sharpens"),
    [
        ("Panchro", 840.0, "aligned", 0.0, True),
        ("Panchro", 840.0, "predicted", 0.9, True),
        ("Panchro", 840.0, "predicted", 1.9, False),
        ("Panchro", 840.0, "seed_only", 0.0, False),
        ("RGB Red", 650.0, "aligned", 0.0, True),
        ("RGB Red", 730.0, "aligned", 0.0, False),
    ],
)
def test_a_band_that_is_not_delivered_or_does_not_see_infra_red_sharpens_none(
    tmp_path: Path, pan: str, wavelength_nm: float, status: str, std_px: float, sharpens: bool
) -> None:
    size_px, identity = (64, 48), PixelMapping(np.eye(3))
    one = Band("b", tmp_path / "b.tif", 1, *size_px, "uint16", wavelength_nm=wavelength_nm)
    other = Band(pan, tmp_path / "pan.tif", 1, *size_px, "uint16", is_from_photograph=pan == "RGB Red")
    for path in (one.path, other.path):
        write_band(path, np.full((48, 64), 500, np.uint16))
    prediction = None if status == "seed_only" else Prediction(np.eye(3), "flight", std_px)
    context = context_of(
        capture_of(one, other), {pan: aligned(identity, size_px, status, prediction=prediction)}, tmp_path
    )
    files = PanSharpened().write(context)
    assert bool(files) == sharpens
    for file in files:
        with tifffile.TiffFile(file.path) as image:
            assert "ModelTransformationTag" not in image.pages[0].tags, "no georeference is invented"


@pytest.mark.parametrize("scale", [1, 2])
def test_a_flight_is_sharpened_in_the_crop_of_its_stacks(tmp_path: Path, scale: int) -> None:
    """Captures that are added to a finished flight keep its crop, and have another rig."""
    size_px, crop = (64, 48), OutputGrid(5, 4, 40, 30)
    red = Band("Red", tmp_path / "red.tif", 1, *size_px, "uint16")
    pan = Band("Panchro", tmp_path / "pan.tif", 1, *(scale * n for n in size_px), "uint16")
    for band in (red, pan):
        write_band(band.path, np.full(band.size_px[::-1], 500, np.uint16))
    to_pan = np.diag([scale, scale, 1.0])
    alignments = {pan.name: aligned(PixelMapping(to_pan), size_px)}
    limits = [(geometry.translation(6.0 * scale, 0.0) @ to_pan, pan)]
    context = context_of(capture_of(red, pan), alignments, tmp_path)
    fine = at_finest_scale(crop, red, limits)
    (file,) = PanSharpened().write(replace(context, options=RenderOptions(common=crop, fine=fine)))
    with rasterio.open(file.path) as sharp:
        assert (sharp.width, sharp.height) == (scale * crop.width, scale * crop.height)
    assert scale_of_earlier(file.path, crop) == scale
    assert scale_of_earlier(red.path.with_suffix(".json"), crop) is None
    assert at_finest_scale(crop, red, limits, 1.5) == OutputGrid(8, 6, 59, 45, PixelScale(1.5, 1.5))
    assert at_finest_scale(crop, red, []) is None
