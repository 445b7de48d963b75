"""Aligned bands as the programs that come next read them: OpenDroneMap, by the rules in `tests/odm.py`, and others."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import agalign
from agalign.cameras.pix4d import vignetting_on_grid
from agalign.products.exports.programs import export
from agalign.products.rasters import aligned_files
from agalign.products.rasters.layout import Layer
from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.synthetic.cameras import CameraSpec
from agalign.values import geometry
from agalign.values.capture import Band, Radiometry
from agalign.values.choices import ExportProgram
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping

from ..builders import in_full_run
from ..conftest import Shared, read_json, seeded
from ..odm import OdmPhoto, pixels_in
from .conftest import CAMERAS, capture_by

IRRADIANCE = 0.8
"""Of the synthetic flight, W / m^2 / nm."""


def exported(
    shared: Shared, out: Path, program: ExportProgram = "odm", camera: str = "RedEdge", **write: object
) -> list[OdmPhoto]:
    """The files of an export of one capture, the reference first."""
    agalign.align_folder(capture_by(camera, shared), out / "out", settings=seeded(layout="bands", **write))
    for path in find_sidecars(out / "out"):
        path.write_text(path.read_text().replace('"degraded"', '"ok"'))
    report = export(out / "out", out / "export", program)
    return [OdmPhoto(path) for path in report.files]


def option(out: Path) -> str:
    """The value of --radiometric-calibration that the export recommends."""
    return (out / "export" / "README.txt").read_text().partition("--radiometric-calibration ")[2].split()[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["RedEdge", "M3M", *map(in_full_run, ("M3M calibrated", "6X"))])
def test_bands_are_one_camera_and_one_capture(name: str, shared: Shared, tmp_path: Path) -> None:
    photos = exported(shared, tmp_path, camera=name)
    assert len(photos) >= 4
    assert len({p.camera_id for p in photos}) == 1
    assert len({p.capture_uuid for p in photos}) == 1
    assert len({p.band_name for p in photos}) == len(photos)
    assert len({len(p.vignetting[1]) for p in photos}) == 1
    with_sun = option(tmp_path) == "camera+sun"
    assert with_sun == all(p.horizontal_irradiance is not None for p in photos) == (name == "RedEdge")


@pytest.mark.slow
@pytest.mark.parametrize("program", ["odm", *map(in_full_run, ("metashape", "pix4d"))])
def test_its_reflectance_is_that_of_this_program(program: ExportProgram, shared: Shared, tmp_path: Path) -> None:
    """Vignetting on the aligned grid, black level, exposure, gain, calibration and irradiance."""
    photos = exported(shared, tmp_path, program)
    expected = exported(shared, tmp_path / "by agalign", program, radiometry="sun")
    check_reflectance(photos, expected)
    assert all(p.vignetting[1] for p in photos)
    assert not any(p.vignetting[1] or p.xmp("Camera:HorizontalIrradiance") for p in expected)
    (sidecar,) = map(read_sidecar, find_sidecars(tmp_path / "by agalign" / "out"))
    light = [(band.irradiance, band.reflectance_per_radiance) for band in sidecar.output.illumination]
    assert light == [pytest.approx((IRRADIANCE, math.pi / IRRADIANCE))] * len(photos)


@pytest.mark.full
def test_vignetting_follows_pixels_without_distortion(shared: Shared, tmp_path: Path) -> None:
    photos = exported(shared, tmp_path, undistort=True)
    assert all(p.vignetting[1] for p in photos)
    check_reflectance(photos, exported(shared, tmp_path / "r", undistort=True, radiometry="sun"))


@pytest.mark.slow
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


def check_reflectance(photos: list[OdmPhoto], expected: list[OdmPhoto]) -> None:
    assert [p.path.name for p in photos] == [p.path.name for p in expected]
    for photo, other in zip(photos, expected, strict=True):
        assert photo.horizontal_irradiance == pytest.approx(IRRADIANCE)
        values = pixels_in(other.path)
        valid = (values > 0.02) & (pixels_in(photo.path) > 0)
        errors = np.abs(photo.reflectance()[valid] / values[valid] - 1)
        assert np.median(errors) < 0.002, photo.band_name
        assert np.percentile(errors, 99) < 0.01, photo.band_name


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


def test_bands_of_one_file_have_each_their_own_vignetting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aligned_files, "_correction", lambda _: VIGNETTING)
    bands = [Band(name, Path("one.tif"), 1, 480, 360, "uint16") for name in "ab"]
    layers = [Layer(b, PixelMapping(geometry.translation(dx, 0))) for b, dx in zip(bands, (3.0, -5.0), strict=True)]
    result = aligned_files._vignettings(layers, OutputGrid(0, 0, 480, 360))
    assert [result[name].centre_px[0] for name in "ab"] == pytest.approx([243 - 3, 243 + 5])


def test_large_relief_is_no_polynomial() -> None:
    rng = np.random.default_rng(0)
    positions_px = OUTPUT_PX + rng.normal(0, 15, OUTPUT_PX.shape)
    assert vignetting_on_grid(VIGNETTING, OUTPUT_PX, positions_px).error > 0.01


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
Aligned = tuple[CameraSpec, Path, Path]


def align(images: Path, out: Path, **write: object) -> None:
    settings, options = seeded(layout="bands", **write), agalign.DiscoverOptions(with_rgb=True)
    (report,) = agalign.align_folder(images, out, settings=settings, options=options)
    assert report.error is None


@pytest.fixture(params=list(CAMERAS))
def aligned(request: pytest.FixtureRequest, shared: Shared) -> Aligned:
    """(camera, its files, the aligned ones)."""
    images = capture_by(request.param, shared)
    return CAMERAS[request.param], images, shared(f"handoff {request.param}", lambda out: align(images, out))


def bands_of(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() == ".tif" and not p.name.endswith("_D.tif"))


def xmp_of(path: Path) -> dict[str, Any]:
    """Keys with the prefixes that cameras write, attributes with an @."""
    return {name: value for part in OdmPhoto(path).descriptions for name, value in part.items()}


def numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        items = value["rdf:Seq"]["rdf:li"]
        return [float(v) for v in (items if isinstance(items, list) else [items])]
    return [float(v) for v in str(value).split(",")]


@pytest.mark.slow
def test_bands_place_time_and_camera_are_as_before(aligned: Aligned) -> None:
    camera, folder, out = aligned
    before, after = ({p.name: xmp_of(p) for p in bands_of(f)} for f in (folder, out))
    assert set(before) == set(after)
    assert len(after) == sum(b.sees == "light" for b in camera.bands)
    captures = {xmp.get(tag) for xmp in after.values() for tag in CAPTURE_TAGS} - {None}
    assert len(captures) == 1
    for name, xmp in after.items():
        for tag in ("Camera:BandName", "Camera:CentralWavelength", *CAPTURE_TAGS):
            assert xmp.get(tag) == before[name].get(tag)
        assert xmp["Camera:BandName"]
    assert len({xmp["Camera:BandName"] for xmp in after.values()}) == len(after)
    for source, path in zip(bands_of(folder), bands_of(out), strict=True):
        exif_before, exif_after = OdmPhoto(source).exif, OdmPhoto(path).exif
        for tag in TAGS:
            assert str(exif_after.get(tag)) == str(exif_before.get(tag)), tag
        with Image.open(path) as image:
            assert image.getexif()[271] == str(exif_before["Image Make"])
            assert image.getexif().get_ifd(0x8825)[1] == "N"


@pytest.mark.slow
def test_tags_of_aligned_bands_describe_one_camera(aligned: Aligned) -> None:
    """All bands are one camera's now: no angles between them, one principal point, one lens, one homography."""
    camera, _, out = aligned
    packets = [xmp_of(p) for p in bands_of(out)]
    assert len(packets) > 1
    if camera.maker == "MicaSense":
        for xmp in packets:
            assert numbers(xmp["Camera:RigRelatives"]) == [0, 0, 0]
            assert numbers(xmp["Camera:RigTranslations"]) == [0, 0, 0]
    for tag in SHARED_TAGS:
        assert len({str(xmp.get(tag)) for xmp in packets}) == 1, tag


@pytest.mark.slow
def test_the_principal_point_is_on_the_pixel_that_it_was_on(aligned: Aligned) -> None:
    camera, folder, out = aligned
    (sidecar,) = find_sidecars(out)
    data = read_json(sidecar)
    x0, y0, *_ = data["output"]["crop"]
    reference = data["reference"]["file"]
    before, after = (next(xmp_of(p) for p in bands_of(f) if p.name == reference) for f in (folder, out))
    if camera.maker == "MicaSense":
        (path,) = (p for p in bands_of(out) if p.name == reference)
        density = OdmPhoto(path).exif_number("EXIF FocalPlaneXResolution")
        here, there = (numbers(x["Camera:PrincipalPoint"]) for x in (before, after))
        moved = [density * (a - b) for a, b in zip(here, there, strict=True)]
    elif camera.maker == "DJI":
        names = "@drone-dji:CalibratedOpticalCenterX", "@drone-dji:CalibratedOpticalCenterY"
        moved = [float(before[n]) - float(after[n]) for n in names]
    else:
        pytest.skip("its tags have no principal point")
    assert moved == pytest.approx([x0, y0], abs=0.01)


@pytest.mark.slow
def test_undistorted_files_have_tags_without_distortion(shared: Shared, tmp_path: Path) -> None:
    align(capture_by("M3M calibrated", shared), tmp_path, undistort=True)
    paths = bands_of(tmp_path)
    assert len(paths) == 4
    for path in paths:
        xmp = xmp_of(path)
        assert xmp["@drone-dji:DewarpFlag"] == "1"
        assert numbers(xmp["@drone-dji:DewarpData"].partition(";")[2])[4:] == [0] * 5
