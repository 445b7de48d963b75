"""Captures of a folder: which files belong together, and what is missing or unusable."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from pydantic import ValidationError

from agalign.cameras.discover import DiscoverOptions, discover
from agalign.cameras.generic import Generic
from agalign.cameras.grouping import with_missing_bands, with_unique_band_names
from agalign.cameras.metadata import read_tags
from agalign.cameras.tiff_directory import EXIF, add_directories, rational, read_directories, text
from agalign.errors import InputError, NoSuchBandError
from agalign.flight.groups import camera_overviews
from agalign.host.files import PAGE_STARTS, REPORT_FILE, SUMMARY_FILE
from agalign.values.capture import Band, CameraIdentity, Capture, Position

from ..conftest import write_band

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def write(path: Path, bands: int = 1) -> None:
    write_band(path, np.random.default_rng(0).integers(1, 4000, (bands, 64, 80), dtype=np.uint16))


def write_picture(path: Path, channels: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    grey = np.random.default_rng(0).integers(1, 255, (64, 80), dtype=np.uint8)
    Image.fromarray(grey if channels == 1 else np.stack([grey] * channels, axis=-1)).save(path)


def write_all(folder: Path, *names: str) -> Path:
    """Write a picture for each name with a suffix, and a TIFF file of one band for each other name."""
    for name in names:
        if "." in name:
            write_picture(folder / name, 3 if "photo" in name else 1)
        else:
            write(folder / f"{name}.tif")
    return folder


def found(folder: Path, **options: object) -> dict[str, list[str]]:
    """The names of the bands by the label of their capture."""
    return {c.label: [b.name for b in c.bands] for c in discover(folder, DiscoverOptions(**options)).captures}


@pytest.fixture
def images(flight: Path, tmp_path: Path) -> Path:
    """A copy of the images of the synthetic flight, in a folder of its own."""
    return shutil.copytree(flight / "0000SET" / "000", tmp_path / "in")


def test_a_micasense_flight(flight: Path) -> None:
    result, names = discover(flight), ["Blue", "Green", "Red", "NIR", "Red edge"]
    assert found(flight) == {"0000SET/000/IMG_0001": names, "0000SET/000/IMG_0002": names}
    assert (result.problems, result.eight_bit) == ((), ())
    first = result.captures[0]
    assert first.reference.name == "Green"
    assert first.capture_id == "synthetic00000000001"
    assert all(b.lens is not None and b.to_rig is not None for b in first.bands)
    without = discover(flight, DiscoverOptions(ignore_metadata=True))
    assert len(without.captures) == 2
    assert all(b.lens is None and b.to_rig is None for c in without.captures for b in c.bands)


COPIES = (
    *("{} - Copy", "{} - Copy (2)", "{} - Kopie", "{} \N{EN DASH} copie", "{} - コピー", "{} copy", "{} copy 2"),
    *("{} (1)", "{}(1)", "{} (copy)", "Copy of {}", "Kopie von {}", "{} 2"),
)
"""Names of copies by Windows, macOS, browsers and others."""


def test_copies_of_files_are_left_out_with_a_line(images: Path) -> None:
    """Of files with a capture id, of those without tags, of multiband files, of all files of a capture, and one with a
    name that does not show it.
    """
    write_all(images, "plot_red", "plot_nir")
    write(images / "field.tif", bands=3)
    before, originals = found(images), ("IMG_0001_2", "plot_red", "field")
    copies = {f"{name.format(original)}.tif": f"{original}.tif" for original in originals for name in COPIES}
    copies |= {f"{path.stem} - Copy.tif": path.name for path in images.glob("IMG_0001_*")}
    copies["backup_of_nir_19.tif"] = "IMG_0002_4.tif"
    for copy, original in copies.items():
        shutil.copy(images / original, images / copy)
    result = discover(images)
    assert found(images) == before
    assert {p.path.name: p.text.rpartition(" ")[2] for p in result.problems} == copies
    assert all("left out, because it is a copy of" in p.text for p in result.problems)
    assert result.is_complete


def test_a_changed_copy_is_left_out_with_another_line(images: Path) -> None:
    before, copy = found(images), images / "IMG_0001_2 - Copy.tif"
    copy.write_bytes((images / "IMG_0001_2.tif").read_bytes() + b"more")
    result = discover(images)
    assert found(images) == before
    (problem,) = result.problems
    assert problem.text.startswith(f"{copy}: is left out as a changed copy of IMG_0001_2.tif: same band and capture")
    assert not result.is_complete
    # Under another name it is an image of another flight: real cameras never repeat a capture id.
    copy.rename(images / "IMG_0009_2.tif")
    assert sum(map(len, found(images).values())) == sum(map(len, before.values())) + 1


def test_a_copy_is_used_where_its_original_is_missing_or_unreadable(images: Path) -> None:
    before = found(images)
    (images / "IMG_0001_2.tif").rename(images / "IMG_0001_2 - Copy.tif")
    shutil.copy(images / "IMG_0002_2.tif", images / "IMG_0002_2 (1).tif")
    (images / "IMG_0002_2.tif").write_bytes(b"II*\0 cut short")
    assert found(images) == before


@pytest.mark.parametrize("name", ["000 - Copy", "Copy of 000", "backup/card 2/000"])
def test_a_folder_copied_next_to_itself_counts_once(flight: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(flight, tmp_path / "in")
    first = write_all(tmp_path / "in" / "0000SET" / "000", "plot_red", "plot_nir", "field")
    write(first / "ortho.tif", bands=3)
    before, copy = found(tmp_path / "in"), tmp_path / "in" / "0000SET" / name
    shutil.copytree(first, copy)
    (first / "IMG_0001_4.tif").unlink()  # the copy has it
    result = discover(tmp_path / "in")
    assert {c.label: [b.name for b in c.bands] for c in result.captures} == before
    (problem,) = [p for p in result.problems if "field" not in p.text]
    text = f"{copy}: left out 4 captures that {first} has, except for 1 file that it lacks: IMG_0001_4.tif"
    assert (problem.text, problem.is_harmless) == (text, True)
    with (copy / "IMG_0002_3.tif").open("ab") as file:
        file.write(b"\0")
    (problem,) = [p for p in discover(tmp_path / "in").problems if "field" not in p.text]
    reason = "1 file differs in name or size: IMG_0002_3.tif; keep one of the folders"
    assert (problem.text, problem.is_harmless) == (f"{text}; {reason}", False)
    write(copy / "ortho.tif", bands=4)
    assert len(discover(tmp_path / "in").captures) == len(before) + 1


def test_of_equal_files_the_one_among_its_siblings_is_kept(images: Path) -> None:
    before = found(images)
    shutil.copy(images / "IMG_0002_4.tif", images / "IMG_0001_4.tif")
    result = discover(images)
    first, second = result.captures
    assert (first.name, first.missing_bands, second.name) == ("IMG_0001", ("NIR",), "IMG_0002")
    assert [b.name for b in second.bands] == before["IMG_0002"]
    (problem,) = result.problems
    assert "IMG_0001_4.tif: is left out, because it is a copy of IMG_0002_4.tif" in problem.text


def test_the_overview_of_a_camera_is_that_of_most_captures() -> None:
    """The first one lacks green, and has a band that the others lack."""
    first = replace(capture("first", "RM01", ("Blue", "Red", "Blue-2")), reference_index=0)
    bands = tuple(replace(b, width_px=32) for b in first.bands)
    others = [replace(capture(f"c{k}", "RM01", RED), reference_index=1) for k in range(3)]
    (overview,) = camera_overviews([replace(first, bands=bands), *others])
    assert (set(overview.bands), overview.size_px) == (set(RED), (64, 48))


EDGE_AND_GREEN = ["Red edge", "Green"]


@pytest.mark.parametrize(
    ("names", "pattern", "expected"),
    [
        ("north_red north_nir north_green", None, {"north": ["green", "nir", "red"]}),
        ("north_red north_nir south_red south_nir", None, {"north": ["nir", "red"], "south": ["nir", "red"]}),
        ("I_1_10 I_1_1 I_1_2", None, {"I_1": ["1", "2", "10"]}),
        ("f-3_RE f-3_840nm f-3_b3 f-3Green f-3_red_edge", None, {"f-3": ["840nm", "b3", "RE", "red_edge", "Green"]}),
        ("été_nir été_red", None, {"été": ["nir", "red"]}),
        # Files of other names and equal bytes are no copies: two sensors that are covered record the same.
        ("I_1_1 I_1_10 f_red f_red_edge", None, {"I_1": ["1", "10"], "f": ["red", "red_edge"]}),
        ("plot_7/red plot_7/nir", None, {"plot_7/plot_7": ["nir", "red"]}),
        # A folder for each band, with the same names or with the band in each name.
        ("nir/f7 red/f7 nir/f9 red/f9", None, {"f7": ["nir", "red"], "f9": ["nir", "red"]}),
        ("a/R/1 a/G/1 a/MS_NIR/1 a/RE/1", None, {"a/1": ["G", "NIR", "R", "RE"]}),
        ("550nm/i_01 840nm/i_01 550nm/i_02", None, {"i_01": ["550nm", "840nm"]}),
        ("green/f_1_GRE nir/f_1_NIR", None, {"f_1": ["GRE", "NIR"]}),
        ("nir/f_red nir/f_green red/f_red red/f_blue", None, {"nir/f": ["green", "red"], "red/f": ["blue", "red"]}),
        ("nir/f7 red/f7", "{band}/{capture}.tif", {"f7": ["nir", "red"]}),
        ("d1/a/7 d1/b/7 d2/a/8 d2/b/8", "{band}/{capture}.tif", {"d1/7": ["a", "b"], "d2/8": ["a", "b"]}),
        # The band at the beginning of each name.
        ("GRN01 NIR01 GRN11 NIR11", None, {"01": ["GRN", "NIR"], "11": ["GRN", "NIR"]}),
        ("Red_IMG_7 Green_IMG_7", None, {"IMG_7": ["Green", "Red"]}),
        ("r-1 g-1 nir-1 r-2 g-2 nir-2", None, {"1": ["g", "nir", "r"], "2": ["g", "nir", "r"]}),
        ("blue red1 red2 nir1", None, {"": ["blue", "nir1", "red1", "red2"]}),
        ("GRN01 NIR01 GRN11 NIR11", "{band}{capture}.tif", {"01": ["GRN", "NIR"], "11": ["GRN", "NIR"]}),
        ("CHA01 CHB01 CHA11", "{band}{capture}.tif", {"01": ["CHA", "CHB"]}),
        ("01RedEdge 01NIR 11NIR 11red", "{capture}{band}.tif", {"01": ["NIR", "RedEdge"], "11": ["NIR", "red"]}),
        # The suffix that a browser adds is ignored; the unit belongs to the wavelength.
        ("f_red f_green#(1) f_nir#-#Copy", None, {"f": ["green", "nir", "red"]}),
        ("c_0475_nm c_0560_nm c_842-nm", None, {"c": ["0475_nm", "0560_nm", "842-nm"]}),
        # A camera's own names, without tags.
        ("DJI_1_MS_R_clip DJI_1_MS_NIR_clip", None, {"DJI_1_clip": ["NIR", "Red"]}),
        ("IMG_180413_080658_0000_REG IMG_180413_080658_0000_GRE", None, {"IMG_180413_080658_0000": EDGE_AND_GREEN}),
        ("I_7_1 I_7_2 f_red_edge f_red", "{capture}_{band}.tif", {"I_7": ["1", "2"], "f": ["red", "red_edge"]}),
        ("A-of-7 B-of-7 A-of-8 B-of-8", "{band}-of-{capture}.tif", {"7": ["A", "B"], "8": ["A", "B"]}),
        ("a_1.png a_2.png", "{capture}_{band}.png", {"a": ["1", "2"]}),
        # Previews are ignored, but for a picture of a band without a TIFF.
        ("a_red a_nir a_red.jpg a_nir.jpg m_red.png x.png photo_1.jpg photo_2.jpg", None, {"a": ["nir", "red"]}),
        ("a_red a_green a_red.jpg a_nir.png", None, {"a": ["green", "nir", "red"]}),
        ("a_red a_nir b_red.png b_nir.jpg", None, {"a": ["nir", "red"], "b": ["nir", "red"]}),
    ],
)
def test_captures_by_the_names_of_files(
    tmp_path: Path, names: str, pattern: str | None, expected: dict[str, list[str]]
) -> None:
    write_all(tmp_path, *(name.replace("#", " ") for name in names.split()))
    result = {label: sorted(bands) for label, bands in found(tmp_path, pattern=pattern).items()}
    assert result == {label or tmp_path.name: sorted(bands) for label, bands in expected.items()}
    problems = discover(tmp_path, DiscoverOptions(pattern=pattern)).problems
    assert [p.path.name for p in problems] == ["i_02.tif"] * ("550nm/i_02" in names) + ["CHA11.tif"] * (
        "CHA11" in names
    )


def test_a_band_without_tags_joins_the_capture_of_its_name(images: Path) -> None:
    """Editing a file often removes its tags: the others of the capture still have theirs."""
    result = discover(write_all(images, "IMG_0001_1", "IMG_0009_1"))
    first = result.captures[0]
    assert [(c.name, len(c.bands)) for c in result.captures] == [("IMG_0001", 5), ("IMG_0002", 5)]
    assert [b.name for b in first.bands] == ["band_1", "Green", "Red", "NIR", "Red edge"]
    assert (first.camera.make, first.reference.name) == ("MicaSense", "Green")
    assert first.bands[0].lens is None
    assert [p.path.name for p in result.problems] == ["IMG_0009_1.tif"]


def test_the_capture_has_the_tags_of_the_only_file_that_has_some(flight: Path, tmp_path: Path) -> None:
    shutil.copy(flight / "0000SET" / "000" / "IMG_0001_4.tif", tmp_path)
    write(tmp_path / "IMG_0001_1.tif")
    (result,) = discover(tmp_path).captures
    assert (result.name, [b.name for b in result.bands]) == ("IMG_0001", ["band_1", "NIR"])
    assert (result.camera.make, result.capture_id) == ("MicaSense", "synthetic00000000001")


@pytest.mark.parametrize(("suffix", "channels"), [("jpg", 1), ("JPEG", 3), ("png", 1), ("png", 3)])
def test_pictures_one_a_band_by_name_are_a_capture(tmp_path: Path, suffix: str, channels: int) -> None:
    for plot in (1, 2):
        for band in ("red", "nir", "550nm"):
            write_picture(tmp_path / f"plot {plot} {band}.{suffix}", channels)
        write_picture(tmp_path / f"plot {plot} rgb.{suffix}", 3)
    result = discover(tmp_path)
    assert found(tmp_path) == {"plot 1": ["550nm", "nir", "red"], "plot 2": ["550nm", "nir", "red"]}
    assert result.captures[0].reference.wavelength_nm == 550
    assert result.eight_bit == result.captures
    assert result.problems == ()


def test_images_that_cannot_be_read_are_problems_but_for_photographs(tmp_path: Path) -> None:
    write_all(tmp_path, "a_red", "a_nir")
    for name in ("b_red.png", "c_nir.jpg", "d_red.jp2", "photo_1.jpg", "chart.png"):
        (tmp_path / name).write_bytes(b"damaged")
    problems = {p.path.name: p.text for p in discover(tmp_path).problems}
    assert sorted(problems) == ["b_red.png", "c_nir.jpg", "d_red.jp2"]
    assert "convert it to TIFF" in problems["d_red.jp2"]


@pytest.mark.parametrize("name", ["lonely_red.tif", "lonely_red.png"])
def test_a_band_without_companions_is_a_problem_not_a_capture(tmp_path: Path, name: str) -> None:
    (write if name.endswith("tif") else write_picture)(tmp_path / name)
    result = discover(tmp_path)
    assert result.captures == ()
    (problem,) = result.problems
    assert problem.text.startswith(f"{tmp_path / name}: ")
    assert "--pattern" in problem.text


def test_two_captures_of_one_name_do_not_overwrite_each_other(tmp_path: Path) -> None:
    write(tmp_path / "field.tif", bands=3)
    assert list(found(write_all(tmp_path, "field_red", "field_nir"))) == ["field", "field-2"]


def test_reference_by_name(flight: Path) -> None:
    assert discover(flight, DiscoverOptions(reference="nir")).captures[0].reference.name == "NIR"
    with pytest.raises(NoSuchBandError, match=r"IMG_0001_1\.tif: no band 'swir', as --reference asks; choose from"):
        discover(flight, DiscoverOptions(reference="swir"))


def test_chosen_bands_of_unreadable_files_are_not_called_missing(tmp_path: Path) -> None:
    for name in ("a_red.tif", "a_nir.tif"):
        (tmp_path / name).write_bytes(b"damaged")
    assert len(discover(tmp_path, DiscoverOptions(bands=("red", "nir"))).problems) == 2


def test_output_folders_are_not_looked_into(images: Path) -> None:
    write(images / "out" / "x.tif", bands=2)
    assert "out/x" in found(images)
    assert "out/x" not in found(images, skip=(images / "out",))
    for name in (SUMMARY_FILE, REPORT_FILE):
        (images / "out" / name).write_text("pages of another program")
    assert "out/x" in found(images)
    for name in (SUMMARY_FILE, REPORT_FILE):
        (images / "out" / name).write_bytes(PAGE_STARTS[name])
    assert "out/x" not in found(images)


def test_where_there_is_nothing(tmp_path: Path) -> None:
    write(tmp_path / "below" / "a.tif")
    (tmp_path / "empty").mkdir()
    for name, message in (("empty", r"no \.tif"), ("nowhere", "does not exist"), ("below/a.tif", "is a file")):
        with pytest.raises(InputError, match=message):
            discover(tmp_path / name)


def test_a_pattern_that_gives_two_files_for_a_band_is_reported(tmp_path: Path) -> None:
    write_all(tmp_path, "a_1_red", "a_2_red", "a_1_nir")
    result = discover(tmp_path, DiscoverOptions(pattern="{capture}_*_{band}.tif", reference="RED-2"))
    (problem,) = result.problems
    assert "a_2_red.tif: is band 'red' of one capture with a_1_red.tif" in problem.text
    assert result.captures[0].reference.path.name == "a_2_red.tif"


def test_the_day_of_a_date_is_no_band(tmp_path: Path) -> None:
    write_all(tmp_path, "field_2023-05-12", "field_2023-06-03")
    result = discover(tmp_path)
    assert not result.captures
    assert ["no companion" in p.text for p in result.problems] == [True, True]
    write_all(tmp_path, "field_2023-05-12_red", "field_2023-05-12_nir")
    assert list(found(tmp_path)) == ["field_2023-05-12"]


def test_digits_that_are_not_numbers_and_a_number_alone_are_names(tmp_path: Path) -> None:
    assert len(found(write_all(tmp_path / "digits", "1²2_red", "1²2_nir", "10_red", "10_nir"))) == 2
    for name in ("_1.tif", "_2.tif"):
        tifffile.imwrite(tmp_path / name, np.ones((8, 8), np.uint16), extratags=[(271, 2, 0, "MicaSense", True)])
    assert "capture" in found(tmp_path)  # a name that begins with a dot or is empty would be hidden


def test_a_capture_has_the_position_of_its_reference(images: Path) -> None:
    path, exif = images / "IMG_0001_1.tif", read_directories(images / "IMG_0001_1.tif")[EXIF]  # blue, the first file
    for place, expected in (((91, 20), None), ((10, 181), None), ((10, 20), Position(-10, -20))):
        latitude, longitude = (rational(degrees, 0, 0) for degrees in place)
        impossible_m = rational(4e9)
        elsewhere = {1: text("S"), 2: latitude, 3: text("W"), 4: longitude, 6: impossible_m}
        add_directories(path, {}, exif, elsewhere)
        assert read_tags(path).position == expected
    capture = discover(images).captures[0]
    assert capture.reference.name == "Green"
    assert capture.position.latitude == pytest.approx(52, abs=0.01)


def write_fields(folder: Path, count: int) -> None:
    write_all(folder, *(f"f{number}_{band}" for number in range(count) for band in ("red", "nir")))


def test_names_are_looked_at_a_few_times_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count, asked = 40, []
    write_fields(tmp_path, count)
    real = Generic.capture_name
    monkeypatch.setattr(Generic, "capture_name", lambda self, path: asked.append(path) or real(self, path))
    assert len(discover(tmp_path).captures) == count
    assert len(asked) <= 3 * 2 * count


@pytest.mark.slow
def test_several_processes_find_what_one_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agalign.cameras.read_files._MIN_FILES_FOR_PROCESSES", 20)
    write_fields(tmp_path, 12)
    (tmp_path / "f3_nir.tif").write_bytes(b"no image")
    one, several = (discover(tmp_path, DiscoverOptions(jobs=jobs)) for jobs in (1, 2))
    assert one.captures == several.captures
    assert [p.text for p in one.problems] == [p.text for p in several.problems]


@pytest.mark.parametrize("jobs", [-3, 10**9])
def test_numbers_of_processes_have_the_range_of_other_options(jobs: int) -> None:
    with pytest.raises(ValidationError, match=r"jobs"):
        DiscoverOptions(jobs=jobs)


@pytest.mark.slow
def test_no_number_of_processes_is_one_per_core(tmp_path: Path) -> None:
    write_fields(tmp_path, 1)
    assert len(discover(tmp_path, DiscoverOptions(jobs=0, timeout_s=60)).captures) == 1


@pytest.mark.full
@pytest.mark.parametrize(
    ("action", "what"),
    [("time.sleep(60)", "reading it took over 2 s (--timeout)"), ("os._exit(9)", "reading it killed the process")],
)
def test_only_the_file_that_takes_too_long_or_kills_its_reader_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action: str, what: str
) -> None:
    folder, modules = tmp_path / "flight", tmp_path / "modules"
    write_all(folder, *(f"f{number}_{band}" for number in range(2) for band in ("green", "red", "nir")))
    modules.mkdir()
    # A process imports it at its start.
    (modules / "sitecustomize.py").write_text(
        "import io, os, time\n"
        "now = io.open\n"
        "def late(path, *given, **named):\n"
        f"    str(path).endswith('f1_nir.tif') and {action}\n"
        "    return now(path, *given, **named)\n"
        "io.open = late\n"
    )
    monkeypatch.syspath_prepend(str(modules))
    found = discover(folder, DiscoverOptions(timeout_s=2))
    assert [p.text for p in found.problems] == [f"{folder / 'f1_nir.tif'}: {what}; take it out of the folder"]
    assert [c.missing_bands for c in found.captures] == [(), ("nir",)]
    assert found.captures[1].unreadable_bands["nir"].what.startswith(f"f1_nir.tif: {what}")


@pytest.mark.parametrize(
    ("names", "expected"),
    [("a a a", "a a-2 a-3"), ("a a a-2", "a a-3 a-2"), ("a a-2 a", "a a-2 a-3"), ("a-2 a a a-2", "a-2 a a-3 a-2-2")],
)
def test_repeated_band_names_are_numbered_past_names_in_use(names: str, expected: str) -> None:
    bands = [Band(name, Path("x.tif"), 1, 8, 8, "uint16") for name in names.split()]
    assert [b.name for b in with_unique_band_names(bands)] == expected.split()


# ---- captures of one camera


RED, BLUE = ("Blue", "Green", "Red"), ("Blue-444", "Green-531")


def capture(name: str, serial: str, bands: tuple[str, ...], model: str = "RedEdge-M") -> Capture:
    files = tuple(Band(b, Path(f"{name}_{b}.tif"), 1, 64, 48, "uint16") for b in bands)
    return Capture(name, Path(), files, 0, CameraIdentity("MicaSense", model, serial))


def missing(*captures: Capture) -> dict[str, tuple[str, ...]]:
    return {c.name: c.missing_bands for c in with_missing_bands(captures)}


def test_two_cameras_of_one_model_lack_none_of_each_other_s_bands() -> None:
    dual = [capture(f"dual{k}", "RB01+RX02", RED + BLUE) for k in range(3)]
    assert missing(*dual, capture("panel", "RM01", RED)) == {"dual0": (), "dual1": (), "dual2": (), "panel": ()}


def test_a_dual_camera_that_lost_a_half_lacks_it_and_stays_the_same_camera() -> None:
    dual = [capture(f"dual{k}", "RB01+RX02", RED + BLUE) for k in range(3)]
    half = capture("half", "RX02", RED)
    assert missing(*dual, half)["half"] == BLUE
    assert with_missing_bands([half, *dual])[0].camera.serial == "RB01+RX02"
    # A half that served in two cameras belongs to neither for certain.
    other = capture("other", "RB07+RX02", RED + BLUE)
    assert with_missing_bands([half, *dual, other])[0].camera.serial == "RX02"


def test_a_capture_without_a_serial_number_is_of_the_only_camera_of_its_model() -> None:
    one = [capture(f"a{k}", "RX02", RED) for k in range(2)]
    assert missing(*one, capture("unknown", "", RED[:2]))["unknown"] == ("Red",)
    assert missing(*one, capture("b", "RX03", RED), capture("unknown", "", RED[:2]))["unknown"] == ()
    assert missing(capture("c", "", RED), capture("d", "", RED), capture("e", "", RED[:2]))["e"] == ("Red",)
    assert missing(*one, capture("altum", "", RED[:2], model="Altum"))["altum"] == ()
