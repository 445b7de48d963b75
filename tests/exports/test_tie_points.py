"""Tie points are measured: they match the truth even where the alignment that they are measured under does not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CloughTocher2DInterpolator

import agalign
from agalign.cameras.discover import discover
from agalign.capture.align_bands import align_capture_bands, tie_windows
from agalign.exports.tie_points import _geojson
from agalign.synthetic.flight import make_flight
from agalign.values.capture import Georeference

from ..conftest import read_json, seeded
from ..run_outputs import table_in


def tie_errors(report: agalign.CaptureReport, flight: Path) -> dict[str, np.ndarray]:
    """{band: distance (n,) of its tie points from the truth, px; nan outside of the known points}."""
    truth = read_json(flight / "truth.json")[report.path.stem]["bands"]
    rows, result = table_in(report.path.with_suffix(".ties.csv")), {}
    for band in report.sidecar.bands:
        if band.status == "reference":
            continue
        ties = np.array(truth[Path(band.file).name]["ties"])
        known = CloughTocher2DInterpolator(ties[:, :2], ties[:, 2:])
        reference, moving = (
            np.array([[float(r[f"{side}_{axis}_px"]) for axis in "xy"] for r in rows if r["band"] == band.band])
            for side in ("reference", "moving")
        )
        result[band.band] = np.linalg.norm(known(reference) - moving, axis=1)
    return result


@pytest.mark.slow
def test_tie_points_match_the_truth_where_the_alignment_is_off(flight: Path, tmp_path: Path) -> None:
    bands = ("Green", "Red", "NIR")
    (report, *_) = agalign.align_folder(
        flight, tmp_path, settings=seeded("rig", tie_points=True), options=agalign.DiscoverOptions(bands=bands)
    )
    rows = table_in(report.path.with_suffix(".ties.csv"))
    errors_px = tie_errors(report, flight)
    for band in report.sidecar.bands:
        own = [r for r in rows if r["band"] == band.band]
        if band.status == "reference":
            assert own == []
            continue
        assert len(own) > 8
        assert np.nanmedian(errors_px[band.band]) < 0.3
        # By its tags alone the band is off by more than that.
        assert np.median([float(r["residual_px"]) for r in own]) > 0.6
        assert np.median([float(r["weight"]) for r in own]) == pytest.approx(1.0, abs=1e-2)
    features = read_json(report.path.with_suffix(".ties.geojson"))["features"]
    assert [f["properties"]["band"] for f in features] == [r["band"] for r in rows]
    x, y = features[0]["geometry"]["coordinates"]
    assert (x, y) == (float(rows[0]["reference_x_px"]) + 0.5, -float(rows[0]["reference_y_px"]) - 0.5)


def test_bands_without_the_tags_of_the_forced_seed_have_tie_points(flight: Path) -> None:
    """They are aligned by the model of the flight."""
    capture = discover(flight).captures[0]
    bare = replace(capture, bands=tuple(replace(b, to_rig=None, other_to_rig=None) for b in capture.bands))
    settings = agalign.Settings(seed=agalign.SeedSettings(only=True))
    alignments = align_capture_bands(capture, settings, None, lambda *_: None)
    assert tie_windows(bare, alignments).keys() == alignments.keys()


@pytest.mark.full
def test_tie_points_of_aligned_bands_are_accurate(tmp_path: Path) -> None:
    make_flight(tmp_path / "in", captures=2, size_px=(1280, 960), rng_seed=3)
    settings = agalign.Settings(write=agalign.WriteSettings(tie_points=True))
    errors_px: list[np.ndarray] = []
    for report in agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=settings):
        assert {b.status for b in report.sidecar.bands} == {"reference", "aligned"}
        errors_px += tie_errors(report, tmp_path / "in").values()
    assert len(errors_px) == 8
    # The truth is known between its own points only; tie points are single windows.
    assert all(np.isfinite(e).sum() > 50 and np.nanmedian(e) < 0.07 for e in errors_px)
    assert np.nanmedian(np.concatenate(errors_px)) <= 0.06


def test_points_of_a_georeferenced_image_are_in_degrees() -> None:
    transform = np.array([[10.0, 0.0, 500_000.0], [0.0, -10.0, 5_000_000.0], [0.0, 0.0, 1.0]])
    point = ("NIR", "aligned", [9.5, 19.5, 9.6, 19.4, 0.14, 1.0])
    result = json.loads(_geojson([point], Georeference(transform, "EPSG:32633")))
    assert result["coordinates_in"] == "EPSG:4326"
    # 100 m east of the central meridian, 15 degrees east, and 200 m south of 5,000 km north.
    assert result["features"][0]["geometry"]["coordinates"] == pytest.approx([15.00127, 45.15169], abs=1e-4)
    assert json.loads(_geojson([], None))["features"] == []
