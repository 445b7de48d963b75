"""A flight between two captures of a panel, start to end."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from pydantic import ValidationError
from synthetic_flights.panel import make_flight_between_panels

import agalign
from agalign.batch import CaptureReport, RunOptions
from agalign.config import Settings, WriteSettings
from agalign.errors import SidecarError
from agalign.products.panels import PANELS_FILE, read_panels
from agalign.products.report import write_pages

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
SIZE = 640, 480
SUN = 1.0, 0.6


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The panel, two captures, and the panel again, while the sun goes down."""
    folder = tmp_path_factory.mktemp("between")
    make_flight_between_panels(folder, 2, SIZE, sun=SUN)
    return folder


@pytest.fixture(scope="module")
def by_panel(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[CaptureReport]]:
    out = tmp_path_factory.mktemp("out")
    return out, agalign.align_folder(flight, out, settings=Settings(write=WriteSettings(radiometry="panel")))


def planes(folder: Path, number: int) -> np.ndarray:
    with rasterio.open(folder / "0000SET" / "000" / f"IMG_{number:04d}.tif") as stack:
        return np.nanmedian(stack.read(), axis=(1, 2))


def test_reflectance_by_panel_is_the_truth_where_the_light_sensor_is_blind(
    flight: Path, by_panel: tuple[Path, list[CaptureReport]], tmp_path: Path
) -> None:
    out, reports = by_panel
    assert [r.state for r in reports] == ["panel", "panel", "done", "done"]
    agalign.align_folder(flight, tmp_path, settings=Settings(write=WriteSettings(radiometry="sun")))
    sun = np.linspace(*SUN, 4)
    for number in (2, 3):
        # What the light sensor takes for less reflectance is less light.
        ratio = planes(out, number) / planes(tmp_path, number)
        np.testing.assert_allclose(ratio * sun[number - 1], 1.0, atol=0.02)
    with rasterio.open(out / "0000SET" / "000" / "IMG_0002.tif") as stack:
        assert stack.tags()["RADIOMETRY"] == "reflectance"
        assert set(stack.units) == {"1"}


def test_panels_are_named_and_drawn_and_kept_out(by_panel: tuple[Path, list[CaptureReport]]) -> None:
    out, reports = by_panel
    folder = out / "0000SET" / "000"
    assert reports[0].panel is not None
    assert reports[0].panel.startswith(
        "calibration panel RP04-0000001-SY (reflectance 0.51; recognised by its QR code)"
    )
    assert reports[0].good
    assert not (folder / "IMG_0001.tif").exists()
    with Image.open(folder / "IMG_0001.panel.png") as picture:
        drawn = np.asarray(picture)
    assert ((drawn == (255, 64, 32)).all(axis=-1)).sum() > 5 * 50
    data = json.loads((out / PANELS_FILE).read_text())
    assert [p["capture"] for p in data["panels"]] == ["IMG_0001", "IMG_0004"]
    assert [b["albedo"] for p in data["panels"] for b in p["bands"]] == pytest.approx([0.51] * 10)
    table = csv.DictReader((out / "summary.csv").read_text().splitlines())
    rows = [r for r in table if r["status"] == "panel"]
    assert {(r["capture"], r["band"]) for r in rows} >= {("IMG_0001", "NIR"), ("IMG_0004", "Green")}
    page = write_pages(out, print).report.read_text()
    assert "Calibration panels" in page
    assert "IMG_0001.panel.png" in page


def test_the_picture_shows_both_sides_of_what_changed_its_unit(by_panel: tuple[Path, list[CaptureReport]]) -> None:
    with Image.open(by_panel[0] / "0000SET" / "000" / "IMG_0002.png") as picture:
        drawn = np.asarray(picture).astype(float)
    before, after = drawn[40:400, 20:460], drawn[40:400, 510:950]
    assert before.std() > 0.5 * after.std() > 10


def test_another_run_keeps_what_is_done_and_drops_the_panels_where_they_are_aligned(
    flight: Path, tmp_path: Path
) -> None:
    settings = Settings(seed={"only": True})  # type: ignore[arg-type]
    agalign.align_folder(flight, tmp_path, settings=settings)
    again = agalign.align_folder(flight, tmp_path, settings=settings)
    assert [r.state for r in again] == ["panel", "panel", "kept", "kept"]
    every = agalign.align_folder(flight, tmp_path, settings=settings, run=RunOptions(align_panels=True))
    assert {r.state for r in every} == {"done", "kept"}
    assert not (tmp_path / PANELS_FILE).exists()


def test_without_a_panel_none_is_made_up(flight: Path, tmp_path: Path) -> None:
    for path in (flight / "0000SET" / "000").glob("IMG_0002_*.tif"):
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / path.name).write_bytes(path.read_bytes())
    (report,) = agalign.align_folder(
        tmp_path / "in", tmp_path / "out", settings=Settings(write=WriteSettings(radiometry="panel"))
    )
    assert report.error is not None
    assert "--panel-albedo" in report.error


def test_a_file_that_is_none_of_ours_is_told(tmp_path: Path) -> None:
    assert read_panels(tmp_path) == []
    (tmp_path / PANELS_FILE).write_text('{"schema": "agalign-panels/1"')
    with pytest.raises(SidecarError, match="run again"):
        read_panels(tmp_path)


@pytest.mark.parametrize("albedo", [0.0, -0.5, 1.01, float("nan")])
def test_a_panel_reflects_between_nothing_and_all(albedo: float) -> None:
    assert WriteSettings(panel_albedo=(("", 1.0), ("nir", 0.49))).panel_albedo
    with pytest.raises(ValidationError, match="panel_albedo"):
        WriteSettings(panel_albedo=(("nir", albedo),))
