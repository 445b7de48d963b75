"""What every product gets from the registry: an entry in the sidecar, an asset, and a place among the files kept."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import agalign
from agalign.batch import capture_task as batch_capture
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.registry import PRODUCTS
from agalign.values.files import write_text

from ..conftest import raising, read_json, seeded, write_capture
from .conftest import change

ALL, PLAIN = seeded("identity", layout="both", error_map=True, stac=True), seeded("identity")
Align = Callable[..., agalign.CaptureReport]


class Histogram(Product):
    """A new product, as one module would have it."""

    kind = "histogram"
    suffix = ".histogram.json"

    def is_enabled(self, settings: agalign.WriteSettings) -> bool:
        return settings.error_map

    def write(self, context: ProductContext) -> list[WrittenFile]:
        path = context.paths.file(self.suffix)
        write_text(path, json.dumps(sorted(context.with_pixels)))
        return [WrittenFile(self.kind, path, StacAsset("histogram", "application/json", ("metadata",)))]


@pytest.fixture
def align(tmp_path: Path) -> Align:
    """Align a capture of two bands into tmp_path/out."""
    write_capture(tmp_path / "in", "green", "red")

    def run(settings: agalign.Settings = ALL, **options: bool) -> agalign.CaptureReport:
        options = agalign.RunOptions(**options)
        (report,) = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings, run=options)
        return report

    return run


@pytest.fixture
def with_histogram(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_capture, "PRODUCTS", (*PRODUCTS[:-1], Histogram(), PRODUCTS[-1]))


def test_the_sidecar_lists_every_file_with_its_checksum(align: Align, tmp_path: Path) -> None:
    pytest.importorskip("pystac")
    sidecar = align().sidecar
    kinds = "band band stack error_map picture preview stac_item"
    files = "f_green.tif f_red.tif f.tif f.error.tif f.png f.preview.jpg f.stac.json"
    assert [(p.kind, p.file) for p in sidecar.products] == list(zip(kinds.split(), files.split(), strict=True))
    for part in sidecar.products:
        data = (tmp_path / "out" / part.file).read_bytes()
        assert (part.bytes, part.sha256) == (len(data), hashlib.sha256(data).hexdigest())


@pytest.mark.usefixtures("with_histogram")
def test_a_new_product_is_listed_described_and_removed(align: Align, tmp_path: Path) -> None:
    pytest.importorskip("pystac")
    path = tmp_path / "out" / "f.histogram.json"
    sidecar = align().sidecar
    assert "histogram" in [p.kind for p in sidecar.products]
    item = read_json(tmp_path / "out" / "f.stac.json")
    assert item["assets"]["histogram"]["href"] == "f.histogram.json"
    assert path.is_file()
    align(PLAIN)
    assert not path.exists()


@pytest.mark.usefixtures("with_histogram")
def test_a_file_that_a_new_product_would_replace_is_protected(align: Align, tmp_path: Path) -> None:
    source = tmp_path / "in" / "f_green.tif"
    (capture,) = agalign.discover(tmp_path / "in").captures
    assert tmp_path / "out" / "f.histogram.json" in batch_capture.paths_written(capture, tmp_path / "out", ALL.write)
    with pytest.raises(agalign.ConfigurationError, match=r"f_green\.tif: is an image to be aligned"):
        agalign.align_capture(capture, tmp_path / "in", settings=ALL)
    assert source.is_file()


@pytest.mark.usefixtures("with_histogram")
def test_a_capture_is_kept_only_while_all_its_files_are_there(align: Align, tmp_path: Path) -> None:
    pytest.importorskip("pystac")
    paths = [tmp_path / "out" / part.file for part in align().sidecar.products]
    assert len(paths) == 8
    for path in paths:
        if path.suffix != ".json":
            path.write_bytes(bytes(path.stat().st_size))  # the size counts: reading the contents would take minutes
    assert align().state == "kept"
    for path in paths:
        os.truncate(path, path.stat().st_size - 1)
        assert align().state == "done", path
    paths[0].unlink()
    assert [align().state for _ in range(2)] == ["done", "kept"]


def test_files_of_an_earlier_sidecar_are_removed(align: Align, tmp_path: Path) -> None:
    """Also aligned rasters of a product that this version does not know."""
    align(PLAIN)
    sidecar, old = tmp_path / "out" / "f.json", tmp_path / "out" / "f.depth.tif"
    shutil.copy(tmp_path / "out" / "f.tif", old)
    of_old = {"kind": "depth", "file": old.name, "bytes": 1, "sha256": ""}
    change(sidecar, products=[*read_json(sidecar)["products"], of_old])
    assert align(PLAIN, overwrite=True).state == "done"
    assert not old.exists()


def test_a_required_product_that_fails_costs_the_capture(align: Align, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Histogram, "write", raising(agalign.OutputError("f.histogram.json: cannot be written")))
    monkeypatch.setattr(batch_capture, "PRODUCTS", (*PRODUCTS, Histogram()))
    report = align()
    assert (report.state, report.error) == ("error", "f.histogram.json: cannot be written")
    monkeypatch.setattr(Histogram, "is_required", False)
    report = align()
    assert (report.state, report.failed_products) == ("done", ("f.histogram.json: cannot be written",))
    assert report.result.not_written == ["histogram"]
    monkeypatch.setattr(batch_capture, "PRODUCTS", PRODUCTS)
    assert [align().state for _ in range(2)] == ["done", "kept"]


def test_products_are_checked_before_the_alignment(align: Align, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Histogram, "check", raising(agalign.InputError("f_green.tif: has no histogram")))
    monkeypatch.setattr(batch_capture, "PRODUCTS", (*PRODUCTS, Histogram()))
    monkeypatch.setattr(batch_capture, "align_capture_bands", raising(AssertionError("aligned in vain")))
    assert "has no histogram" in (align().error or "")
