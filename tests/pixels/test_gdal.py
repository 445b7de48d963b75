"""Names that rasterio or GDAL would read as addresses, as other files or as virtual paths are those of local files."""

import ast
import os
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

import agalign
from agalign.pixels import gdal
from agalign.pixels.gdal import gdal_name
from agalign.pixels.raster import probe, read_preview
from agalign.rasters.geotiff import LayerDescription, to_cog, write_on_grid
from agalign.values.image import OutputGrid

from ..conftest import raising, seeded, write_band, write_capture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
PACKAGE = Path(agalign.__file__).parent
ADDRESSES = (
    *("file:/elsewhere", "FILE:/elsewhere", "http:/localhost:9", "https:/localhost:9", "s3:/bucket", "gs:/bucket"),
    *("az:/bucket", "ftp:/localhost", "zip:/a.zip!", "zip+https:/localhost:9/a.zip!", "vsizip/a.zip", "vsicurl"),
    *("GTIFF_DIR:1:x", "GTIFF_RAW:x", "NETCDF:x", "HDF5:x", "WMS:http:/localhost:9", "VRT:x", "JPEG_SUBFILE:0,9,x"),
    *(
        "DERIVED_SUBDATASET:AMPLITUDE:x",
        "C:\\x",
        "\\\\host\\x",
        "-o",
        "a\nb",
        "?x#y",
        "[x",
        "%2e%2e",
        "e\u0301",
        "MEM:::",
    ),
)
"""Folders, relative to the working folder."""


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", raising(AssertionError("a socket is opened")))


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
@pytest.mark.parametrize("folder", ADDRESSES)
def test_a_file_below_a_folder_that_is_named_like_an_address_is_that_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for path, value in ((Path(folder, "x.tif"), 7), (Path("elsewhere/x.tif"), 9), (Path("x.tif"), 9)):
        write_band(tmp_path / path, np.full((8, 9), value, np.uint8))
    (band,) = probe(Path(folder, "x.tif"))
    assert (read_preview(band.path, 1, (0, 0, 9, 8), (9, 8)) == 7).all()
    before = set(tmp_path.rglob("*"))
    written = Path(folder, "y.tif")
    blocks = [(np.full((8, 9), 5, np.float32), 1, 0, 0)]
    write_on_grid(written, OutputGrid(0, 0, 9, 8), None, [LayerDescription("a")], blocks, finish=to_cog)
    assert set(tmp_path.rglob("*")) - before == {tmp_path / written}
    with rasterio.open(tmp_path / written) as dataset:
        assert (dataset.read(1) == 5).all()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
@pytest.mark.parametrize("name", ["GTIFF_DIR:1:x.tif", "file:x.tif", "-.tif", "a\nb.tif", "s3:x.TIF"])
def test_a_file_that_is_named_like_an_address_is_that_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for path, value in ((name, 7), ("x.tif", 9)):
        write_band(tmp_path / path, np.full((8, 9), value, np.uint8))
    for page in (0, 1):
        assert (read_preview(Path(name), 1, (0, 0, 9, 8), (9, 8), page) == 7).all()


def test_a_name_is_absolute_and_never_virtual(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert gdal_name(Path("s3:/x.tif")) == str(tmp_path / "s3:" / "x.tif")
    assert gdal_name(Path("x.tif"), 2) == f"GTIFF_DIR:2:{tmp_path / 'x.tif'}"
    if os.name != "nt":
        names = {name: gdal_name(Path(name)) for name in ("/vsizip/a.zip/x.tif", "//vsimem/x.tif", "//host/x.tif")}
        assert [*names.values()] == ["/./vsizip/a.zip/x.tif", "/./vsimem/x.tif", "/./host/x.tif"]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_a_run_reads_and_writes_below_its_folders_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bands of a capture are in a folder whose relative path is the address of others."""
    secret, images, out = tmp_path / "secret", tmp_path / "f1", tmp_path / "out"
    write_capture(secret, "green", "nir", size_px=(96, 80))
    write_capture(images / f"file:{secret}", "green", "nir", size_px=(120, 100))
    before = {path: path.stat().st_mtime_ns for path in secret.iterdir()}
    out.mkdir()
    for folder, start, target in (("f1", ".", "../out"), ("out", "../f1", ".")):
        monkeypatch.chdir(tmp_path / folder)
        (report,) = agalign.align_folder(
            start, target, settings=seeded(layout="both", format="cog", georeference=False)
        )
        assert report.result is not None, report.error
        reference = report.result.reference
        assert (reference.width, reference.height) == (120, 100)
        for path in out.rglob("*.*"):
            assert not path.name.startswith(".agalign")
    assert {path: path.stat().st_mtime_ns for path in secret.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f1", "out", "secret"]


def calls_of(name: str) -> set[str]:
    """The modules of the package that call a function of this name, and the first arguments of these calls."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == name:
                found.add(f"{path.relative_to(PACKAGE).as_posix()}: {ast.unparse(node.args[0])}")
    return found


def test_gdal_gets_the_name_of_a_file_in_one_place() -> None:
    imports: dict[str, Any] = {
        "rasterio.open": {"pixels/gdal.py: gdal_name(path, page)"},
        "rioxarray.open_rasterio": {"exports/dataset.py: gdal_name(path)"},
        "copy_dataset": {"rasters/geotiff.py: gdal_name(path)"},
    }
    assert {name: calls_of(name) for name in imports} == imports
    texts = [p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py") if p != Path(gdal.__file__)]
    assert not [text for text in texts if "rasterio import open" in text or "from osgeo" in text]
