"""Captures of a panel and of the sky in a flight, start to end."""

import json
import pickle
import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from PIL import Image
from pydantic import ValidationError

import agalign
from agalign.config import RunOptions, WriteSettings, albedos
from agalign.errors import ConfigurationError, SidecarError
from agalign.flight.panel_readings import BandReading, PanelReading, missing_panel, read_panel, with_panels
from agalign.host.files import PANELS_FILE, SKY_FILE
from agalign.host.own_files import is_own_file
from agalign.records import cautions as run_cautions
from agalign.records.panels_and_sky import PANEL_AND_SKY_FILES, last_panels_and_sky, read_panels, read_sky
from agalign.report.pages import write_pages
from agalign.report.panel_and_sky_files import _tile
from agalign.values.capture import Band

from ..conftest import SUN, Shared, read_json, seeded
from ..program import agalign_here
from ..run_outputs import table_in


@pytest.fixture
def by_panel(between_panels: Path, shared: Shared) -> Path:
    return shared(
        "by_panel", lambda out: agalign.align_folder(between_panels, out, settings=seeded(radiometry="panel"))
    )


def planes(folder: Path, number: int) -> np.ndarray:
    with rasterio.open(folder / "0000SET" / "000" / f"IMG_{number:04d}.tif") as stack:
        return np.nanmedian(stack.read(), axis=(1, 2))


@pytest.mark.slow
def test_reflectance_by_panel_is_the_truth(by_panel: Path, by_sun: Path) -> None:
    assert read_json(by_panel / "agalign-run.json")["captures"] == {"found": 4, "panel": 2, "done": 2}
    sun = np.linspace(*SUN, 4)
    for number in (2, 3):
        assert read_json(by_panel / "0000SET" / "000" / f"IMG_{number:04d}.json")["output"]["panel_age_s"] == 1.0
        # What the light sensor takes for less reflectance is less light.
        ratio = planes(by_panel, number) / planes(by_sun, number)
        np.testing.assert_allclose(ratio * sun[number - 1], 1.0, atol=0.02)
    with rasterio.open(by_panel / "0000SET" / "000" / "IMG_0002.tif") as stack:
        assert stack.tags()["RADIOMETRY"] == "reflectance"
        assert set(stack.units) == {"1"}


def test_a_run_that_changes_nothing_leaves_the_pages_of_a_flight_with_panels(
    between_panels: Path, by_panel: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(by_panel, out)
    pages = [out / "index.html", out / PANELS_FILE]
    before = [path.stat().st_mtime_ns for path in pages]
    reports = agalign.align_folder(between_panels, out, settings=seeded(radiometry="panel"))
    assert {report.state for report in reports} == {"kept"}
    assert [path.stat().st_mtime_ns for path in pages] == before


@pytest.mark.parametrize("name", [PANELS_FILE, SKY_FILE, "0000SET/000/IMG_0001.panel.png"])
def test_files_of_the_user_are_neither_replaced_nor_removed(between_panels: Path, tmp_path: Path, name: str) -> None:
    of_user = tmp_path / name
    of_user.parent.mkdir(parents=True, exist_ok=True)
    of_user.write_text('{"mine": 1}')
    with pytest.raises(ConfigurationError, match=f"{name}: was not written by agalign"):
        agalign.align_folder(between_panels, tmp_path, settings=seeded(radiometry="panel"))
    assert of_user.read_text() == '{"mine": 1}'
    assert not (tmp_path / "agalign-run.json").exists()


def test_a_run_on_another_folder_keeps_the_panels_of_the_first(between_panels: Path, tmp_path: Path) -> None:
    out, days = tmp_path / "out", {"day 1": (1, 2), "day 2": (3,), "day 1 again": (2,)}
    for day, numbers in days.items():
        folder = tmp_path / day.removesuffix(" again")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in (p for n in numbers for p in between_panels.rglob(f"IMG_000{n}_*.tif")):
            shutil.copyfile(path, folder / path.name)
        agalign.align_folder(folder, out, settings=seeded("rig"))
        panels = read_panels(out)
        names = [] if day == "day 1 again" else ["IMG_0001"]
        assert [panel.label for panel in panels] == names
        assert [path.name for path in out.rglob("*.panel.png")] == [f"{name}.panel.png" for name in names]


@pytest.mark.slow
def test_panels_are_named_and_drawn_and_kept_out(by_panel: Path) -> None:
    folder = by_panel / "0000SET" / "000"
    assert not (folder / "IMG_0001.tif").exists()
    with Image.open(folder / "IMG_0001.panel.png") as picture:
        assert (np.asarray(picture) == (255, 64, 32)).all(axis=-1).sum() > 5 * 50
    assert is_own_file(by_panel / PANELS_FILE, (PANEL_AND_SKY_FILES[PANELS_FILE],))
    first, last = read_panels(by_panel)
    assert (first.capture, last.capture) == ("IMG_0001", "IMG_0004")
    assert [b.albedo for p in (first, last) for b in p.bands] == pytest.approx([0.51] * 10)
    assert first.sentence.endswith("irradiance 1.00 times that of the light sensor")
    assert "irradiance 0.60 times that of the light sensor (0.60 in Red edge to 0.60 in" in last.sentence
    assert "wrong in a band: --radiometry auto uses the sensor alone, panel the panels alone" in last.sentence
    assert "the light on it is 0.60 times that on the panel in 0000SET/000/IMG_0001, within the hour" in last.sentence
    rows = [r for r in table_in(by_panel / "summary.csv") if r["status"] == "panel"]
    assert {(r["capture"], r["band"]) for r in rows} >= {("IMG_0001", "NIR"), ("IMG_0004", "Green")}
    page = (by_panel / "index.html").read_text()
    assert "Calibration panels" in page
    assert "IMG_0001.panel.png" in page
    assert last.sentence in unescape(page)
    assert first.cues[:2] == ["a QR code", "a homogeneous square in most bands"]
    places = {f["id"]: f["properties"]["status"] for f in read_json(by_panel / "flight.geojson")["features"]}
    assert [places[part.label] for part in (first, last)] == ["panel", "panel"]
    assert "Left out: 2 captures of a calibration panel, by a QR code (2), a homogeneous square" in unescape(page)


@pytest.mark.slow
def test_panels_are_not_among_the_captures_of_the_api(between_panels: Path, tmp_path: Path) -> None:
    finished: list[tuple[str, int, int]] = []
    reports = agalign.align_folder(
        between_panels,
        tmp_path,
        settings=seeded(),
        progress=lambda report, *done: finished.append((report.label, *done)),
    )
    names = ["0000SET/000/IMG_0002", "0000SET/000/IMG_0003"]
    assert [report.result.capture for report in reports if report.result] == ["IMG_0002", "IMG_0003"]
    assert finished == [(names[0], 1, 2), (names[1], 2, 2)]
    assert [report.state for report in reports.excluded] == ["panel", "panel"]
    copied = pickle.loads(pickle.dumps(reports))
    assert (copied, copied.excluded) == (reports, reports.excluded)
    assert "4 captures: 2 done, 2 panel" in reports._repr_html_()
    with pytest.raises(agalign.InputError, match="IMG_0001: shows a calibration panel; align another capture"):
        agalign.align_capture(agalign.discover(between_panels).captures[0], tmp_path)


@pytest.mark.slow
def test_info_names_the_reflectance_that_a_panel_gives(between_panels: Path) -> None:
    text = " ".join(agalign_here("info", between_panels).stdout.split())
    kinds = "radiance by calibration (± 17 %), reflectance by light sensor (± 20 %), reflectance by calibration panel"
    assert f"radiometry: {kinds}" in text


@pytest.mark.full
def test_a_run_with_unusable_reflectance_is_not_complete(
    between_panels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = (between_panels, "-o", tmp_path / "out", "--relief", "never", "--radiometry", "sun", "--jobs", "1")
    assert agalign_here(*arguments).returncode == 0
    monkeypatch.setattr(run_cautions, "_MAX_REFLECTANCE_ERROR", 0.5)
    done = agalign_here(*arguments)
    assert done.returncode == 3
    assert "reflectance is uncertain by up to 67%" in done.stderr


@pytest.mark.slow
def test_the_picture_shows_both_sides_of_what_changed_its_unit(by_panel: Path) -> None:
    with Image.open(by_panel / "0000SET" / "000" / "IMG_0002.png") as picture:
        drawn = np.asarray(picture).astype(float)
    before, after = drawn[40:400, 20:460], drawn[40:400, 510:950]
    assert before.std() > 0.5 * after.std() > 10


@pytest.mark.full
def test_another_run_keeps_results_and_can_align_panels(between_panels: Path, tmp_path: Path) -> None:
    first, *_ = agalign.align_folder(between_panels, tmp_path, settings=seeded()).excluded
    assert first.is_complete
    assert first.panel.startswith("calibration panel RP04-0000001-SY (reflectance 0.51; recognised by a QR code, a ")
    again = agalign.align_folder(between_panels, tmp_path, settings=seeded())
    assert [[r.state for r in some] for some in (again.excluded, again)] == [["panel"] * 2, ["kept"] * 2]
    every = agalign.align_folder(between_panels, tmp_path, settings=seeded(), run=RunOptions(align_panels=True))
    # The kept ones are rendered again: without a panel, their height above the ground is unknown.
    assert [r.state for r in every] == ["done"] * 4
    assert not (tmp_path / PANELS_FILE).exists()


@pytest.mark.full
def test_outputs_of_a_panel_are_removed_with_a_line(between_panels: Path, tmp_path: Path) -> None:
    run = agalign.RunOptions(align_panels=True)
    agalign.align_folder(between_panels, tmp_path, settings=seeded(), run=run)
    folder = tmp_path / "0000SET" / "000"
    mine = Path(shutil.copy(between_panels / "0000SET" / "000" / "IMG_0001_4.tif", folder / "IMG_0001.qa.tif"))
    done = agalign_here(between_panels, "-o", tmp_path, "--only-seed")
    assert "files of an earlier command removed, such as" in done.stderr
    assert "captures of a calibration panel or the sky are not aligned, as 0000SET/000/IMG_0001" in done.stderr
    assert not (folder / "IMG_0001.json").exists()
    assert mine.exists()


@pytest.mark.slow
def test_without_a_panel_none_is_made_up(flight: Path, tmp_path: Path) -> None:
    with pytest.raises(agalign.ConfigurationError, match="--panel-albedo"):
        agalign.align_folder(flight, tmp_path, settings=seeded(radiometry="panel"))


def test_a_reflectance_is_used_or_refused(between_panels: Path, tmp_path: Path) -> None:
    panel = with_panels(agalign.discover(between_panels).captures)[0]
    read = read_panel(panel, {"rededge": 0.25, "": 0.5})
    assert {b.band.name: b.albedo for b in read.bands} == dict.fromkeys(("Blue", "Green", "Red", "NIR"), 0.5) | {
        "Red edge": 0.25
    }

    def aligned(given: str | tuple[tuple[str, float], ...]) -> None:
        of_bands = albedos(given) if isinstance(given, str) else given
        write = WriteSettings(radiometry="panel", panel_albedo=of_bands)
        agalign.align_folder(between_panels, tmp_path, settings=agalign.Settings(write=write))

    for given, said in (
        ("0.5,Bleu=0.49", r"no band 'bleu', as --panel-albedo asks \(did you mean 'Blue'\?\)"),
        ("0.51,0.49", "has two reflectances of all bands"),
        ("RedEdge=0.5,red edge=0.4", "has two reflectances of red edge"),
        ((("rededge", 0.5), ("red edge", 0.4)), "has two reflectances of red edge"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            aligned(given)


def files_of(out: Path) -> dict[str, tuple[bytes, int]]:
    """Contents and times of all files below a folder."""
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in out.rglob("*") if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("write", [{"radiometry": "panel"}, {"pan_sharpen": True, "qa": True}])
def test_refused_options_leave_a_finished_folder_as_it_is(
    flight: Path, tmp_path: Path, write: dict[str, object]
) -> None:
    agalign.align_folder(flight, tmp_path, settings=seeded("rig"))
    before = files_of(tmp_path)
    with pytest.raises(agalign.ConfigurationError):
        agalign.align_folder(flight, tmp_path, settings=seeded("rig", **write))
    assert files_of(tmp_path) == before
    assert agalign_here("verify", tmp_path).returncode == 0


def test_why_a_panel_is_not_used(between_panels: Path) -> None:
    panel, capture, *_ = agalign.discover(between_panels).captures
    read = read_panel(with_panels([panel, capture])[0], {})
    assert missing_panel(capture, [read]) == ""
    start = datetime.fromisoformat(capture.captured_at)

    def without(capture: agalign.Capture = capture, albedo: float | None = 0.5, **changes: Any) -> str:
        bands = tuple(replace(b, albedo=albedo) for b in read.bands)
        return missing_panel(capture, [PanelReading(replace(read.capture, **changes), bands)])

    assert without() == ""
    older = without(captured_at=(start - timedelta(days=13)).isoformat())
    assert older.startswith(f"the nearest panel, in {panel.label}, is 13 days older; a panel counts for 6 hours")
    assert "is 7 hours newer" in without(captured_at=(start + timedelta(hours=7)).isoformat())
    assert without(captured_at="") == ""  # the only panel, even without a time
    assert without(replace(capture, captured_at="")) == ""
    other = without(camera=replace(panel.camera, serial="B2"))
    assert f"the panel in {panel.label} was photographed by " in other
    assert "B2" in other
    assert "--panel-albedo" not in older + other
    assert without(albedo=None).endswith("is unknown in Blue; give --panel-albedo")
    assert "no capture of a calibration panel was found" in missing_panel(capture, [])


@pytest.mark.parametrize("albedo", [0.0, -0.5, 1.01, float("nan")])
def test_a_panel_reflects_between_nothing_and_all(albedo: float) -> None:
    with pytest.raises(ValidationError, match="panel_albedo"):
        WriteSettings(panel_albedo=(("", 1.0), ("nir", albedo)))


@pytest.fixture
def with_sky(flight: Path, tmp_path: Path) -> Path:
    """One capture of a scene, and one of the sky."""
    folder = tmp_path / "flight"
    (folder / "sky").mkdir(parents=True)
    for path in sorted(flight.rglob("IMG_0001_*.tif")):
        shutil.copy(path, folder)
    glow = np.linspace(30000, 40000, 60).astype(np.uint16)
    for band in ("Blue", "Green", "NIR"):
        tifffile.imwrite(folder / "sky" / f"S1_{band}.tif", np.tile(glow, (48, 1)))
    return folder


@pytest.mark.slow
def test_the_sky_is_left_out_and_named(with_sky: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    reports = agalign.align_folder(with_sky, out, settings=seeded())
    assert {r.label: r.state for r in reports} == {"IMG_0001": "done"}
    (of_sky,) = reports.excluded
    assert (of_sky.label, of_sky.state, of_sky.is_complete) == ("sky/S1", "sky", True)
    (capture,) = (c for c in agalign.discover(with_sky).captures if c.label == "sky/S1")
    with pytest.raises(agalign.InputError, match=r"sky/S1: shows the sky; align another capture"):
        agalign.align_capture(capture, out)
    (part,) = read_sky(out)
    assert (part.folder, part.capture, [b.band for b in part.bands]) == ("sky", "S1", ["Blue", "Green", "NIR"])
    assert part.cues == ["its folder or name contains 'sky'", "no band has texture"]
    assert not list(out.rglob("S1*"))
    rows = [r for r in table_in(out / "summary.csv") if r["status"] == "sky"]
    assert [(r["folder"], r["capture"], r["band"]) for r in rows] == [("sky", "S1", b.band) for b in part.bands]
    assert "Sky captures" in (out / "index.html").read_text()
    assert read_json(out / "agalign-run.json")["captures"] == {"found": 2, "sky": 1, "done": 1}
    # Aligned like any other where the user wants it, and no record of the earlier run is left.
    again = agalign.align_folder(with_sky, out, settings=seeded(), run=RunOptions(align_panels=True))
    assert {r.label: r.state for r in again} == {"sky/S1": "done", "IMG_0001": "kept"}
    assert not (out / SKY_FILE).exists()


@pytest.mark.slow
def test_info_names_the_sky(with_sky: Path) -> None:
    done = agalign_here("info", with_sky)
    assert done.returncode == 0
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("sky/S1: "))
    assert line == "sky/S1: shows the sky (its folder or name contains 'sky', no band has texture); not aligned"
    rows = json.loads(agalign_here("info", with_sky, "--json").stdout)["captures"]
    assert {row["label"]: bool(row["sky"]) for row in rows} == {"IMG_0001": False, "sky/S1": True}
    done = agalign_here("align", with_sky, "-o", with_sky.parent / "out", "--relief", "never")
    line = "Left out: 1 capture of the sky, by its folder or name contains 'sky' (1), no band has texture (1)"
    assert line in done.stdout.splitlines()


def test_a_damaged_record_is_one_line(tmp_path: Path) -> None:
    (tmp_path / SKY_FILE).write_text('{"schema": "agalign-sky/1"')
    with pytest.raises(SidecarError, match=r"sky\.json: cannot be read; delete it and run again"):
        read_sky(tmp_path)
    problems: list[str] = []
    write_pages(tmp_path, problems.append)
    assert len(problems) == 1
    panel = {"folder": "", "capture": "panel", "captured_at": "", "bands": []}
    panel |= {"seen_by": "QR code", "serial": "", "picture": "panel.panel.png"}
    (tmp_path / PANELS_FILE).write_text(json.dumps({"schema": "agalign-panels/1", "panels": [panel]}))
    panels, sky = last_panels_and_sky(tmp_path)  # which the next run keeps
    assert ([part.capture for part in panels], sky) == (["panel"], [])


def test_the_picture_of_a_panel_with_a_band_that_cannot_be_read_is_drawn(tmp_path: Path) -> None:
    """The header of the file is complete, its pixels are not; the flight is aligned all the same."""
    path = tmp_path / "panel.tif"
    tifffile.imwrite(path, np.zeros((120, 160), np.uint16))
    band = Band("NIR", path, 1, 160, 120, "uint16")
    assert _tile(BandReading(band, 0.5)).shape == (264, 320, 3)
    path.write_bytes(path.read_bytes()[:1000])
    assert _tile(BandReading(band, 0.5)).shape == (264, 320, 3)
