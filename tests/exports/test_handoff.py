"""Aligned bands as the programs that come next read them: OpenDroneMap, by the rules in `tests/odm.py`, and others."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp

import agalign
from agalign.cameras.pix4d import vignetting_on_grid
from agalign.exports.programs import export
from agalign.rasters import aligned_files
from agalign.rasters.output_grid import Layer
from agalign.records.cautions import RunFacts
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.synthetic.cameras import CameraSpec
from agalign.values import geometry, remedies
from agalign.values.capture import Band
from agalign.values.choices import Quality
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping
from agalign.values.radiometry import Radiometry

from ..builders import in_full_run
from ..conftest import Shared, read_json, seeded, write_band, write_signed
from ..docs.blocks import ROOT, blocks_of, commands_of, program, run_command
from ..odm import OdmPhoto, bands_of_orthophoto, pixels_in
from ..run_outputs import CAMERAS, capture_by

IRRADIANCE = 0.8
"""Of the synthetic flight, W / m^2 / nm."""


def exported(shared: Shared, out: Path, camera: str = "RedEdge", **write: object) -> list[OdmPhoto]:
    """The files of an export of one capture."""
    agalign.align_folder(capture_by(camera, shared), out / "out", settings=seeded(layout="bands", **write))
    for path in find_sidecars(out / "out"):
        write_signed(path, path.read_text().replace('"degraded"', '"ok"'))
    return [OdmPhoto(path) for path in export(out / "out", out / "export", "odm").files]


@pytest.mark.slow
@pytest.mark.parametrize("undistort", [False, in_full_run(True)])
def test_its_reflectance_is_that_of_this_program(undistort: bool, shared: Shared, tmp_path: Path) -> None:
    """Vignetting on the aligned grid, black level, exposure, gain, calibration and irradiance."""
    photos = exported(shared, tmp_path, undistort=undistort)
    expected = exported(shared, tmp_path / "by agalign", undistort=undistort, radiometry="sun")
    check_reflectance(photos, expected)
    assert all(p.vignetting[1] for p in photos)
    assert not any(p.vignetting[1] or p.xmp("Camera:HorizontalIrradiance") for p in expected)
    (sidecar,) = map(read_sidecar, find_sidecars(tmp_path / "by agalign" / "out"))
    light = [(band.irradiance, band.reflectance_per_radiance) for band in sidecar.output.illumination]
    assert light == [pytest.approx((IRRADIANCE, math.pi / IRRADIANCE))] * len(photos)


@pytest.mark.full
def test_vignetting_that_no_polynomial_follows_is_corrected_in_all_bands(
    shared: Shared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aligned_files, "_MAX_VIGNETTING_ERROR", 1e-7)  # of the reference, which is not moved: 1e-16
    photos = exported(shared, tmp_path)
    assert not any(p.vignetting[1] or b"Vignetting" in p.path.read_bytes() for p in photos)
    check_reflectance(photos, exported(shared, tmp_path / "r", radiometry="sun"))
    notes = (tmp_path / "export" / "README.txt").read_text()
    assert "The vignetting of 1 capture is corrected in the pixels of all bands." in notes
    assert {pixels_in(p.path).dtype.name for p in photos} == {"uint16"}


@pytest.mark.slow
def test_pixels_that_corrected_vignetting_makes_too_bright_for_their_type_are_saturated(
    shared: Shared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, strong = capture_by("RedEdge", shared), replace(VIGNETTING, vignetting=(0.0, -9e-6, 0.0))
    monkeypatch.setattr(aligned_files, "_MAX_VIGNETTING_ERROR", 1e-7)
    monkeypatch.setattr(aligned_files, "_correction", lambda _: strong)
    agalign.align_folder(images, tmp_path, settings=seeded(layout="bands", qa=True))
    (sidecar,) = map(read_sidecar, find_sidecars(tmp_path))
    folder = find_sidecars(tmp_path)[0].parent
    with rasterio.open(next(folder.glob("*.qa.tif"))) as dataset:
        flags = dict(zip(dataset.descriptions, dataset.read(), strict=True))
    shares = {}
    for band in sidecar.bands:
        clipped = pixels_in(folder / band.place.file) == 65535
        shares[band.band] = clipped.mean()
        assert band.saturated == pytest.approx(clipped.mean(), abs=1e-4)
        assert (flags[band.band][clipped] & Quality.SATURATED).all()
        assert (flags["all bands"][clipped] & Quality.SATURATED).all()
    assert max(shares.values()) > 0.005
    assert remedies.SATURATED in {caution.remedy for caution in RunFacts().cautions(sidecar)}


def check_reflectance(photos: list[OdmPhoto], expected: list[OdmPhoto]) -> None:
    assert [p.path.name for p in photos] == [p.path.name for p in expected]
    for photo, other in zip(photos, expected, strict=True):
        assert photo.horizontal_irradiance == pytest.approx(IRRADIANCE)
        values = pixels_in(other.path)
        valid = (values > 0.02) & (pixels_in(photo.path) > 0)
        errors = np.abs(photo.reflectance()[valid] / values[valid] - 1)
        assert np.median(errors) < 0.002, photo.band_name
        assert np.percentile(errors, 99) < 0.01, photo.band_name


@pytest.mark.slow
def test_the_commands_of_the_recipe_make_an_ndvi_map(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a flight to its export, and from an orthophoto with the bands in OpenDroneMap's order to NDVI."""
    monkeypatch.chdir(tmp_path)
    Path("flight").symlink_to(flight)
    page = ROOT / "docs" / "how-to" / "photogrammetry.md"
    to_export, to_map = [block for block in blocks_of(page) if block.kind == "sh"][:2]
    for command in commands_of(to_export):
        run_command(command, to_export.where)
    odm, rio = commands_of(to_map)
    assert (program(odm), program(rio)) == ("docker", "rio")
    assert '-v "$PWD/odm:/datasets/code"' in odm
    (options,) = re.findall(r"^  (--skip-band-alignment.*)$", Path("odm/README.txt").read_text(), re.MULTILINE)
    assert options.replace("'", "") in re.sub(r" +", " ", odm)

    photos = [OdmPhoto(path) for path in sorted(Path("odm/images").iterdir())]
    assert len(photos) == 10
    first = {p.band_name: p.reflectance().astype(np.float32) for p in photos if "IMG_0001" in p.path.name}
    bands = np.stack([first[name] for name in bands_of_orthophoto(photos)])
    is_seen = np.arange(bands.shape[2]) >= 20
    write_band(Path("orthophoto.tif"), np.concatenate([bands * is_seen, np.full_like(bands[:1], 255) * is_seen]))
    with rasterio.open("orthophoto.tif", "r+") as dataset:
        dataset.colorinterp = [*dataset.colorinterp[:-1], ColorInterp.alpha]
    Path("odm/odm_orthophoto").mkdir()
    Path("orthophoto.tif").rename("odm/odm_orthophoto/odm_orthophoto.tif")
    run_command(rio, to_map.where)
    with rasterio.open("ndvi.tif") as dataset:
        assert np.isnan(dataset.nodata)
        ndvi = dataset.read(1)
    red, nir = first["Red"], first["NIR"]
    is_known = is_seen & (red > 0) & (nir > 0)
    np.testing.assert_allclose(ndvi[is_known], ((nir - red) / (nir + red))[is_known], rtol=1e-5)
    assert np.isnan(ndvi[~is_known]).all()
    assert 0.1 < np.median(ndvi[is_known]) < 0.9


OUTPUT_PX = geometry.lattice(480, 360, 25, 19)
VIGNETTING = Radiometry("relative radiance", 0.0, 1.0, 1.0, (243.0, 176.0), (0.0, -4e-6, 0.0))


@pytest.mark.parametrize("bump_px", [0.0, 8.0])
def test_a_disturbed_centre_does_not_matter(bump_px: float) -> None:
    """Relief or a field around the centre pixel: a scale there says nothing about the corners."""
    distance_px = np.linalg.norm(OUTPUT_PX - (240, 180), axis=1, keepdims=True)
    positions_px = 1.01 * OUTPUT_PX + (5.0, -3.0) + bump_px * np.exp(-((distance_px / 20) ** 2)) * (1.0, 0.3)
    result = vignetting_on_grid(VIGNETTING, OUTPUT_PX, positions_px)
    assert result.error < 0.002
    assert result.centre_px == pytest.approx(((243 - 5) / 1.01, (176 + 3) / 1.01), abs=0.3)
    at_px = 250.0
    falloff = np.polynomial.polynomial.polyval(at_px, (1.0, *result.coefficients))
    assert falloff == pytest.approx(1 - 4e-6 * (1.01 * at_px) ** 2, abs=0.002)
    # A polynomial cannot represent a large relief.
    noise_px = np.random.default_rng(0).normal(0, 15, OUTPUT_PX.shape)
    assert vignetting_on_grid(VIGNETTING, OUTPUT_PX, OUTPUT_PX + noise_px).error > 0.01


def test_bands_of_one_file_have_each_their_own_vignetting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aligned_files, "_correction", lambda _: VIGNETTING)
    bands = [Band(name, Path("one.tif"), 1, 480, 360, "uint16") for name in "ab"]
    layers = [Layer(b, PixelMapping(geometry.translation(dx, 0))) for b, dx in zip(bands, (3.0, -5.0), strict=True)]
    result = aligned_files._vignettings(layers, OutputGrid(0, 0, 480, 360))
    assert [result[name].centre_px[0] for name in "ab"] == pytest.approx([243 - 3, 243 + 5])


def test_rows_of_a_band_on_a_finer_and_cropped_grid() -> None:
    band = Band("NIR", Path("nir.tif"), 1, 480, 360, "uint16")
    layer = Layer(band, PixelMapping(np.array([[0.5, 0.0, 3.0], [0.0, 0.5, -2.0], [0.0, 0.0, 1.0]])))
    assert aligned_files._rows(layer, OutputGrid(0, 60, 900, 600)) == pytest.approx((28.0, 0.5))


# ---- tags of aligned bands


CAPTURE_TAGS = ("@drone-dji:CaptureUUID", "MicaSense:CaptureId", "@Camera:CaptureUUID", "Camera:CaptureUUID")
TAGS = [
    *(f"Image {name}" for name in ("Make", "Model")),
    *(f"GPS GPS{name}" for name in ("Latitude", "LatitudeRef", "Longitude", "Altitude")),
    *(f"EXIF {name}" for name in ("DateTimeOriginal", "FocalLength", "ExposureTime", "ISOSpeedRatings")),
]
DJI = "CalibratedHMatrix DewarpData RelativeOpticalCenterX RelativeOpticalCenterY CalibratedOpticalCenterX DewarpFlag"
PIX4D = "PrincipalPoint", "PerspectiveDistortion", "PerspectiveFocalLength"
SHARED_TAGS = [*(f"Camera:{name}" for name in PIX4D), *(f"@drone-dji:{name}" for name in DJI.split())]
Aligned = tuple[CameraSpec, list[OdmPhoto], list[OdmPhoto], Path]


@pytest.fixture(params=list(CAMERAS))
def aligned(request: pytest.FixtureRequest, shared: Shared) -> Aligned:
    """(camera, its files, the aligned ones, the folder of their export)."""
    name = request.param
    out = shared(f"handoff {name}", lambda folder: exported(shared, folder, camera=name))
    before, after = (
        [OdmPhoto(path) for path in sorted(folder.rglob("*")) if path.suffix.lower() == ".tif"]
        for folder in (capture_by(name, shared), out / "out")
    )
    return CAMERAS[name], before, after, out / "export"


def xmp_of(photo: OdmPhoto) -> dict[str, Any]:
    """Keys with the prefixes that cameras write, attributes with an @."""
    return {name: value for part in photo.descriptions for name, value in part.items()}


def numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        items = value["rdf:Seq"]["rdf:li"]
        return [float(v) for v in (items if isinstance(items, list) else [items])]
    return [float(v) for v in str(value).split(",")]


@pytest.mark.slow
def test_bands_are_one_camera_and_one_capture(aligned: Aligned) -> None:
    """No angles between bands, one principal point, one lens, one homography."""
    camera, _, photos, export_folder = aligned
    assert len(photos) == sum(b.sees == "light" for b in camera.bands) > 1
    assert len({p.camera_id for p in photos}) == len({p.capture_uuid for p in photos}) == 1
    assert len({p.band_name for p in photos}) == len(photos)
    assert len({len(p.vignetting[1]) for p in photos}) == 1
    packets = [xmp_of(p) for p in photos]
    for tag in SHARED_TAGS:
        assert len({str(xmp.get(tag)) for xmp in packets}) == 1, tag
    is_micasense = camera.maker == "MicaSense"
    for xmp in packets if is_micasense else []:
        assert numbers(xmp["Camera:RigRelatives"]) == numbers(xmp["Camera:RigTranslations"]) == [0, 0, 0]
    text = (export_folder / "README.txt").read_text()
    assert ("--radiometric-calibration camera+sun" in text) == is_micasense
    assert all((p.horizontal_irradiance is not None) == is_micasense for p in photos)


@pytest.mark.slow
def test_bands_place_time_and_camera_are_as_before(aligned: Aligned) -> None:
    _, before, after, _ = aligned
    for source, photo in zip(before, after, strict=True):
        assert photo.path.name == source.path.name
        old, new = xmp_of(source), xmp_of(photo)
        for tag in ("Camera:BandName", "Camera:CentralWavelength", *CAPTURE_TAGS):
            assert new.get(tag) == old.get(tag)
        assert new["Camera:BandName"]
        for tag in TAGS:
            assert str(photo.exif.get(tag)) == str(source.exif.get(tag)), tag
        with Image.open(photo.path) as image:
            assert image.getexif()[271] == str(source.exif["Image Make"])
            assert image.getexif().get_ifd(0x8825)[1] == "N"


@pytest.mark.slow
def test_the_principal_point_is_on_the_pixel_that_it_was_on(aligned: Aligned) -> None:
    camera, before, after, export_folder = aligned
    data = read_json(find_sidecars(export_folder.parent / "out")[0])
    here, there = (next(p for p in ps if p.path.name == Path(data["reference"]["file"]).name) for ps in (before, after))
    old, new = xmp_of(here), xmp_of(there)
    if camera.maker == "MicaSense":
        density = there.exif_number("EXIF FocalPlaneXResolution")
        points = zip(numbers(old["Camera:PrincipalPoint"]), numbers(new["Camera:PrincipalPoint"]), strict=True)
        moved = [density * (a - b) for a, b in points]
    elif camera.maker == "DJI":
        names = (f"@drone-dji:CalibratedOpticalCenter{axis}" for axis in "XY")
        moved = [float(old[n]) - float(new[n]) for n in names]
    else:
        pytest.skip("its tags have no principal point")
    assert moved == pytest.approx(data["output"]["crop"][:2], abs=0.01)


@pytest.mark.slow
def test_undistorted_files_have_tags_without_distortion(shared: Shared, tmp_path: Path) -> None:
    photos = exported(shared, tmp_path, camera="M3M calibrated", undistort=True)
    assert len(photos) == 4
    for xmp in map(xmp_of, photos):
        assert xmp["@drone-dji:DewarpFlag"] == "1"
        assert numbers(xmp["@drone-dji:DewarpData"].partition(";")[2])[4:] == [0] * 5
