"""What every product gets from the registry: an entry in the sidecar, and a place among the files kept."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import agalign
from agalign.batch import capture_task, render
from agalign.batch.earlier_results import outputs_exist
from agalign.batch.products import PRODUCTS
from agalign.host.files import write_text
from agalign.rasters.product import Product, ProductContext, WrittenFile
from agalign.values.capture import Capture

from ..conftest import raising, seeded, write_capture

ALL, PLAIN = seeded("identity", layout="both", error_map=True), seeded("identity")
Align = Callable[..., agalign.CaptureReport]


class Histogram(Product):
    """A new product, as one module would have it."""

    kind = "histogram"
    suffix = ".histogram.json"
    option = "error_map"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        path = context.paths.file(self.suffix)
        write_text(path, json.dumps(sorted(context.with_pixels)))
        return [WrittenFile(self.kind, path)]


@pytest.fixture
def align(tmp_path: Path) -> Align:
    """Align a capture of two bands into tmp_path/out."""
    write_capture(tmp_path / "in", "green", "red")

    def run(settings: agalign.Settings = ALL) -> agalign.CaptureReport:
        (report,) = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings)
        return report

    return run


@pytest.fixture
def with_histogram(monkeypatch: pytest.MonkeyPatch) -> None:
    use_products(monkeypatch, *PRODUCTS, Histogram())


def use_products(monkeypatch: pytest.MonkeyPatch, *products: Product) -> None:
    for module in (capture_task, render):
        monkeypatch.setattr(module, "PRODUCTS", products)


@pytest.mark.usefixtures("with_histogram")
def test_every_file_is_listed_with_its_checksum_and_written_again_or_removed(align: Align, tmp_path: Path) -> None:
    out, sidecar = tmp_path / "out", align().sidecar
    kinds = "band band stack error_map picture preview histogram"
    files = "f_green.tif f_red.tif f.tif f.error.tif f.png f.preview.jpg f.histogram.json"
    assert [(p.kind, p.file) for p in sidecar.products] == list(zip(kinds.split(), files.split(), strict=True))
    for part in sidecar.products:
        data = (out / part.file).read_bytes()
        assert (part.bytes, part.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    removed = align(PLAIN).removed
    kept = {*files.split()} - {"f_green.tif", "f_red.tif"}
    assert {p.name for p in out.glob("f[._]*")} == {"f.json", *kept}
    assert sorted((p.name, why) for p, why in removed) == [(f"f_{b}.tif", "--layout stack") for b in ("green", "red")]


@pytest.mark.usefixtures("align")
def test_an_image_is_not_replaced(tmp_path: Path) -> None:
    (capture,) = agalign.discover(tmp_path / "in").captures
    with pytest.raises(agalign.ConfigurationError, match=r"f_green\.tif: is an image to be aligned"):
        agalign.align_capture(capture, tmp_path / "in", settings=ALL)


@pytest.mark.usefixtures("with_histogram")
def test_a_capture_is_kept_only_while_all_its_files_are_there(align: Align) -> None:
    report = align()
    first, *others = (report.path.with_name(part.file) for part in report.result.files)
    assert len(others) == 6
    for path in (first, *others):
        data = path.read_bytes()
        path.write_bytes(data[:-1])
        assert not outputs_exist(report.path, report.result.files), path
        path.write_bytes(data)
    first.write_bytes(bytes(first.stat().st_size))
    assert [align().state for _ in range(2)] == ["done", "kept"]
    first.unlink()
    assert [align().state for _ in range(2)] == ["done", "kept"]


def test_a_required_product_that_fails_costs_the_capture(align: Align, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Histogram, "write", raising(agalign.OutputError("f.histogram.json: cannot be written")))
    use_products(monkeypatch, *PRODUCTS, Histogram())
    report = align()
    assert (report.state, report.error) == ("error", "f.histogram.json: cannot be written")
    monkeypatch.setattr(Histogram, "is_required", False)
    report = align()
    assert (report.state, report.failed_products) == ("done", ("f.histogram.json: cannot be written",))
    assert report.result.not_written == ["histogram"]
    use_products(monkeypatch, *PRODUCTS)
    assert [align().state for _ in range(2)] == ["done", "kept"]


def test_a_file_that_is_changed_while_it_is_read_is_not_kept(align: Align, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a card that is still being copied: the checksum would be that of the complete file."""
    now = capture_task.align_capture_bands

    def and_changed(capture: Capture, *rest: Any) -> Any:
        result = now(capture, *rest)
        path = capture.moving[0].path
        path.write_bytes(path.read_bytes() + b"\0")
        return result

    with monkeypatch.context() as patch:
        patch.setattr(capture_task, "align_capture_bands", and_changed)
        report = align()
    assert report.state == "error"
    assert (report.error or "").endswith(": was changed while it was read; run again")
    assert [align().state for _ in range(2)] == ["done", "kept"]


def test_products_are_checked_before_the_alignment(align: Align, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Histogram, "check", raising(agalign.InputError("f_green.tif: has no histogram")))
    use_products(monkeypatch, *PRODUCTS, Histogram())
    monkeypatch.setattr(capture_task, "align_capture_bands", raising(AssertionError("aligned in vain")))
    assert "has no histogram" in (align().error or "")
