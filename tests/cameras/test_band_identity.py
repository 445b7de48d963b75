"""Bands and captures are recognised by evidence: what is known of the camera, tags and names together."""

import shutil
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from agalign.cameras.discover import DiscoverOptions, discover
from agalign.cameras.generic import Generic
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.tiff_directory import byte_string, text
from agalign.errors import InputError
from agalign.pixels.raster import probe
from agalign.spectral_indices.formulas import bands_for, index_named
from agalign.values.capture import Band
from agalign.values.spectrum import role_of

from ..conftest import write_band
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
    lost_files = [p for p in tmp_path.rglob("*.*") if any(part in p.stem for part in lost.split())]
    for path in lost_files:
        path.write_text("no image")
    (capture,) = discover(tmp_path).captures
    assert set(capture.missing_bands) == set(capture.unreadable_bands) == expected
    reasons = {f"{path.name}: is not a TIFF, JPEG or PNG" for path in lost_files}
    assert {reason.what for reason in capture.unreadable_bands.values()} == reasons
    for path in lost_files:
        path.unlink()
    assert [set(names) for names in missing(tmp_path)] == [expected]
    assert not discover(tmp_path).captures[0].unreadable_bands
    chosen = [b.name for b in discover(tmp_path).captures[0].bands]
    assert missing(tmp_path, bands=chosen) == [()]


ALTUM = {"1": "Blue", "2": "Green", "3": "Red", "4": "NIR", "5": "Red edge"}


@pytest.mark.parametrize(
    ("model", "others", "without_tags", "lost", "expected"),
    [
        ("Altum", {"6": "LWIR"}, "", "", set()),
        ("Altum", {"6": "LWIR"}, "3", "2 5 6", {"Green", "Red edge", "LWIR"}),
        ("Altum-PT", {"6": "Panchro", "7": "LWIR"}, "", "", set()),
        ("Altum-PT", {"6": "Panchro", "7": "LWIR"}, "", "6", {"Pan"}),
        ("Altum-PT", {"6": "PAN", "7": "Thermal"}, "", "3", {"Red"}),
        ("Altum-PT", {"6": "Panchro", "7": "LWIR"}, "", "6 7", {"Pan", "LWIR"}),
        ("Altum-PT", {"6": "Panchro", "7": "LWIR"}, "6 7", "4", {"NIR"}),
    ],
)
def test_the_bands_of_an_altum_are_missing_as_those_of_other_cameras(
    tmp_path: Path, model: str, others: Mapping[str, str], without_tags: str, lost: str, expected: set[str]
) -> None:
    """With any name of the panchromatic and the thermal band, and with files that have lost their tags."""
    for part, band in (ALTUM | dict(others)).items():
        nm = {} if part in "12345" else {(NAMESPACE, "CentralWavelength"): ("11000" if part == "7" else "634",)}
        values = tagged(MICASENSE, CaptureId="id") | {(NAMESPACE, "BandName"): (band,)} | nm
        first = {271: text("MicaSense"), 272: text(model), 700: byte_string(packet(values, "attributes"))}
        if part not in lost.split():
            write_file(tmp_path / f"IMG_0001_{part}.tif", {} if part in without_tags.split() else first)
    assert [set(names) for names in missing(tmp_path)] == [expected]


@pytest.mark.parametrize(
    "name", ["{capture}_{band}.tif", "{band}/{capture}.tif", "{band}{capture}.tif", "{capture}; {band}.tif"]
)
def test_an_unreadable_file_is_known_by_its_name(tmp_path: Path, name: str) -> None:
    for capture in ("0011", "0012", "0013"):
        for band in ("red", "green", "nir"):
            write_band(tmp_path / name.format(capture=capture, band=band), np.ones((1, 48, 64), np.uint16))
    lost = tmp_path / name.format(capture="0012", band="nir")
    lost.write_text("no image")
    (damaged,) = (c for c in discover(tmp_path).captures if c.missing_bands)
    assert damaged.missing_bands == ("nir",)
    reason = damaged.unreadable_bands["nir"]
    assert reason == (f"{lost.name}: is not a TIFF, JPEG or PNG", "copy it from the card again")


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
    wavelengths_nm = {b.name: b.wavelength_nm for b in result.captures[0].bands}
    if used is None:
        with pytest.raises(InputError, match="needs a red band"):
            bands_for(index_named("ndvi"), wavelengths_nm)
    else:
        assert bands_for(index_named("ndvi"), wavelengths_nm) == used


@pytest.mark.parametrize(
    ("names", "first", "second"),
    [
        ("f_red f_nir red/f_red nir/f_nir", "f_red.tif", "red/f_red.tif"),
        ("f_red red/f nir/f", "f_red.tif", "red/f.tif"),
        ("f_red red_f nir_f", "f_red.tif", "red_f.tif"),
        ("f_NIR f_red f-nir", "f-nir.tif", "f_NIR.tif"),
    ],
)
def test_two_files_of_one_band_of_a_capture_have_a_line(tmp_path: Path, names: str, first: str, second: str) -> None:
    for number, name in enumerate(names.split()):
        write_band(tmp_path / f"{name}.tif", np.full((1, 48, 64), number + 1, np.uint16))
    result = discover(tmp_path)
    assert len(result.captures) == 1
    assert not result.is_complete
    lines = [p.text for p in result.problems if p.text.startswith(f"{tmp_path / second}: ")]
    assert len(lines) == 1
    assert f"of one capture as {first} is; both are aligned" in lines[0].replace(f"{tmp_path}/", "")


def test_bands_of_one_name_in_the_halves_of_a_dual_camera_have_no_line(tmp_path: Path) -> None:
    write_rededge(tmp_path, 1, {1: ("Blue", 475), 2: GREEN, 6: ("Blue", 444), 7: ("Green", 531)})
    assert texts(tmp_path) == []


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


@pytest.mark.parametrize(
    ("file", "description", "expected"),
    [
        ("ms_crop_nir", "DJI_20251128093951_0003_MS_NIR", "NIR"),
        ("ms_crop_2", "DJI_20251128093951_0003_MS_RE", "RedEdge"),
        ("clip_b2", "IMG_180413_080658_0000_GRE", "Green"),
        ("clip_nir", "IMG_0007_4", "nir"),
        ("clip_red", "ortho crop", "red"),
        ("clip_red", "field_nir", "nir"),
        ("clip_red", "NIR", "NIR"),
        ("clip_2", "yield", "2"),
    ],
)
def test_a_description_that_is_a_file_s_name_gives_way_to_the_band_in_it(
    tmp_path: Path, file: str, description: str, expected: str
) -> None:
    write_band(tmp_path / f"{file}.tif", np.ones((8, 8), np.uint16))
    with rasterio.open(tmp_path / f"{file}.tif", "r+") as image:
        image.descriptions = (description,)
    (band,) = Generic().bands(tmp_path / f"{file}.tif", Tags(), probe(tmp_path / f"{file}.tif"))
    assert band.name == expected


def test_descriptions_of_layers_that_are_files_names_are_bands(tmp_path: Path) -> None:
    write_band(tmp_path / "a.tif", np.ones((3, 8, 8), np.uint16))
    for parts, expected in ((("MS_R", "MS_RE", "MS_NIR"), ["Red", "RedEdge", "NIR"]), (("a", "MS_R", "MS_R"), None)):
        names = [f"DJI_20251128093951_0003_{part}" for part in parts]
        with rasterio.open(tmp_path / "a.tif", "r+") as image:
            image.descriptions = tuple(names)
        bands = Generic().bands(tmp_path / "a.tif", Tags(), probe(tmp_path / "a.tif"))
        assert [b.name for b in bands] == (expected or names)


def test_tagged_files_in_a_folder_for_each_band_are_named_without_it(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["Mavic 3"])
    for path in list(tmp_path.glob("*.TIF")):
        folder = tmp_path / "flight" / path.stem.rpartition("_")[2]
        folder.mkdir(parents=True)
        path.rename(folder / path.name)
    (capture,) = discover(tmp_path).captures
    assert (capture.label, len(capture.bands)) == (f"flight/{VENDORS['Mavic 3'].capture}", 4)


@pytest.mark.parametrize("name", ["IMG_0007_2 (1)", "IMG_0007_2 - Copy", "IMG_0007_2 copy 2"])
def test_the_name_of_the_only_copy_is_read_without_its_end(tmp_path: Path, name: str) -> None:
    write_capture(tmp_path, VENDORS["RedEdge"], damage="missing")
    (tmp_path / "IMG_0007_2.tif").rename(tmp_path / f"{name}.tif")
    (capture,) = discover(tmp_path).captures
    assert (capture.name, {b.name for b in capture.bands}) == ("IMG_0007", {f"band_{k}" for k in range(1, 6)})


def test_a_changed_copy_without_tags_is_left_out_next_to_its_original(tmp_path: Path) -> None:
    for k, name in enumerate(("f_red", "f_nir", "f_red (1)")):
        write_band(tmp_path / f"{name}.tif", np.full((8, 8), k, np.uint16))
    assert [[b.name for b in c.bands] for c in discover(tmp_path).captures] == [["nir", "red"]]
    (text_,) = texts(tmp_path)
    assert "f_red (1).tif: is left out as a changed copy of f_red.tif" in text_


@pytest.mark.full
def test_long_tags_take_no_quadratic_time(tmp_path: Path) -> None:
    """Half a megabyte takes a fraction of a second; file systems limit the names of files."""
    stored = Band("", tmp_path / "a_red.tif", 1, 8, 8, "uint16")
    signal.alarm(60)
    try:
        for part in ("_", " ", "red", "(1)", " - copy", "_MS_", "1", "_MS_R1", "_180413"):
            long = part * ((1 << 19) // len(part))
            tags = Tags(xmp={(NAMESPACE, "BandName"): (long,)})
            Generic().bands(stored.path, tags, [replace(stored, name=long)])
            Generic().bands(stored.path, tags, [replace(stored, name=long)] * 2)
            assert role_of(long, 560.0) == "green"
    finally:
        signal.alarm(0)
