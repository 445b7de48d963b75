"""What photogrammetry programs take: band files under names of their own."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import agalign
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.tiff_directory import XMP, add_directories, byte_string, text
from agalign.cli.terminal import ExitCode
from agalign.exports.programs import _without_radiometry, export
from agalign.records.sidecar_file import find_sidecars
from agalign.values.choices import ExportProgram

from ..cameras.test_vendors import packet
from ..conftest import Shared, read_json, seeded, write_band, write_signed
from ..program import agalign_here
from ..run_outputs import change, table_in

pytestmark = pytest.mark.slow


@pytest.fixture
def run(flight: Path, shared: Shared) -> Path:
    """The output of a run, by the tags alone to save time: its first capture counts as `ok`."""

    def fill(out: Path) -> None:
        agalign.align_folder(flight, out, settings=seeded("rig", layout="both"))
        first = find_sidecars(out)[0]
        write_signed(first, first.read_text().replace('"status": "degraded"', '"status": "ok"', 1))

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


def test_python_exports_and_computes_indices_as_the_commands(run: Path, aligned_flight: Path, tmp_path: Path) -> None:
    report = agalign.export(str(run), tmp_path / "to", "odm")
    assert (report.captures, len(report.files)) == (1, 5)
    reports = agalign.indices(aligned_flight, ["ndvi", "ndre"], formulas=["mine=N-R"], target=tmp_path / "by_python")
    assert {r.index for r in reports if r.path is not None} == {"ndvi", "ndre", "mine"}
    assert agalign_here("indices", aligned_flight, "-o", tmp_path / "by_command").returncode == ExitCode.OK
    for folder in ("by_python", "by_command"):
        (path, *_) = sorted((tmp_path / folder).rglob("*_ndvi.tif"))
        assert path.read_bytes() == next((tmp_path / "by_command").rglob(path.name)).read_bytes()
    of_formulas = agalign.indices(aligned_flight, formulas=["a=N/R"], target=tmp_path / "a")
    assert agalign_here("indices", aligned_flight, "--formula", "a=N/R", "-o", tmp_path / "b").returncode == ExitCode.OK
    assert {r.index for r in of_formulas} == {row["index"] for row in table_in(tmp_path / "b" / "indices.csv")} == {"a"}
    with pytest.raises(agalign.ConfigurationError, match="'ndvi' is given twice"):
        agalign.indices(run, ["ndvi", "NDVI"])


def test_numbers_that_may_be_reflectance_are_not_calibrated_again(tmp_path: Path) -> None:
    for factor, calibration in ((0.5, "none"), (6000.0, "camera")):
        write_band(tmp_path / "a.tif", np.full((64, 80), factor, np.float32))
        assert _without_radiometry([tmp_path / "a.tif"])["calibration"] == calibration


@pytest.mark.parametrize(
    ("make", "tags", "calibration"),
    [
        ("DJI", {"Irradiance": "5000"}, "camera+sun"),  # OpenDroneMap divides DJI's radiance by this tag
        ("MicaSense", {"Irradiance": "0.8"}, "camera"),
        ("MicaSense", {"HorizontalIrradiance": "80"}, "camera"),
        ("MicaSense", {"HorizontalIrradiance": "80", "IrradianceScaleToSIUnits": "0.01"}, "camera+sun"),
        ("MicaSense", {"BandName": "LWIR"}, "camera+sun"),
    ],
)
def test_odm_calibrates_by_the_irradiances_that_it_reads(
    make: str, tags: dict[str, str], calibration: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.tif"
    write_band(path, np.full((64, 80), 6000, np.uint16))
    xmp = packet({(NAMESPACE, name): (value,) for name, value in tags.items()}, "elements")
    add_directories(path, {271: text(make), XMP: byte_string(xmp)}, {}, {})
    assert _without_radiometry([path])["calibration"] == calibration


def test_captures_that_cannot_be_exported_are_one_line(run: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    names = "degraded", "without files", "without tags"
    degraded, without_files, without_tags = (Path(shutil.copytree(run, tmp_path / name)) for name in names)
    change(find_sidecars(without_tags)[0], options={"write": {"layout": "both", "format": "cog"}})
    for out, status in ((degraded, "degraded"), (without_files, "ok")):
        path = find_sidecars(out)[0]
        change(path, products=[part for part in read_json(path)["products"] if part["kind"] != "band"], status=status)
    for out, target, program, error, message in (
        (tmp_path / "full", "to", "odm", agalign.InputError, "give the output folder of a run"),
        (run, "full", "odm", agalign.OutputError, "is not empty"),
        (run, "/vsimem/x", "odm", agalign.OutputError, "is one of GDAL's virtual paths"),
        (without_files, "to", "pix4d", agalign.ConfigurationError, "--layout bands or both"),
        (without_tags, "to", "odm", agalign.ConfigurationError, "--format gtiff"),
        (degraded, "to", "pix4d", agalign.InputError, "no capture to export .*: its status is degraded"),
    ):
        with pytest.raises(error, match=message):
            export(out, tmp_path / target, program)
    assert not (tmp_path / "to").exists(), "an export that is refused leaves no folder"
