"""Which files below a folder are images to align: links, and files that programs keep beside the images."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from agalign import align_folder
from agalign.cameras.discover import DiscoverOptions, FolderScan, discover
from agalign.cameras.image_search import image_files
from agalign.host.files import RUN_FILE

from ..conftest import Shared, seeded, write_band

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
BANDS = "f_green", "f_nir", "f_red"


def write(folder: Path, *names: str) -> None:
    rng = np.random.default_rng(len(str(folder)))  # folders of equal bytes are copies
    for name in names:
        write_band(folder / f"{name}.tif", rng.integers(1, 4000, (64, 80), dtype=np.uint16))


def write_picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)).save(path)


def labels(scan: FolderScan) -> list[str]:
    return [c.label for c in scan.captures]


def test_linked_folders_are_read_once(tmp_path: Path) -> None:
    write(tmp_path / "flight" / "0000SET", *BANDS)
    write(tmp_path / "card2" / "0001SET" / "000", *BANDS)
    (tmp_path / "flight" / "0001SET").symlink_to(tmp_path / "card2" / "0001SET")
    (tmp_path / "flight" / "again").symlink_to(tmp_path / "card2")
    scan = discover(tmp_path / "flight")
    assert labels(scan) == ["0000SET/f", "0001SET/000/f"]
    assert not scan.problems


@pytest.mark.parametrize("target", [".", "..", "real"])
def test_links_in_a_circle_end_and_the_real_folder_wins(tmp_path: Path, target: str) -> None:
    write(tmp_path / "in" / "real", *BANDS)
    (tmp_path / "in" / "a link").symlink_to(tmp_path / "in" / target)
    (tmp_path / "in" / "real" / "up").symlink_to(tmp_path / "in")
    assert labels(discover(tmp_path / "in")) == ["real/f"]


def test_a_linked_input_folder_and_linked_outputs(tmp_path: Path) -> None:
    write(tmp_path / "data", *BANDS)
    (tmp_path / "in").symlink_to(tmp_path / "data")
    assert labels(discover(tmp_path / "in")) == ["f"]
    (tmp_path / "out").mkdir()
    write(tmp_path / "out", *BANDS)
    (tmp_path / "data" / "out").symlink_to(tmp_path / "out")
    images, _ = image_files(tmp_path / "in", [tmp_path / "out"])
    assert [p.parent for p in images] == [tmp_path / "in"] * 3


@pytest.mark.parametrize(
    "place", ["{}_mask.tif", "{} mask.tif", "{}-Masks.tif", "masks/{}.tif", "mask/{}_mask.tif", "{}_thumb.tif"]
)
def test_masks_beside_the_images_are_one_line(tmp_path: Path, place: str) -> None:
    write(tmp_path, *BANDS)
    for name in BANDS:
        write(tmp_path, place.format(name).removesuffix(".tif"))
    scan = discover(tmp_path)
    assert [(c.label, [b.name for b in c.bands]) for c in scan.captures] == [("f", ["green", "nir", "red"])]
    (problem,) = scan.problems
    assert problem.text.endswith("masks and thumbnails beside the images are skipped, 3 files in all")
    assert problem.is_harmless


@pytest.mark.parametrize("folder", ["@eaDir/{}.tif", ".@__thumb", "thumbnails", "#recycle", "@Recycle", "_thumb"])
def test_small_copies_by_a_nas_are_no_photographs(tmp_path: Path, folder: str) -> None:
    write(tmp_path, *BANDS)
    for name in BANDS:
        write_picture(tmp_path / folder.format(name) / f"{name}_SYNOPHOTO_THUMB_M.jpg")
    scan = discover(tmp_path, DiscoverOptions(with_rgb=True))
    assert labels(scan) == ["f"]
    assert all(p.is_harmless for p in scan.problems)
    assert len(scan.problems) == (not folder.startswith("."))


@pytest.mark.parametrize("names", [("a_mask_green", "a_mask_red"), ("f_mask", "f_nir"), ("thumb_green", "thumb_red")])
def test_names_with_such_words_are_images_without_the_image_they_belong_to(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    write(tmp_path / "masks", *names)
    assert not [p.text for p in discover(tmp_path).problems if "masks and thumbnails" in p.text]


def own_results(flight: Path, shared: Shared) -> Path:
    """The output folder of a run of `flight` with stacks, single bands, quality flags, pictures and indices."""

    def fill(folder: Path) -> None:
        settings = seeded("rig", layout="both", qa=True, error_map=True, georeference=True, ground_elevation_m=0.0)
        align_folder(flight, folder, settings=settings)

    return shared("own results", fill)


@pytest.mark.parametrize("record", [True, False], ids=["with the run record", "without"])
def test_results_of_agalign_among_the_images_are_one_line(
    flight: Path, shared: Shared, tmp_path: Path, *, record: bool
) -> None:
    shutil.copytree(own_results(flight, shared), tmp_path / "in")
    images = sorted(path.name for path in (flight / "0000SET" / "000").glob("*.tif"))
    for path in (flight / "0000SET" / "000").glob("*.tif"):
        shutil.copy(path, tmp_path / "in" / f"raw_{path.name}")
    if not record:
        (tmp_path / "in" / RUN_FILE).unlink()
    scan = discover(tmp_path / "in", DiscoverOptions(with_rgb=True))
    assert sorted(b.path.name for c in scan.captures for b in c.bands) == [f"raw_{name}" for name in images]
    (problem,) = scan.problems
    number = sum(path.suffix in (".tif", ".png", ".jpg") for path in (tmp_path / "in").rglob("*")) - len(images)
    assert problem.text.endswith(f"results of agalign among the images are skipped, {number} files in all")
    assert problem.is_harmless


def test_output_folders_below_the_input_are_one_line(flight: Path, shared: Shared, tmp_path: Path) -> None:
    shutil.copytree(flight, tmp_path / "in")
    for name in ("a", "b"):
        shutil.copytree(own_results(flight, shared), tmp_path / "in" / name)
    scan = discover(tmp_path / "in")
    assert len(scan.captures) == 2
    assert [p.text for p in scan.problems] == [
        f"{tmp_path / 'in' / 'a'}: output folders of earlier runs are skipped, 2 folders in all"
    ]
    scan = discover(tmp_path / "in", DiscoverOptions(skip=(tmp_path / "in" / "a", tmp_path / "in" / "b")))
    assert not scan.problems


def test_an_image_whose_tags_name_the_program_elsewhere_is_an_image(tmp_path: Path) -> None:
    write(tmp_path, *BANDS)
    with rasterio.open(tmp_path / "f_nir.tif", "r+") as dataset:
        dataset.update_tags(TIFFTAG_SOFTWARE="Pix4D", TIFFTAG_IMAGEDESCRIPTION="for agalign")
    assert len(discover(tmp_path).captures[0].bands) == len(BANDS)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
@pytest.mark.parametrize("name", ["C:\\f", "C:f", "\\\\host\\share\\f"])
def test_a_file_whose_name_is_a_path_on_windows_is_named(tmp_path: Path, name: str) -> None:
    write(tmp_path, *BANDS, *(f"{name}_{band}" for band in ("green", "nir")))
    scan = discover(tmp_path)
    assert labels(scan) == ["f"]
    texts = [
        f"{tmp_path / name}_{band}.tif: its name is an absolute path on Windows; rename it" for band in ("green", "nir")
    ]
    assert [p.text for p in scan.problems] == texts
