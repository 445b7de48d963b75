"""What the report knows and draws, without a browser."""

import json
import re
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable
from html import unescape
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import pytest

import agalign
from agalign.config import Settings
from agalign.errors import OutputError
from agalign.rasters.drawing import ReducedBands, read_reduced_bands
from agalign.rasters.preview import preview_bytes, relief_tile, write_preview
from agalign.records.run_record import begun
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import read_sidecar, write_sidecar
from agalign.report import facts as facts_module
from agalign.report.charts import CHART_HEIGHT, drifts_of, hues_of, rig_views
from agalign.report.facts import CameraOffsets, FlightFacts
from agalign.report.pages import SCRIPTS, pages_exist, write_pages
from agalign.report.pair_totals import PairTotals
from agalign.report.terms import DOC_PAGES, TERMS
from agalign.spectral_indices.indices_csv import update_table
from agalign.spectral_indices.rasters import IndexReport
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid

from ..conftest import read_json, save_known_model, seeded, textured_image
from ..records.test_sidecar import ALIGNED, NIR, example
from ..run_outputs import change, facts_of, table_in

PAGE = Path(agalign.__file__).parent / "report" / "page"


@pytest.fixture
def out(aligned_flight: Path, tmp_path: Path) -> Path:
    return shutil.copytree(aligned_flight, tmp_path / "out")


def script_of(file: Path) -> dict[str, Any]:
    """The data in a script next to the page."""
    return json.loads(file.read_text(encoding="utf-8").partition("(")[2].rpartition(")")[0])


@pytest.mark.slow
def test_the_page_has_the_facts_of_every_capture(flight: Path, aligned_flight: Path) -> None:
    facts = facts_of(aligned_flight)
    labels = [f"0000SET/000/IMG_000{i}" for i in (1, 2)]
    details = facts["details"]
    assert [[c["label"] for c in facts[part]["records"]] for part in ("rows", "details")] == [labels, labels]
    truth = read_json(flight / "truth.json")
    for capture, row in zip(details["records"], facts["rows"]["records"], strict=True):
        known = [b["residual_px"] for b in capture["bands"] if b["status"] == "aligned"]
        assert row["error_px"] == max(b["error_px"] for b in capture["bands"] if b["status"] == "aligned")
        assert row["residual_px"] == max(known)
        assert row["bands"] == [[b["band"], b["status"]] for b in capture["bands"] if b["status"] != "reference"]
        sidecar = read_json(aligned_flight / f"{capture['label']}.json")
        assert capture["preview"]["file"] == f"{capture['label']}.preview.jpg"
        assert capture["crop"] == sidecar["output"]["crop"]
        assert capture["relief"] is None
        ties = truth[sidecar["capture"]]["bands"]
        for pair, part in zip(capture["bands"], sidecar["bands"], strict=True):
            assert (pair["band"], pair["status"]) == (part["band"], part["status"])
            if pair["status"] == "reference":
                continue
            # The initial offset of the files is known exactly here.
            known = np.asarray(ties[Path(part["file"]).name]["ties"])
            offset_length_px = np.median(np.linalg.norm(known[:, 2:] - known[:, :2], axis=1))
            assert pair["offset_length_px"] == pytest.approx(offset_length_px, abs=0.3)
            windows = part["metrics"]["windows"]
            shifts = [None if v is None else v * facts["shift_step_px"] for v in pair["shifts"]]
            measured, centres = (list(chain(*windows[name])) for name in ("shifts_px", "centres_px"))
            assert shifts == [v if v is None else pytest.approx(v, abs=0.006) for v in measured]
            assert details["lattices"][pair["lattice"]] == centres


def test_the_median_share_of_masked_pixels_is_that_of_the_console(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = FlightFacts.write
    monkeypatch.setattr(FlightFacts, "write", lambda self: self.masked.update(ndvi=[0.3, 0.01]) or write(self))
    write_pages(out, pytest.fail)
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "mask pixels of 2 captures, median 15.5 %, at most 30.0 %" in page


def headline(out: Path, on_problem: Callable[[str], object] = pytest.fail) -> str:
    """The text of the page's first paragraph, after it is written again."""
    write_pages(out, on_problem)
    page = (out / "index.html").read_text(encoding="utf-8")
    return " ".join(re.sub("<[^>]+>", "", page.partition('<p class="verdict">')[2].partition("</p>")[0]).split())


@pytest.mark.slow
def test_headline_and_summary_count_what_was_to_be_aligned(out: Path) -> None:
    assert headline(out).startswith("Every band of every capture is aligned. Expected error: 0.")
    record, sidecar = out / "agalign-run.json", out / "0000SET" / "000" / "IMG_0002.json"
    damaged = {"of": "IMG_0001_1.tif", "problem": "its XMP packet is damaged", "kind": "used"}
    change(record, problems=[damaged])
    assert headline(out).startswith("Every band of every capture is aligned. Expected error: 0.")
    assert headline(out).endswith(" 1 file was used in spite of a problem.")
    change(record, problems=[{"of": "IMG_0003_1.tif", "problem": "cannot be read", "kind": "skipped"}])
    assert headline(out).startswith("8 of 8 band pairs are aligned. Expected error: ")
    assert headline(out).endswith(" 1 file or capture took no part.")
    unwritten = {"of": "0000SET/000/IMG_0002", "problem": "IMG_0002.png: cannot be written"}
    change(record, problems=[damaged, unwritten | {"kind": "not_written"}])
    said = " 1 file was used in spite of a problem, 1 output was not written. Errors in 1 of 2 captures"
    assert said in headline(out)
    change(record, problems=[unwritten])  # of an earlier version
    assert " 1 problem. Errors in 1 of 2 captures" in headline(out)
    labels = [f"0000SET/000/IMG_000{number}" for number in (1, 2, 3, 4)]
    change(record, problems=[], state="interrupted", labels=labels)
    assert headline(out).startswith("8 of 8 band pairs are aligned.")
    without = f"2 of 4 captures have no result: {labels[2]}, {labels[3]}; the same command resumes it."
    assert f"The run was stopped before its end; {without}" in headline(out)
    (out / "panels.json").write_text("{")  # another file that cannot be read changes nothing
    assert f"The run was stopped before its end; {without}" in headline(out, str)
    (out / "panels.json").unlink()
    assert [(r["capture"], r["status"]) for r in table_in(out / "summary.csv")[8:]] == [
        ("IMG_0003", "no_result"),
        ("IMG_0004", "no_result"),
    ]
    change(record, state="running")
    assert f"The run did not end: it was killed, or is still running; {without}" in headline(out)
    change(record, state="finished", labels=labels[:2])
    cause = "its file cannot be read"
    change(sidecar, status="degraded", missing_bands=["Thermal", "Pan"], unreadable_bands={"Thermal": cause})
    assert headline(out).startswith("8 of 10 band pairs are aligned; indices cannot use the rest (2 missing). Expected")
    rows = table_in(out / "summary.csv")
    assert [r["status"] for r in rows] == ["aligned"] * 8 + ["missing"] * 2
    assert {r["reference"] for r in rows} == {"Green"}
    assert [(r["folder"], r["capture"], r["band"]) for r in rows[8:]] == [
        ("0000SET/000", "IMG_0002", name) for name in ("Thermal", "Pan")
    ]
    assert rows[-2]["reason"] == cause
    assert "a band of this camera is missing" in rows[-1]["reason"]
    record = facts_of(out)["details"]["records"][1]
    assert record["missing"] == [["Thermal", cause], ["Pan", rows[-1]["reason"]]]


def with_band(bands: list[dict[str, Any]], name: str, **facts: Any) -> list[dict[str, Any]]:
    """The bands of a sidecar with other facts about one of them."""
    return [b | facts if b["band"] == name else b for b in bands]


def prediction(std_px: float, **facts: Any) -> dict[str, Any]:
    """The facts about a band that is predicted with this error."""
    known = {"fixed_to_moving": np.eye(3).tolist(), "from": "bands", "std_px": std_px}
    return {"status": "predicted", "reason": "noise", "prediction": known, "error": {"std_px": std_px}} | facts


@pytest.mark.slow
def test_the_verdict_is_the_expected_error_of_the_bands_that_indices_use(out: Path) -> None:
    sidecar = out / "0000SET" / "000" / "IMG_0002.json"
    paths = sidecar.with_name("IMG_0001.json"), sidecar
    known = {
        (band["error"]["std_px"], path.stem, band["band"])
        for path in paths
        for band in read_json(path)["bands"]
        if band["status"] == "aligned"
    }
    typical_px = np.median([px for px, *_ in known])
    largest_px, capture, band = max(known)
    assert (
        f"Expected error: {typical_px:.2f} px of the reference for the median band pair, {largest_px:.2f} px"
        in headline(out)
    )
    assert f"({band} of 0000SET/000/{capture})." in headline(out)
    bands = read_json(sidecar)["bands"]
    change(sidecar, bands=with_band(bands, "NIR", **prediction(0.934, share_over_1_px=0.14)))
    text = headline(out)
    assert text.startswith("7 of 8 band pairs are aligned, 1 is predicted accurately enough for indices. Expected")
    over = "where 14 % of the pixels may be off by more than 1 px of the reference"
    assert f"0.93 px for the worst of those that indices can use (NIR of 0000SET/000/IMG_0002, {over})." in text
    change(sidecar, bands=with_band(bands, "NIR", **prediction(1.01)), status="degraded")
    text = headline(out)
    assert "indices cannot use the rest (1 predicted with a larger error). Expected error" in text
    assert "1.01" not in text
    change(sidecar, bands=with_band(bands, "NIR", error=None))
    assert headline(out).endswith("; unknown for 1.")


def test_the_error_of_a_band_with_larger_pixels_is_shown_in_px_of_both(tmp_path: Path) -> None:
    """A thermal band is usable with an error of 12.55 px of the reference, which is 0.88 px of its own."""
    error = {"std_px": 12.55, "std_band_px": 0.88}
    thermal = NIR | prediction(0.88, error=error) | {"band": "LWIR"}
    narrow = NIR | ALIGNED | {"error": {"std_px": 0.0712, "std_band_px": 0.0704}}
    write_sidecar(tmp_path / "IMG_1.json", example(bands=[narrow, thermal]))
    assert headline(tmp_path).endswith(
        "Expected error: 6.31 px of the reference for the median band pair, 12.55 px (0.88 px of the band) for the "
        "worst of those that indices can use (LWIR of IMG_1)."
    )
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<td class="n">(0\.071|12\.550)([^<]*)</td>', page) == [
        *[("0.071", ""), ("0.071", "")],
        *[("12.550", ""), ("12.550", " (0.88 px of the band)")],
    ]
    assert '<th scope="col" class="n"' in page
    rows = {row["band"]: row for row in table_in(tmp_path / "summary.csv")}
    names = "expected_error_px", "expected_error_band_px"
    assert [[rows[band][name] for name in names] for band in ("NIR", "LWIR")] == [
        ["0.0712", "0.0704"],
        ["12.55", "0.88"],
    ]
    facts = facts_of(tmp_path)
    (row,), (details,) = (facts[part]["records"] for part in ("rows", "details"))
    assert (row["error_px"], row["error_band_px"]) == (12.55, 0.88)
    shown = {b["band"]: (b["error_px"], b["error_band_px"], b["usable"]) for b in details["bands"]}
    assert (shown["NIR"], shown["LWIR"]) == ((0.0712, None, True), (12.55, 0.88, True))


@pytest.mark.slow
def test_a_capture_that_is_ok_by_prediction_is_not_shown_as_ok(out: Path) -> None:
    sidecar = out / "0000SET" / "000" / "IMG_0002.json"
    change(sidecar, bands=with_band(read_json(sidecar)["bands"], "NIR", **prediction(0.9)))
    write_pages(out, pytest.fail)
    facts = facts_of(out)
    for part in ("rows", "details"):
        assert [c["shown"] for c in facts[part]["records"]] == ["ok", "ok_by_prediction"]
        assert [c["status"] for c in facts[part]["records"]] == ["ok", "ok"]
        assert facts[part]["records"][1]["error_px"] == 0.9
    page = (out / "index.html").read_text(encoding="utf-8")
    assert re.search(r"<dt>captures ok</dt><dd>1 of 2</dd>", page)
    assert re.search(r"<dt>ok by prediction</dt><dd>1</dd>", page)


@pytest.mark.slow
def test_cameras_have_their_names_with_the_unit_if_there_are_several_of_a_model(out: Path) -> None:
    first, second = (out / "0000SET" / "000" / f"IMG_000{number}.json" for number in (1, 2))
    camera = read_json(first)["camera"]
    name = f"{camera['make']} {camera['model']}"

    def named() -> str:
        write_pages(out, pytest.fail)
        return (out / "index.html").read_text(encoding="utf-8").partition("2 captures of ")[2].partition(" &middot;")[0]

    assert named() == name
    units = [camera | {"serial": serial} for serial in ("7", "9")]
    for sidecar, unit in zip((first, second), units, strict=True):
        change(sidecar, camera=unit)
    assert named() == f"{name} 7, {name} 9"


@pytest.mark.slow
def test_indices_that_were_not_written_are_named_with_the_reason(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = out / "0000SET" / "000" / "IMG_0002.json"
    contents = read_json(sidecar)
    options = {"options": {"write": {"indices": ["ndvi"]}}}
    failed = {"status": "failed", "reason": "the file is black", "issues": [], "place": None}
    change(sidecar, bands=with_band(contents["bands"], "Red", **failed), status="degraded", **options)
    table = (out / "indices.csv").is_file()
    assert "NDVI was not written for 1 of 2 captures." in headline(out)
    reason = "Red is failed (the file is black)"
    first, second = facts_of(out)["details"]["records"]
    assert (first["unwritten"], second["unwritten"]) == ([], [["ndvi", reason]])
    assert facts_of(out)["rows"]["records"][1]["check"]
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "<b>NDVI of 1 capture</b>" in page
    assert f"<td>{reason}</td>" in page
    assert (out / "indices.csv").is_file() == table, "the table is not changed"
    monkeypatch.setattr("agalign.report.pages._MAX_LISTED", 0)
    text = "".join(write_pages(out, pytest.fail).json_lines())
    assert [c["unwritten"] for c in json.loads(text)["captures"]] == [[], [["ndvi", reason]]]
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "<p>The first 0 of 1; <code>agalign report --json</code> prints all.</p>" in page
    assert 'href="indices.csv"' not in page
    # The bands can be used; the raster was deleted, or its disk was full.
    change(sidecar, bands=contents["bands"], status="ok", **options)
    write_pages(out, pytest.fail)
    ((_, reason),) = facts_of(out)["details"]["records"][1]["unwritten"]
    assert "does not exist; 'agalign indices' writes it" in reason
    # A row of the table without a raster, as `agalign indices` writes it.
    change(sidecar, options=None)
    update_table(out, [IndexReport("0000SET/000/IMG_0002", "ndre", problem="the disk is full")])
    write_pages(out, pytest.fail)
    assert facts_of(out)["details"]["records"][1]["unwritten"] == [
        ["ndre", "when it was last calculated: the disk is full"]
    ]


@pytest.mark.slow
def test_each_term_of_a_column_is_explained_in_the_help(out: Path) -> None:
    write_pages(out, pytest.fail)
    page = (out / "index.html").read_text(encoding="utf-8")
    script = "".join(path.read_text(encoding="utf-8") for path in PAGE.glob("*.js"))
    assert '<a href="#help">' in page.partition("</header>")[0]
    assert 'id="help"' in page
    heads = re.findall(r'<th scope="col"[^>]* title="([^"]+)">', page)
    assert len(heads) >= 6
    assert {unescape(head) for head in heads} <= {term.meaning for term in TERMS.values()}
    used = set(re.findall(r'term: "(\w+)"', script))
    assert used <= set(TERMS)
    assert len(used) >= 8
    for name in TERMS:
        assert f'<dd id="term-{name}">' in page
    for _, file, _ in DOC_PAGES:
        assert (Path(agalign.__file__).parents[1] / file).is_file()
        assert file in page


@pytest.mark.slow
def test_what_to_check_in_the_reference_has_a_row(out: Path) -> None:
    sidecar = out / "0000SET" / "000" / "IMG_0002.json"
    bands = read_json(sidecar)["bands"]
    change(sidecar, bands=[b | {"saturated": 0.2 if b["status"] == "reference" else None} for b in bands])
    assert "Every band of every capture is aligned" in headline(out)
    rows = table_in(out / "summary.csv")
    assert [r["status"] for r in rows].count("aligned") == 8
    (row,) = (r for r in rows if r["status"] == "reference")
    assert (row["capture"], row["band"], row["check"]) == ("IMG_0002", "Green", "20.0% of the pixels are saturated")


@pytest.mark.slow
def test_the_page_has_the_relief(aligned_flight: Path, tmp_path: Path) -> None:
    sidecar = read_json(aligned_flight / "0000SET" / "000" / "IMG_0001.json")
    part = {"file": "IMG_0001.relief.tif", "baseline": [0.5, 0.5], "occluded": 0.0125}
    part |= {name: [[0.0, 0.0]] for name in ("reference_px", "plane_px", "slope")}
    for band in sidecar["bands"]:
        if band["band"] in ("NIR", "Red"):
            band["relief"] = part
    sidecar["preview"]["relief"] = {"parallax_px": [-3.0, 7.0], "range_m": None}
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "IMG_0001.json").write_text(json.dumps(sidecar))
    write_pages(tmp_path, pytest.fail)
    (capture,) = facts_of(tmp_path)["details"]["records"]
    assert capture["relief"] == "a%20b/IMG_0001.relief.tif"
    assert capture["preview"]["relief"] == sidecar["preview"]["relief"]
    occluded = {pair["band"]: pair["occluded"] for pair in capture["bands"]}
    assert occluded == {"Blue": None, "Green": None, "Red": 0.0125, "NIR": 0.0125, "Red edge": None}


def small_parts(monkeypatch: pytest.MonkeyPatch, details: int, rows: int) -> None:
    """Make parts of a report with few captures."""
    monkeypatch.setattr(facts_module, "_DETAILS_PER_PART", details)
    monkeypatch.setattr(facts_module, "_ROWS_PER_PART", rows)


def many_captures(aligned_flight: Path, out: Path, count: int) -> list[str]:
    """Write copies of a sidecar with other names, and return them."""
    sidecar = read_json(aligned_flight / "0000SET" / "000" / "IMG_0001.json")
    names = [f"IMG_{number:04d}" for number in range(count)]
    for name in names:
        (out / f"{name}.json").write_text(json.dumps(sidecar | {"capture": name}))
    return names


@pytest.mark.slow
def test_the_page_of_a_season_is_as_small_as_that_of_a_day(
    aligned_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part has 400 bytes a row, and 6 kB a capture; the others are scripts of the same size."""
    small_parts(monkeypatch, 5, 10)
    names = many_captures(aligned_flight, tmp_path, 12)
    write_pages(tmp_path, pytest.fail)
    before = (tmp_path / "index.html").stat().st_size
    names = many_captures(aligned_flight, tmp_path, 43)
    write_pages(tmp_path, pytest.fail)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=\"(?:https?:)?//", page)
    assert "default-src 'none'" in page
    assert len(page.encode()) - before < 3000  # names of files, points of a chart; 31 captures have 200 kB
    facts = facts_of(tmp_path)
    assert (len(facts["row_files"]), len(facts["detail_files"])) == (4, 8)
    for kind, files in (("rows", facts["row_files"]), ("details", facts["detail_files"])):
        parts = [facts[kind], *(script_of(tmp_path / file) for file in files)]
        assert [c["label"] for part in parts for c in part["records"]] == names
        assert [part["from"] for part in parts] == [i * len(facts[kind]["records"]) for i in range(len(parts))]
        assert all((tmp_path / file).stat().st_size < 400 + 10 * 1000 + 5 * 7000 for file in files)
    # Files of the earlier page are removed; without one of its files, a page is not complete.
    listed = {Path(file).name for file in (*facts["row_files"], *facts["detail_files"])}
    assert {path.name for path in (tmp_path / "report-data").iterdir()} == listed
    assert pages_exist(tmp_path)
    (tmp_path / facts["row_files"][1]).unlink()
    assert not pages_exist(tmp_path)
    for name in names[5:]:
        (tmp_path / f"{name}.json").unlink()
    write_pages(tmp_path, pytest.fail)
    assert not (tmp_path / "report-data").exists()


@pytest.mark.full
def test_the_memory_of_a_report_is_that_of_a_few_captures(
    aligned_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is kept of a capture is a small part of the 200 kB of its data in memory."""
    small_parts(monkeypatch, 5, 10)
    peaks = []
    for count in (10, 60):
        many_captures(aligned_flight, tmp_path, count)
        tracemalloc.start()
        write_pages(tmp_path, pytest.fail)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (peaks[1] - peaks[0]) / 50 < 10_000


@pytest.mark.slow
def test_the_report_as_json_has_every_capture(
    aligned_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_parts(monkeypatch, 2, 2)
    names = many_captures(aligned_flight, tmp_path, 5)
    facts = json.loads("".join(write_pages(tmp_path, pytest.fail).json_lines()))
    assert facts["schema"] == "agalign-report/1"
    assert [c["label"] for c in facts["captures"]] == names
    sidecar = read_json(tmp_path / "IMG_0004.json")
    for pair, part in zip(facts["captures"][4]["bands"], sidecar["bands"], strict=True):
        if part["status"] != "reference":
            assert facts["lattices"][pair["lattice"]] == list(chain(*part["metrics"]["windows"]["centres_px"]))


def test_the_page_has_no_control_characters(tmp_path: Path) -> None:
    """Names and tags may have terminal escapes and changes of text direction, which show one name as another."""
    name, hostile = "IMG_\u202egnp.1", "a\x1b[2J\u202eb\x07"
    band = NIR | {"band": hostile, "status": "failed", "reason": f"{hostile} is blank"}
    camera = {"make": hostile, "model": hostile, "serial": hostile}
    sidecar = example(capture=name, bands=[band], camera=camera, missing_bands=[f"{hostile}2"], captured_at=hostile)
    write_sidecar(tmp_path / f"{name}.json", sidecar)
    record = begun(Path(hostile), Settings(), command=hostile).model_copy(update={"labels": [name, hostile]})
    record.write(tmp_path, "running", 0.0)
    write_pages(tmp_path, pytest.fail)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert [c for c in page if not (c.isprintable() or c == "\n")] == []
    (row,) = facts_of(tmp_path)["rows"]["records"]
    assert row["label"] == r"IMG_\u202egnp.1"
    assert f'href="#capture={quote(row["label"])}"' in page
    assert not any(c in json.dumps(facts_of(tmp_path), ensure_ascii=False) for c in "\u202e\x1b\x07")
    assert json.dumps(facts_of(tmp_path)).count("u001b") == 0
    assert facts_of(tmp_path)["details"]["records"][0]["sidecar"] == quote(f"{name}.json")


def test_long_lists_are_cut_in_the_page(tmp_path: Path) -> None:
    for number in range(120):
        part = NIR | {"band": "NIR", "status": "failed", "reason": "it shows nothing"}
        write_sidecar(tmp_path / f"IMG_{number}.json", example(capture=f"IMG_{number}", bands=[part], missing_bands=()))
    write_pages(tmp_path, pytest.fail)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert page.count("<td>it shows nothing</td>") == 100
    assert 'The first 100 of 120; all are in <a href="summary.csv">' in page


@pytest.mark.slow
def test_pages_stand_until_a_sidecar_is_newer_or_was_unreadable(out: Path) -> None:
    assert pages_exist(out)
    path = out / "0000SET" / "000" / "IMG_0001.json"
    contents = path.read_bytes()
    problems: list[str] = []
    for written, is_readable in ((contents, True), (b'{"schema": "agalign/', False), (contents, True)):
        path.write_bytes(written)
        assert not pages_exist(out)
        write_pages(out, problems.append)
        assert pages_exist(out) == is_readable
    (problem,) = problems
    assert "IMG_0001.json: not valid JSON" in problem


def test_rigs_are_drawn_of_models_that_can_be_read(tmp_path: Path) -> None:
    save_known_model(tmp_path / "models" / "a.safetensors")
    (tmp_path / "models" / "b.safetensors").write_bytes(b"")
    problems: list[str] = []
    (view,) = rig_views(tmp_path, problems.append)
    assert [b["band"] for b in view["bands"]] == ["NIR", "[Red]"]
    assert (view["reference"], view["reference_hue"]) == ("Green", 130)
    assert view["bands"][0]["hue"] == 280
    (problem,) = problems
    assert "b.safetensors" in problem


@pytest.mark.parametrize("size_px", [(80, 60), (2592, 60)])
def test_the_share_of_saturated_pixels_of_a_band(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """Every third pixel of a part, also of an image that is reduced for the screen."""
    width, height = size_px
    plane = np.full((height, width), 3, np.uint8)
    plane[:10, : width // 2 : 3] = 255
    cv2.imwrite(str(tmp_path / "a.png"), plane)
    band = Band("NIR", tmp_path / "a.png", 1, width, height, "uint8", saturation_value=255)
    bands = read_reduced_bands(Capture("a", tmp_path, (band,), 0), {}, OutputGrid(0, 0, width, height))
    assert bands.saturated == {"NIR": pytest.approx((plane == 255).mean())}


@pytest.mark.slow
def test_sidecars_have_the_share_of_saturated_pixels(aligned_flight: Path) -> None:
    sidecar = read_sidecar(next(aligned_flight.rglob("IMG_0001.json")))
    assert all(0 <= band.saturated < 0.05 for band in sidecar.bands)


def test_bands_are_drawn_in_their_colours() -> None:
    hues = hues_of(["Red", "Blue", "green", "RedEdge", "NIR", "B1", "B2"])
    assert list(hues.values())[:5] == [0, 215, 130, 325, 280]
    assert len(set(hues.values())) == 7
    assert hues_of(["Blue", "blu"])["blu"] != 215, "a second blue has another colour"


def test_the_rig_has_the_name_of_its_reference(tmp_path: Path) -> None:
    save_known_model(tmp_path / "models" / "a.safetensors")
    write_pages(tmp_path, pytest.fail)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    drawing = page.partition('<section class="rig">')[2].partition("</figure>")[0]
    assert 'class="name">Green</text>' in drawing
    assert "Green, the reference</span>" in drawing
    assert 'class="origin" style="--hue:130"' in drawing


@pytest.mark.slow
def test_drift_is_drawn_along_its_direction_with_gaps_for_missing_bands() -> None:
    offsets = [{"NIR": (10 + 3 * i, 4 * i), "Blue": (-i, 0)} if i != 3 else {"Blue": (-3, 0)} for i in range(7)]
    captures = [(f"2026-06-21T10:00:{i:02d}", f"{i:02d}", one) for i, one in enumerate(offsets)]
    # In the order of time, whatever that of the captures is.
    known = CameraOffsets(captures[::-1])
    (drift,) = drifts_of({"camera": known})
    assert drift["ends"] == ("00", "06")
    assert drift["full_px"] == pytest.approx(15, abs=0.01)
    assert [len(line["points"]) for line in drift["lines"]] == [2, 1]
    heights = [[float(p.split(",")[1]) for run in line["points"] for p in run.split()] for line in drift["lines"]]
    ends = sorted((heights[0][0], heights[0][-1]))
    assert ends == pytest.approx([CHART_HEIGHT / 2 * (1 - 0.92 * s) for s in (1, -1)], abs=0.1)
    # Along the same baseline in the other direction, a band is drawn next to the first, not opposite to it.
    assert np.sign(np.diff(heights[0])).tolist() == np.sign(np.diff(heights[1][:3] + heights[1][4:])).tolist()
    assert drifts_of({"camera": CameraOffsets(captures[:2])}) == []


def test_the_page_has_all_scripts() -> None:
    assert sorted(SCRIPTS) == sorted(path.name for path in PAGE.glob("*.js"))


@pytest.mark.slow
def test_the_scripts_types_are_right() -> None:
    tsc = shutil.which("tsc")
    if tsc is None:
        pytest.skip("TypeScript is not installed")
    version = subprocess.run([tsc, "--version"], capture_output=True, text=True, check=True).stdout
    if "Version 4." in version:
        pytest.skip("TypeScript 4 ignores tags after a sentence")
    options = "--allowJs --checkJs --noEmit --strict --skipLibCheck --target es2022 --lib es2022,dom,dom.iterable"
    scripts = sorted(map(str, PAGE.glob("*.js")))
    done = subprocess.run([tsc, *options.split(), *scripts], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def grey(seed: int, width: int = 640, height: int = 480) -> np.ndarray:
    return (128 + 40 * textured_image(width, height, seed)).clip(0, 255).astype(np.uint8)


@pytest.fixture
def views() -> ReducedBands:
    """Green and NIR; only Green was written."""
    return ReducedBands({"Green": grey(1), "NIR": grey(2)}, {"Green": grey(3)}, (640, 480))


@pytest.mark.parametrize("has_errors", [False, True])
def test_every_picture_is_at_the_place_in_the_sidecar(views: ReducedBands, tmp_path: Path, has_errors: bool) -> None:
    parallax_px = np.linspace(-3, 7, 320, dtype=np.float32)[None].repeat(240, axis=0)
    parallax_px[:2, :2] = 1000.0  # wrong pixels take no contrast
    errors = {"NIR": np.full((4, 5), 1.5, np.float32)} if has_errors else {}
    relief = relief_tile(parallax_px, (1.23456, 2.5))
    part = write_preview(views, ["Green", "NIR"], errors, tmp_path / "a.preview.jpg", preview_bytes(1), relief)
    sheet = cv2.imread(str(tmp_path / part.file), cv2.IMREAD_GRAYSCALE)
    (w, h), (dw, dh) = part.tile_px, part.detail_px
    assert sheet.shape == ((3 + has_errors) * h + 2 * dh, 2 * w)

    def like(result: np.ndarray, image: np.ndarray) -> float:
        there = cv2.resize(image, result.shape[::-1], interpolation=cv2.INTER_AREA)
        return float(np.corrcoef(result.ravel(), there.ravel())[0, 1])

    assert like(sheet[:h, :w], views.before["Green"]) > 0.98
    assert like(sheet[:h, w:], views.before["NIR"]) > 0.98
    assert like(sheet[h : 2 * h, :w], views.after["Green"]) > 0.98
    assert sheet[h : 2 * h, w:].max() < 4, "what was not written is black"
    x, y = round(part.detail[0] * 640), round(part.detail[1] * 480)
    detail, below = sheet[2 * h : 2 * h + 2 * dh], sheet[2 * h + 2 * dh :]
    assert like(detail[:dh, dw : 2 * dw], views.before["NIR"][y : y + dh, x : x + dw]) > 0.98
    assert like(detail[dh:, :dw], views.after["Green"][y : y + dh, x : x + dw]) > 0.98
    if has_errors:
        assert part.error_full_px == 2, "errors beyond the limits for use are distinguished too"
        assert np.median(below[:h, w:]) == pytest.approx(255 * 1.5 / 2, abs=3)
    low, high = part.relief.parallax_px
    assert (low, high) == pytest.approx((-2.9, 6.9), abs=0.1)
    assert part.model_dump(mode="json")["relief"]["range_m"] == [1.235, 2.5]
    assert below[-h:, w:].max() < 4
    shown = low + below[-h // 2, :w].astype(float) / 255 * (high - low)
    np.testing.assert_allclose(shown, np.linspace(-3, 7, w).clip(low, high), atol=0.25)


@pytest.mark.parametrize("captures", [1, 200, 1000])
def test_all_previews_of_a_flight_have_a_limit(views: ReducedBands, tmp_path: Path, captures: int) -> None:
    path = tmp_path / "a.preview.jpg"
    write_preview(views, ["Green", "NIR"], {}, path, preview_bytes(captures))
    assert path.stat().st_size <= preview_bytes(captures) <= 44_000_000 / captures


def test_images_smaller_than_a_tile_are_shown_as_they_are(tmp_path: Path) -> None:
    tiny = {"Green": grey(1, 60, 41), "NIR": grey(2, 60, 41)}
    part = write_preview(ReducedBands(tiny, tiny, (60, 41)), ["Green", "NIR"], {}, tmp_path / "a.preview.jpg", 10_000)
    assert part.tile_px == (56, 40)
    assert max(part.detail[2:]) <= 1


def test_a_preview_that_is_too_wide_for_its_format_is_a_product_that_failed(tmp_path: Path) -> None:
    names, blank = [f"B{number}" for number in range(1100)], np.zeros((48, 64), np.uint8)
    with pytest.raises(OutputError, match=r"a\.preview\.jpg: cannot be encoded"):
        write_preview(ReducedBands(dict.fromkeys(names, blank), {}, (64, 48)), names, {}, tmp_path / "a.preview.jpg", 9)


# ---- failed bands, grouped by their cause


def capture(*bands: tuple[str, str, str | None], missing: tuple[str, ...] = (), **changes: Any) -> Sidecar:
    """A capture of bands with (name, status, kind of their issue)."""
    parts = []
    for name, status, kind in bands:
        issues = [] if kind is None else [{"kind": kind, "value": None, "limit": None}]
        prediction = {"fixed_to_moving": np.eye(3).tolist(), "from": "bands", "std_px": 0.1}
        facts = {"band": name, "status": status, "reason": kind, "issues": issues}
        known = {"prediction": prediction, "error": {"std_px": 0.1, "std_band_px": 0.1}}
        parts.append(NIR | facts | (known if status == "predicted" else {}))
    return example(bands=parts, missing_bands=missing, **changes)


def test_bands_are_grouped_by_cause_and_status_most_severe_first() -> None:
    result = PairTotals()
    bands = ("Green", "reference", None), ("Blue", "aligned", None), ("NIR", "predicted", "retrieval")
    result.add("one", capture(*bands))
    result.add("two", capture(("NIR", "predicted", "few_windows"), ("Red", "failed", "unreadable"), missing=("X",)))
    result.add("three", capture(("NIR", "seed_only", "repeats")))
    result.add("four", capture(("NIR", "seed_only", None)))
    groups = result.groups()
    assert [g.status for g in groups] == ["failed", "seed_only", "seed_only", "missing", "predicted"]
    assert sum("no reason" in g.remedy.cause for g in groups) == 1
    assert [b.capture for b in groups[-1].bands] == ["one", "two"]
    assert groups[-1].captures == 2
    assert groups[-1].advice.startswith(
        "indices use those with an expected error (prediction.std_px, px of the band) up to --accept-predicted"
    )
    assert groups[-1].size == "expected error up to 0.10 px"
    assert "card" in groups[0].advice
    assert result.statuses == {"aligned": 1, "predicted": 2, "failed": 1, "missing": 1, "seed_only": 2}
    assert {name: dict(band.statuses) for name, band in result.bands.items()} == {
        "Blue": {"aligned": 1},
        "NIR": {"predicted": 2, "seed_only": 2},
        "Red": {"failed": 1},
        "X": {"missing": 1},
    }


def with_reference(name: str, missing: tuple[str, ...] = (), flight_id: str = "") -> Sidecar:
    reference = {"band": name, "file": "x.tif", "band_index": 1, "width": 10, "height": 8}
    bands = [(name, "reference", None)]
    bands += [(b, "aligned", None) for b in ("Blue", "Green") if b != name and b not in missing]
    return capture(*bands, missing=missing, reference=reference, flight_id=flight_id)


@pytest.mark.parametrize(
    ("references", "odd"),
    [
        ("Green Green Green", []),
        ("Blue Green Green", [0]),  # the exception differs from most captures, not from the first
        ("Blue Green Blue Green", [0, 2]),  # half lack green: a band that is missing is the flight's
        ("Blue Blue Green Blue", [2]),
    ],
)
def test_captures_with_another_reference_than_most_of_their_flight_are_named(references: str, odd: list[int]) -> None:
    result, names = PairTotals(), references.split()
    # As `with_missing_bands`: a band of at least half of the captures is missing in the others.
    missing = ("Green",) if 2 * names.count("Green") >= len(names) else ()
    for number, name in enumerate(names):
        result.add(f"IMG_{number}", with_reference(name, missing if name == "Blue" else ()))
    result.add("IMG_9", with_reference("Red", flight_id="another"))
    groups = [g for g in result.groups() if g.status == "other_reference"]
    assert [b.capture for g in groups for b in g.bands] == [f"IMG_{number}" for number in odd]
    if odd:
        usual = {"Blue": "Green", "Green": "Blue"}[names[odd[0]]]
        assert (
            groups[0].bands[0].reason
            == f"on the grid of {names[odd[0]]}; most captures of the flight are on that of {usual}"
        )


def test_a_band_that_all_captures_lack_is_the_usual_reference_of_none() -> None:
    result = PairTotals()
    result.add("IMG_0", with_reference("Blue", ("Red", "Green")))
    for number in range(1, 8):
        result.add(f"IMG_{number}", with_reference("Green", ("Red",)))
    (group,) = (g for g in result.groups() if g.status == "other_reference")
    assert [b.capture for b in group.bands] == ["IMG_0"]
    assert group.bands[0].reason == "on the grid of Blue; most captures of the flight are on that of Green"


def test_a_run_from_python_that_is_stopped_writes_its_pages(flight: Path, tmp_path: Path) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        agalign.align_folder(flight, tmp_path, settings=seeded("rig"), progress=stop)
    assert "THE RUN WAS STOPPED" in (tmp_path / "index.html").read_text().upper()
    assert pages_exist(tmp_path)


def test_indices_from_python_are_in_the_report(out: Path) -> None:
    agalign.indices(out)
    assert [i["name"] for i in facts_of(out)["details"]["records"][0]["indices"]] == ["ndvi"]
    properties = read_json(out / "flight.geojson")["features"][0]["properties"]
    assert properties["indices"] == ["0000SET/000/IMG_0001_ndvi.tif"]
    record = facts_of(out)["details"]["records"][0]
    assert properties["ndvi_median"] == record["indices"][0]["median"]
    assert properties["expected_error_px"] == max(b["error_px"] for b in record["bands"] if b["error_px"])
