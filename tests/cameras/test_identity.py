"""Bands and captures are recognised by evidence: what is known of the camera, tags and names together."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

from agalign.cameras.discover import DiscoverOptions, discover
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.tiff_directory import byte_string, text
from agalign.errors import InputError
from agalign.products.indices.formulas import bands_for, index_named

from .test_vendors import MICASENSE, VENDORS, packet, tagged, write_capture, write_file

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def missing(folder: Path, **options: object) -> list[tuple[str, ...]]:
    return [c.missing_bands for c in discover(folder, DiscoverOptions(**options)).captures]


def texts(folder: Path) -> list[str]:
    return [p.text for p in discover(folder).problems]


@pytest.mark.parametrize(
    ("vendor", "lost", "expected"),
    [
        ("Mavic 3", "_MS_G _MS_RE", {"Green", "RedEdge"}),
        ("Phantom 4", "DJI_0014", {"RedEdge"}),
        ("Sequoia", "_NIR _RED", {"NIR", "Red"}),
        ("6X", "IMG_00012_475", {"Blue"}),
        ("RedEdge", "_3 _5", {"Red", "Red edge"}),
    ],
)
def test_the_bands_of_a_known_camera_are_missing_even_in_all_captures(
    tmp_path: Path, vendor: str, lost: str, expected: set[str]
) -> None:
    write_capture(tmp_path, VENDORS[vendor])
    assert missing(tmp_path) == [()]
    for path in [p for p in tmp_path.rglob("*.*") if any(part in p.stem for part in lost.split())]:
        path.unlink()
    assert [set(names) for names in missing(tmp_path)] == [expected]
    chosen = [b.name for b in discover(tmp_path).captures[0].bands]
    assert missing(tmp_path, bands=chosen) == [()]


def write_rededge(folder: Path, number: int, bands: Mapping[int, tuple[str, int]], serial: str = "RP01") -> None:
    """The files of a capture of a RedEdge, {number of the file: (band, wavelength in nm)}."""
    for k, (band, nm) in bands.items():
        values = {**tagged(MICASENSE, CaptureId=f"id{number}"), (NAMESPACE, "BandName"): (band,)}
        values |= tagged(NAMESPACE, CentralWavelength=str(nm), RigCameraIndex=str(k - 1))
        first = {271: text("MicaSense"), 272: text("RedEdge-P"), 700: byte_string(packet(values, "attributes"))}
        write_file(folder / f"IMG_{number:04d}_{k}.tif", first, {0xA431: text(serial)})


GREEN, RED, EDGE = ("Green", 560), ("Red", 668), ("Red edge", 717)


def test_names_that_change_between_captures_of_a_camera_have_a_line(tmp_path: Path) -> None:
    for number in range(4):
        second, third = (RED, EDGE) if number < 2 else (EDGE, RED)
        write_rededge(tmp_path, number, {1: GREEN, 2: second, 3: third})
    first, other = texts(tmp_path)
    assert "IMG_0002_2.tif: files with RigCameraIndex 1 of one camera are Red (668 nm) in IMG_0000, IMG_0001" in first
    assert "and Red edge (717 nm) in IMG_0002, IMG_0003; one of the names is wrong" in first
    assert "IMG_0002_3.tif: files with RigCameraIndex 2" in other
    assert not discover(tmp_path).is_complete
    # Another camera may have another order, and firmware may write another wavelength for a band.
    shutil.rmtree(tmp_path)
    write_rededge(tmp_path, 0, {1: GREEN, 2: RED, 3: EDGE, 4: ("NIR", 840)})
    write_rededge(tmp_path, 1, {1: GREEN, 2: EDGE, 3: RED}, serial="RP02")
    write_rededge(tmp_path, 2, {1: GREEN, 2: RED, 3: EDGE, 4: ("NIR", 842)})
    assert texts(tmp_path) == []
    write_rededge(tmp_path, 3, {1: GREEN, 2: RED, 3: ("Red edge", 740), 4: ("NIR", 842)})
    assert ["Red edge (717 nm) in IMG_0000, IMG_0002 and Red edge (740 nm) in IMG_0003" in t for t in texts(tmp_path)]


@pytest.mark.parametrize(
    ("bands", "expected", "used"),
    [
        ({1: ("Blue", 668), 2: RED, 4: ("NIR", 840)}, "'Blue' contradicts its wavelength of 668 nm", ["NIR", "Red"]),
        ({1: GREEN, 3: ("Red", 475), 4: ("NIR", 840)}, "'Red' contradicts its wavelength of 475 nm", None),
        (
            {1: ("A", 668), 2: RED, 4: ("NIR", 840)},
            "A and Red of a capture have one wavelength, 668 nm",
            ["NIR", "Red"],
        ),
    ],
)
def test_names_and_wavelengths_that_contradict_each_other_have_a_line(
    tmp_path: Path, bands: Mapping[int, tuple[str, int]], expected: str, used: list[str] | None
) -> None:
    for number in (1, 2):
        write_rededge(tmp_path, number, bands)
    result = discover(tmp_path)
    assert any(expected in p.text and ", in 2 files" in p.text for p in result.problems)
    names, wavelengths = zip(*((b.name, b.wavelength_nm) for b in result.captures[0].bands), strict=True)
    if used is None:
        with pytest.raises(InputError, match="needs a red band"):
            bands_for(index_named("ndvi"), names, wavelengths)
    else:
        assert [names[i] for i in bands_for(index_named("ndvi"), names, wavelengths)] == used


def test_spellings_of_a_name_are_one_band(tmp_path: Path) -> None:
    for number, edge in enumerate(("Red edge", "Red Edge", "REDEDGE", "Red edge ")):
        nir = "NIR " if number == 1 else "NIR"
        write_rededge(tmp_path, number, {1: ("Blue", 475), 2: GREEN, 3: RED, 4: (nir, 840), 5: (edge, 717)})
    result = discover(tmp_path, DiscoverOptions(reference="RedEdge"))
    names = ["Blue", "Green", "Red", "NIR", "Red edge"]
    assert [[b.name for b in c.bands] for c in result.captures] == [names] * 4
    assert {(c.reference.name, c.missing_bands) for c in result.captures} == {("Red edge", ())}
    assert not result.problems
    assert len(discover(tmp_path, DiscoverOptions(bands=("nir", "rededge"))).captures[0].bands) == 2
