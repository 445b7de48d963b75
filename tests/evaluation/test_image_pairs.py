from pathlib import Path

import cv2
import numpy as np
import pytest

from agalign.errors import InputError, UnreadableFileError
from agalign.evaluation.image_pairs import find_pairs, read_image

from ..conftest import textured_image

H = np.array([[1.1, 0.02, 5.0], [-0.01, 0.9, -3.0], [1e-5, 2e-5, 1.0]])


def write_folder(folder: Path, images: list[str], homographies: list[str]) -> None:
    folder.mkdir()
    for name in images:
        (folder / name).touch()
    for name in homographies:
        np.savetxt(folder / name, 2 * H)


def test_hpatches_layout(tmp_path: Path) -> None:
    for name in ("i_sun", "v_wall"):
        write_folder(tmp_path / name, [f"{k}.ppm" for k in range(1, 7)], [f"H_1_{k}" for k in range(2, 7)])
    result = find_pairs(tmp_path)
    kinds = "easy", "easy", "hard", "hard", "tough"
    assert [p.group for p in result] == [f"{name}, {kind}" for name in ("illumination", "viewpoint") for kind in kinds]
    assert (result[-1].name, result[-1].moving.name) == ("v_wall 1-6", "6.ppm")
    np.testing.assert_allclose(result[0].fixed_to_moving, H)


def test_oxford_layout(tmp_path: Path) -> None:
    write_folder(tmp_path / "graf", ["img1.png", "img2.png"], ["H1to2p"])
    (pair,) = find_pairs(tmp_path)
    assert (pair.group, pair.fixed.name, pair.moving.name) == ("graf", "img1.png", "img2.png")


def test_csv(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "h.txt", H)
    numbers = " ".join(f"{v}" for v in H.ravel())
    table = tmp_path / "pairs.csv"
    table.write_text(
        f"fixed,moving,homography,group\na.png,b.png,h.txt,one\nc.png,d.png,{numbers},two\ne.png,f.png,,\n"
    )
    first, second, third = find_pairs(table)
    assert (first.name, first.group, first.fixed) == ("a b", "one", tmp_path / "a.png")
    np.testing.assert_allclose(first.fixed_to_moving, H)
    np.testing.assert_allclose(second.fixed_to_moving, H)
    assert third.fixed_to_moving is None
    assert third.group == "pairs"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", r"pairs\.csv: has no column 'fixed'"),
        ("fixed,moving,homography\na,b,1 2 3\n", r"pairs\.csv, line 2: a homography is nine numbers"),
        ("fixed,moving,homography\na,b,none.txt\n", r"none\.txt: cannot be read"),
        ("fixed,moving,homography\na,b,0 0 0 0 0 0 0 0 0\n", r"line 2: a homography is nine numbers"),
        ("fixed,moving\n", r"pairs\.csv: no pairs"),
    ],
)
def test_bad_tables_are_named(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "pairs.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=message):
        find_pairs(table)


def test_a_missing_image_and_a_missing_folder(tmp_path: Path) -> None:
    write_folder(tmp_path / "graf", [], ["H1to2p"])
    with pytest.raises(InputError, match="no such image"):
        find_pairs(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        find_pairs(tmp_path / "nowhere")
    with pytest.raises(UnreadableFileError, match=r"nothing\.png"):
        read_image(tmp_path / "nothing.png")


def test_images_are_red_first(tmp_path: Path) -> None:
    image = (textured_image(80, 60) * 30 + 128).clip(1, 254).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "blue_green_red.png"), np.dstack([image, image // 2, image // 3]))
    pixels = read_image(tmp_path / "blue_green_red.png").pixels
    np.testing.assert_array_equal(pixels, np.stack([image // 3, image // 2, image]))
