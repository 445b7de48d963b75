"""Aligned bands as the programs that come next read them, with the libraries that they read them with."""

from pathlib import Path
from typing import Any

import exifread
import pytest
import xmltodict
from PIL import Image

import agalign
from agalign.products.sidecar.file import find_sidecars
from agalign.synthetic.camera_model import CameraSpec

from ..conftest import Shared, read_json, seeded
from .conftest import CAMERAS, capture_by

pytestmark = pytest.mark.slow

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


def exif_of(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        result: dict[str, Any] = exifread.process_file(file, details=True, extract_thumbnail=False)
    return result


def xmp_of(path: Path) -> dict[str, Any]:
    """Keys with the prefixes that cameras write, attributes with an @, as OpenDroneMap looks them up."""
    data = path.read_bytes()
    packet = data[data.index(b"<x:xmpmeta") : data.index(b"</x:xmpmeta>") + len(b"</x:xmpmeta>")]
    result = xmltodict.parse(packet)["x:xmpmeta"]["rdf:RDF"]["rdf:Description"]
    merged: dict[str, Any] = {}
    for description in result if isinstance(result, list) else [result]:
        merged |= description
    return merged


def numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        items = value["rdf:Seq"]["rdf:li"]
        return [float(v) for v in (items if isinstance(items, list) else [items])]
    return [float(v) for v in str(value).split(",")]


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
        exif_before, exif_after = exif_of(source), exif_of(path)
        for tag in TAGS:
            assert str(exif_after.get(tag)) == str(exif_before.get(tag)), tag
        with Image.open(path) as image:
            assert image.getexif()[271] == str(exif_before["Image Make"])
            assert image.getexif().get_ifd(0x8825)[1] == "N"


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


def test_the_principal_point_is_on_the_pixel_that_it_was_on(aligned: Aligned) -> None:
    camera, folder, out = aligned
    (sidecar,) = find_sidecars(out)
    data = read_json(sidecar)
    x0, y0, *_ = data["output"]["crop"]
    reference = data["reference"]["file"]
    before, after = (next(xmp_of(p) for p in bands_of(f) if p.name == reference) for f in (folder, out))
    if camera.maker == "MicaSense":
        (path,) = (p for p in bands_of(out) if p.name == reference)
        density = float(exif_of(path)["EXIF FocalPlaneXResolution"].values[0])
        here, there = (numbers(x["Camera:PrincipalPoint"]) for x in (before, after))
        moved = [density * (a - b) for a, b in zip(here, there, strict=True)]
    elif camera.maker == "DJI":
        names = "@drone-dji:CalibratedOpticalCenterX", "@drone-dji:CalibratedOpticalCenterY"
        moved = [float(before[n]) - float(after[n]) for n in names]
    else:
        pytest.skip("its tags have no principal point")
    assert moved == pytest.approx([x0, y0], abs=0.01)


def test_undistorted_files_have_tags_without_distortion(shared: Shared, tmp_path: Path) -> None:
    align(capture_by("M3M calibrated", shared), tmp_path, undistort=True)
    paths = bands_of(tmp_path)
    assert len(paths) == 4
    for path in paths:
        xmp = xmp_of(path)
        assert xmp["@drone-dji:DewarpFlag"] == "1"
        assert numbers(xmp["@drone-dji:DewarpData"].partition(";")[2])[4:] == [0] * 5
