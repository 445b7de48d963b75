"""What other programs take: band files under names of their own, and matrices that do in OpenCV what the run did."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import agalign
from agalign.cameras.metadata import read_tags
from agalign.cameras.pix4d import perspective_lens
from agalign.products.exports.programs import export
from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.values.choices import ExportProgram

from ..conftest import Shared, read_json, seeded
from .conftest import change, table_in

pytestmark = pytest.mark.slow


@pytest.fixture
def run(flight: Path, shared: Shared) -> Path:
    """The output of a run, by the tags alone to save time: its first capture counts as `ok`."""

    def fill(out: Path) -> None:
        agalign.align_folder(flight, out, settings=seeded("rig", layout="both"))
        first = find_sidecars(out)[0]
        first.write_text(first.read_text().replace('"status": "degraded"', '"status": "ok"', 1))

    return shared("export", fill)


@pytest.mark.parametrize("program", ["odm", "metashape", "pix4d"])
def test_band_files_are_linked_under_names_of_their_own(run: Path, tmp_path: Path, program: ExportProgram) -> None:
    report = export(run, tmp_path / "to", program)
    names = sorted(p.name for p in (tmp_path / "to" / "images").iterdir())
    assert names == [f"0000SET_000_IMG_0001_{k}.tif" for k in range(1, 6)]
    source = run / "0000SET" / "000" / "IMG_0001_4.tif"
    assert source.samefile(report.files[3])
    assert (report.captures, report.left_out) == (1, [("0000SET/000/IMG_0002", "its status is degraded")])
    assert (tmp_path / "to" / "README.txt").read_text().splitlines() == report.notes
    if program == "odm":
        assert "--skip-band-alignment --primary-band 'Green'" in report.notes[1]
        assert report.notes[1].endswith(" --texturing-skip-global-seam-leveling")
    copied = export(run, tmp_path / "copies", program, copy=True).files[3]
    assert not source.samefile(copied)
    assert copied.read_bytes() == source.read_bytes()


def test_matrices_for_the_notebooks_of_micasense(flight: Path, run: Path, tmp_path: Path) -> None:
    """Points of the mapping, undistorted by OpenCV as the notebooks undistort images."""
    export(run, tmp_path, "micasense")
    matrices = np.load(tmp_path / "0000SET_000_IMG_0001_warp_matrices.npy", allow_pickle=True)
    assert matrices.shape == (5, 3, 3)
    serial = read_tags(next(flight.rglob("IMG_0001_1.tif"))).serial
    np.testing.assert_array_equal(np.load(tmp_path / f"{serial}_warp_matrices_opencv.npy"), matrices)

    def straight(points: list[tuple[float, float]], file: str) -> np.ndarray:
        lens = perspective_lens(read_tags(next(flight.rglob(file))))
        coefficients = np.array(lens.distortion[:5])
        new, _ = cv2.getOptimalNewCameraMatrix(lens.matrix, coefficients, (480, 360), 1)
        raw = np.array(points, np.float64)[:, None]
        return cv2.undistortPoints(raw, lens.matrix, coefficients, P=new)[:, 0]

    sidecar = read_sidecar(find_sidecars(run)[0])
    for matrix, band in zip(matrices, sidecar.bands, strict=True):
        if band.grid is None:
            np.testing.assert_allclose(matrix, np.eye(3), atol=1e-9)
            continue
        reference = straight(band.grid.reference_px, sidecar.reference.file)
        mapped = cv2.perspectiveTransform(reference[:, None], matrix)[:, 0]
        assert np.abs(mapped - straight(band.grid.moving_px, band.file)).max() < 0.02
        assert np.abs(mapped - reference).max() > 1.0


def test_matrices_for_opencv_are_between_raw_pixels(run: Path, tmp_path: Path) -> None:
    report = export(run, tmp_path, "opencv")
    arrays = np.load(tmp_path / "0000SET_000_IMG_0001.npz")
    assert arrays["bands"].tolist() == ["Blue", "Green", "Red", "NIR", "Red edge"]
    for k in (0, 2, 3, 4):
        points = arrays[f"grid_reference_px_{k}"]
        mapped = cv2.perspectiveTransform(points[:, None], arrays["matrices"][k])[:, 0]
        error_px = np.linalg.norm(mapped - arrays[f"grid_moving_px_{k}"], axis=1).max()
        assert error_px == pytest.approx(arrays["max_error_px"][k], abs=1e-6)
        assert 0 < error_px < 2.0
    np.testing.assert_array_equal(arrays["matrices"][1], np.eye(3))
    assert [r["band"] for r in table_in(tmp_path / "matrices.csv")] == arrays["bands"].tolist()
    assert "Largest distance" in report.notes[-1]


def test_captures_that_cannot_be_exported_are_one_line(run: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    degraded, without_files = (Path(shutil.copytree(run, tmp_path / name)) for name in ("degraded", "without files"))
    for out, status in ((degraded, "degraded"), (without_files, "ok")):
        path = find_sidecars(out)[0]
        change(path, output=read_json(path)["output"] | {"band_files": []}, status=status)
    for out, target, program, error, message in (
        (tmp_path / "full", "to", "odm", agalign.InputError, "give the output folder of a run"),
        (run, "full", "odm", agalign.OutputError, "is not empty"),
        (run, "to", "micasense", agalign.InputError, r"IMG_0001_1\.tif: the image is not there; .* --source"),
        (without_files, "to", "pix4d", agalign.ConfigurationError, "--layout bands or both"),
        (degraded, "to", "pix4d", agalign.InputError, "no capture to export .*: its status is degraded"),
    ):
        with pytest.raises(error, match=message):
            export(out, tmp_path / target, program, source=tmp_path)
