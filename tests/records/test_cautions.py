"""What to check before the results of a run are used: one list, which report, tables, console and log print."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_flights.aligned import make_aligned

from agalign.cameras.discover import discover
from agalign.cameras.metadata import exposed_after_s
from agalign.cli.terminal import Terminal, explain
from agalign.flight.rig_file import model_fingerprint
from agalign.rasters.alignment_maps import error_map, error_shares
from agalign.records.cautions import Caution, RunFacts
from agalign.records.panels_and_sky import PanelPart
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import read_sidecar, write_sidecar
from agalign.report.pages import write_pages
from agalign.report.pair_totals import PairTotals
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Band, CameraIdentity
from agalign.values.image import OutputGrid, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.remedies import BLURRED, TEXTURELESS
from agalign.values.residual import Residual

from ..conftest import read_json, save_known_model
from ..run_outputs import indices_of, table_in
from .test_sidecar import NIR, example

ALIGNED = NIR | {"status": "aligned", "reason": None}
IDENTITY = np.eye(3).tolist()


def cautions(band: dict[str, Any] | None = None, run: RunFacts | None = None, **changes: Any) -> list[Caution]:
    """The cautions about a capture with one moving band."""
    return list((run or RunFacts()).cautions(example(bands=[ALIGNED | (band or {})], **changes)))


def prediction(std_px: float, off_px: float | None = None) -> dict[str, Any]:
    return {"fixed_to_moving": IDENTITY, "from": "bands", "std_px": std_px, "off_px": off_px}


def panel(captured_at: str = "", **scales: float) -> PanelPart:
    bands = [
        {"band": name, "file": "", "area_px": [], "albedo": 0.5, "radiance": 1.0, "reflectance_per_radiance": 0.5}
        | {"sensor_scale": scale, "problem": None}
        for name, scale in scales.items()
    ]
    facts = {"folder": ".", "capture": "P", "captured_at": captured_at, "seen_by": "tags", "serial": "", "picture": ""}
    return PanelPart.model_validate(facts | {"fits_sensor": False, "bands": bands})


def issue(kind: str) -> list[dict[str, Any]]:
    return [{"kind": kind, "value": 0.02, "limit": 0.5}]


def predicted(std_px: float, kind: str, **facts: Any) -> dict[str, Any]:
    """The facts about a band that is predicted with this error."""
    known = {"status": "predicted", "reason": "", "issues": issue(kind), "prediction": prediction(std_px)}
    return known | {"error": {"std_px": std_px, "std_band_px": std_px}} | facts


OUTPUT = {"file": "a.tif", "crop": (0, 0, 10, 8), "nodata": None}


def reflectance_by(source: str, bands: tuple[str, ...] = ("Green", "NIR"), **facts: Any) -> dict[str, Any]:
    """The part of a sidecar about bands with reflectance."""
    of_band = {"quantity": "reflectance", "source": source, "std_percent": 3.0, "errors": []}
    return OUTPUT | {"band_radiometry": [of_band | {"band": name} for name in bands]} | facts


def test_a_good_band_needs_no_check() -> None:
    good = {"prediction": prediction(0.1, 0.2), "share_over_1_px": 0.005, "saturated": 0.001, "moved_share": 0.0005}
    output = reflectance_by("panel", panel_age_s=600.0)
    assert cautions(good, output=output) == []


@pytest.mark.parametrize(
    ("band", "reason", "lost", "size"),
    [
        ({"share_over_1_px": 0.25}, "25% of the pixels may be off by more than 1 px", 0.25, "up to 25% of a band"),
        ({"moved_share": 0.007}, "0.7% of it shows something that moved or is near", 0.007, "up to 0.7% of a band"),
        # What moved is not said again as a large error.
        ({"moved_share": 0.04, "share_over_1_px": 0.045}, "4.0% of it shows", 0.04, "up to 4.0% of a band"),
        ({"saturated": 0.125}, "12.5% of the pixels are saturated", 0.125, "up to 12.5% of a band"),
        ({"prediction": prediction(0.1, 7.42)}, "its own image is aligned 7.4 px of", 0.5, "up to 7.4 px of the band"),
        ({"status": "failed", "reason": "it is blank", "issues": issue("coverage")}, "it is blank", 1.0, ""),
        (predicted(0.02, "retrieval", reason="dim"), "dim", 0.5, "expected error up to 0.02 px"),
        (predicted(0.4, "cluster", share_over_1_px=0.125), "", 0.125, "expected error up to 0.40 px"),
        (predicted(4.0, "cluster"), "", 1.0, "expected error up to 4.00 px"),
        (
            predicted(0.88, "coverage", error={"std_px": 12.55, "std_band_px": 0.88}),
            "",
            0.0,
            "expected error up to 12.55 px of the reference (0.88 px of the band)",
        ),
    ],
)
def test_each_kind_has_its_size_and_its_effect(band: dict[str, Any], reason: str, lost: float, size: str) -> None:
    (caution,) = cautions(band)
    assert caution.reason.startswith(reason)
    assert caution.lost == pytest.approx(lost)
    assert caution.size_text == size


def test_an_error_of_the_prediction_explains_the_distance_from_it() -> None:
    assert cautions({"prediction": prediction(1.0, 2.9)}) == []
    assert cautions({"prediction": prediction(0.01, 0.9)}) == []


def test_a_predicted_band_has_other_advice_than_a_failed_one() -> None:
    band = {"status": "predicted", "reason": "", "issues": issue("retrieval"), "prediction": prediction(0.02)}
    (caution,) = cautions(band)
    assert caution.remedy == BLURRED
    (caution,) = cautions(band | {"status": "failed"})
    assert caution.remedy == TEXTURELESS


@pytest.mark.parametrize(("apart_s", "advice"), [(30.0, "look at the times in the tags"), (0.28, "fly higher")])
def test_the_advice_fits_the_time_between_exposures(apart_s: float, advice: str) -> None:
    (caution,) = cautions({"status": "failed", "reason": "", "issues": issue("cluster"), "exposed_after_s": apart_s})
    assert caution.remedy.advice.startswith(advice)


@pytest.mark.parametrize(
    ("kind", "apart_s", "said"), [("few_windows", -20.0, "20 s before"), ("repeats", 3.4, "3 s after")]
)
def test_the_time_between_exposures_is_the_reason(kind: str, apart_s: float, said: str) -> None:
    (caution,) = cautions(
        {"status": "failed", "reason": "too little", "issues": issue(kind), "exposed_after_s": apart_s}
    )
    assert caution.reason == f"exposed {said} the reference; too little"
    assert "exposed at different times" in caution.remedy.cause


@pytest.mark.slow
def test_the_time_between_exposures_is_that_in_the_tags(flight: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(flight / "0000SET" / "000", tmp_path / "in"))
    path = folder / "IMG_0001_4.tif"
    (capture, *_) = discover(folder).captures
    assert exposed_after_s(capture.bands[3], capture.reference) == 0
    path.write_bytes(path.read_bytes().replace(b"2026:06:21 10:00:01", b"2026:06:21 10:00:31"))
    assert exposed_after_s(capture.bands[3], capture.reference) == 30


def test_a_panel_that_contradicts_the_sensor_concerns_the_reflectance_of_its_flight() -> None:
    run = RunFacts((panel("2026-06-21T10:00:00", NIR=1.59, Green=1.0),))
    output = reflectance_by("light sensor")
    time = {"captured_at": "2026-06-21T11:00:00"}
    (caution,) = (c for c in cautions(run=run, output=output, **time) if c.band == "NIR")
    assert caution.reason == "the irradiance on the panel is 1.59 times that of the light sensor"
    assert caution.lost == pytest.approx(0.59)
    assert caution.size_text == "reflectance is uncertain by up to 59%"
    assert cautions(run=run, output=output, captured_at="2026-06-22T11:00:00") == []
    assert cautions(run=run, output=OUTPUT, **time) == []
    assert cautions(run=run, output=output, captured_at="") != [], "a clock that was not set"
    (caution, *_) = cautions(run=RunFacts((panel(NIR=0.5),)), output=output)
    assert caution.size == pytest.approx(1.0)
    other = run.panels[0].model_copy(update={"camera": CameraIdentity("MicaSense", "Altum", "AL01")})
    assert cautions(run=RunFacts((other,)), output=output, **time) == [], "a panel of another camera"


@pytest.mark.parametrize(
    "text",
    [
        "temperature by camera calibration and reflectance by panel",
        "reflectance by panel and temperature by camera calibration",
    ],
)
def test_an_old_panel_concerns_the_bands_with_reflectance_in_any_order(text: str) -> None:
    output = reflectance_by("panel", panel_age_s=3600.0)
    thermal = {"band": "LWIR", "quantity": "temperature", "source": "camera calibration", "std_percent": None}
    parts = [thermal | {"errors": []}, *output["band_radiometry"]]
    reason = "the nearest panel is 60 min away"
    found = [(c.band, c.reason) for c in cautions(output=output | {"radiometry": text, "band_radiometry": parts})]
    assert found == [("Green", reason), ("NIR", reason)]
    # An earlier version has the text only, and no part of a thermal band.
    parts = [{"band": name, "std_percent": 3.0, "errors": []} for name in ("Green", "NIR")]
    found = [(c.band, c.reason) for c in cautions(output=output | {"radiometry": text, "band_radiometry": parts})]
    assert found == [("Green", reason), ("NIR", reason)]
    assert cautions(output=OUTPUT | {"radiometry": "radiance by camera calibration", "band_radiometry": parts}) == []


@pytest.mark.parametrize(
    ("choice", "source", "said", "is_unusable"),
    [
        ("sun", "light sensor", "if the panels had the light of the flight, align again with --radiometry panel", True),
        ("panel", "panel", "if the light sensor had the light of the flight, align again with --radiometry sun", False),
        ("auto", "light sensor", "align again with --radiometry panel (the panels alone) or sun", True),
    ],
)
def test_a_contradiction_has_a_remedy_that_was_not_tried(
    choice: str, source: str, said: str, is_unusable: bool
) -> None:
    output = reflectance_by(source, panel_age_s=60.0)
    options = {"write": {"radiometry": choice}}
    (caution, *_) = cautions(run=RunFacts((panel(NIR=15.46),)), output=output, options=options)
    assert caution.size_text == "reflectance is uncertain by up to 1446%"
    assert caution.remedy.advice.startswith(said)
    assert f"--radiometry {choice}" not in caution.remedy.advice.partition(" or ")[0]
    assert caution.is_unusable == is_unusable
    (caution, *_) = cautions(run=RunFacts((panel(NIR=1.5),)), output=output, options=options)
    assert not caution.is_unusable


def test_captures_of_an_earlier_model_are_named(tmp_path: Path) -> None:
    save_known_model(tmp_path / "models" / "a.safetensors")
    run = RunFacts.of(tmp_path)
    (current,) = run.models
    assert cautions(run=run, model=current) == cautions(run=run) == cautions(model="other") == []
    (caution,) = cautions(run=run, model="other")
    assert "earlier model of the flight" in caution.remedy.cause
    assert caution.lost == 0


@pytest.mark.slow
def test_sidecars_have_the_model_and_the_share_of_uncertain_pixels(aligned_flight: Path) -> None:
    (path,) = (aligned_flight / "models").glob("*.safetensors")
    sidecar = read_sidecar(next(aligned_flight.rglob("IMG_0001.json")))
    assert sidecar.model == model_fingerprint(path)
    shares = {b.band: b.share_over_1_px for b in sidecar.bands}
    assert shares == {"Green": None, "Blue": 0.0, "Red": 0.0, "NIR": 0.0, "Red edge": 0.0}


def groups() -> Any:
    """A run with a failed band, three blurred ones, and a panel that contradicts the sensor by 10 %."""
    totals = PairTotals(RunFacts((panel(Red=1.1),)))
    output = reflectance_by("panel", ("NIR", "Red"), panel_age_s=60.0)
    blurred = predicted(0.02, "retrieval", reason="blurred")
    for number in range(3):
        red = ALIGNED | {"band": "Red"} | ({"status": "failed", "reason": "blank"} if number == 0 else {})
        totals.add(f"IMG_{number}", example(bands=[ALIGNED | blurred, red], output=output))
    return totals.groups(["IMG_3"])


def test_the_largest_effect_comes_first() -> None:
    result = groups()
    assert [g.status for g in result] == ["no_result", "predicted", "failed", "check"]
    # Of eight band images with those of the missing capture.
    assert [g.effect for g in result] == pytest.approx([2 / 8, 1.5 / 8, 1 / 8, 0.3 / 8])


def test_console_and_log_print_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    explain(groups(), Terminal())
    printed = capsys.readouterr().err
    assert printed.splitlines()[:3] == [
        "Check these, the largest effect first:",
        "agalign: IMG_3: no result: the run has no result of the capture",
        "    try: the same command resumes the run",
    ]
    assert "blur or noise in one of the bands (expected error up to 0.02 px)" in printed
    explain(groups(), Terminal(log_json=True))
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(e["status"], e["size"]) for e in lines[1:]] == [
        ("no_result", ""),
        ("predicted", "expected error up to 0.02 px"),
        ("failed", ""),
        ("check", "reflectance is uncertain by up to 10%"),
    ]
    assert lines[1]["effect"] == 0.25
    assert all(e["advice"] and e["cause"] for e in lines[1:])


def test_report_and_tables_have_what_to_check(tmp_path: Path) -> None:
    """A capture counts as `ok`, and its index is written: NDRE with a band that is blurred, NDVI without it."""
    make_aligned(tmp_path, 2)
    path = tmp_path / "0000SET" / "IMG_0001.json"
    sidecar = read_json(path)
    reason = "the descriptors do not distinguish held-out patches (retrieval 0.02)"
    for band in sidecar["bands"]:
        if band["band"] == "Red edge":
            band |= predicted(0.02, "retrieval", reason=reason)
    write_sidecar(path, Sidecar.model_validate_json(json.dumps(sidecar)))
    reports = {(r.capture, r.index): r for r in indices_of(tmp_path, "ndvi", "ndre")}
    ndre = reports["0000SET/IMG_0001", "ndre"]
    assert ndre.path is not None
    for _ in range(2):
        rows = {(r["capture"], r["index"]): r["problem"] for r in table_in(tmp_path / "indices.csv")}
        assert rows.pop(("IMG_0001", "ndre")) == f"Red edge: {reason}"
        assert [*rows.values()] == [""] * 3
        write_pages(tmp_path, pytest.fail)
    checks = {(r["capture"], r["band"]): r["check"] for r in table_in(tmp_path / "summary.csv") if r["check"]}
    assert checks == {("IMG_0001", "Red edge"): reason}
    page = (tmp_path / "index.html").read_text()
    assert page.index("Check these") < page.index("By band")
    assert "expected error up to 0.02 px" in page


def test_the_share_of_a_band_is_that_of_the_quality_raster() -> None:
    """An eighth of the image has windows with shifts of 4 px."""
    size_px = 1280, 960
    centres = np.stack(np.meshgrid(np.arange(40, 1280, 80.0), np.arange(40, 960, 80.0)), axis=-1).reshape(-1, 2)
    shifts = np.where(centres[:, :1] < 160, 3.0, 0.0) * np.ones(2)
    cells = (centres // 80).astype(int)
    residual = Residual(centres, shifts, np.full(len(centres), 50.0), cells)
    seed, error = Seed("rig", np.eye(3), 9.0), MappingError(size_px, residual=residual)
    alignment = Alignment(PixelMapping(np.eye(3)), size_px, (), seed, residual=residual, error=error)
    reference, grid = Band("Green", Path("a.tif"), 1, *size_px, "uint16"), OutputGrid(0, 0, *size_px)
    share, _ = error_shares(alignment, reference, grid)
    of_map = error_map(alignment, reference, grid).on_tile(Tile(0, 0, *size_px)) > 1
    assert share == pytest.approx(of_map.mean(), abs=0.002)
    assert 0.1 < share < 0.2


# ---- radiance and reflectance


def calibrated_output(**errors: tuple[float, str]) -> dict[str, Any]:
    parts = [{"name": name, "std_percent": size, "state": state} for name, (size, state) in errors.items()]
    return reflectance_by("light sensor", band_radiometry=[{"band": "NIR", "std_percent": 20.0, "errors": parts}])


@pytest.mark.parametrize(
    ("state", "cause"), [("missing", "lack a correction"), ("contradicted", "contradict each other"), ("expected", "")]
)
def test_what_values_are_not_corrected_for_is_a_caution(state: str, cause: str) -> None:
    found = cautions(output=calibrated_output(vignetting=(12.0, state)))
    assert [cause in c.remedy.cause for c in found] == ([True] if cause else [])
    assert [round(c.lost, 2) for c in found] == ([0.12] if cause else [])


def test_radiance_instead_of_reflectance_is_unusable_in_every_band() -> None:
    bands = [{"band": name, "std_percent": 20.0, "errors": []} for name in ("NIR", "Red")]
    thermal = {"band": "LWIR", "quantity": "temperature", "std_percent": None, "errors": []}
    output = OUTPUT | {"without_reflectance": "NIR: is negative", "band_radiometry": [thermal, *bands]}
    found = cautions(output=output)
    assert [(c.band, c.lost, c.is_unusable) for c in found] == [("NIR", 1.0, True), ("Red", 1.0, True)]
    assert {c.reason for c in found} == {"not written as reflectance: NIR: is negative"}
