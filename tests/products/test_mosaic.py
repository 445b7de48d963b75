"""Mosaics of captures with known true positions on one ground."""

import json
import math
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_flights.aligned import GPS_ERROR_M, GSD_M, LATITUDE, LENS, LONGITUDE, SIZE_PX, make_overlapping

import agalign
from agalign.pixels.raster import transformed
from agalign.products.mosaic.adjustment import TiePair, adjusted, misfit_m, tie_pairs
from agalign.products.mosaic.placement import PlacedFlight, Placement, place_captures
from agalign.products.run.flight_map import utm_wkt
from agalign.values import geometry, lens
from agalign.values.files import scratch_file

from ..builders import in_full_run
from ..conftest import Shared, write_band
from ..program import agalign_here


@pytest.fixture(scope="module")
def survey(shared: Shared) -> Path:
    """Nine overlapping captures, with the errors of GPS and attitude."""
    return shared("survey", lambda folder: np.savez(folder / "truth.npz", **make_overlapping(folder)))


def p95_m(captures: list[Placement], truth: dict[str, np.ndarray]) -> float:
    """Of the distances of points of all captures from the truth, after the similarity that fits all of them best."""
    px = geometry.lattice(*SIZE_PX, 4, 4)
    placed = np.concatenate([c.on_ground(px) for c in captures]) @ (1, 1j)
    undistorted = lens.undistort(LENS, px)
    true = np.concatenate([geometry.apply(truth[c.label], undistorted) for c in captures]) @ (1, 1j)
    design = np.stack([placed, np.ones_like(placed)], axis=1)
    return float(np.percentile(np.abs(design @ np.linalg.lstsq(design, true)[0] - true), 95))


@dataclass(frozen=True)
class Ties:
    """The captures of the survey by their georeference and by tie points, and the truth."""

    flight: PlacedFlight
    used: list[TiePair]
    checks: list[TiePair]
    placed: list[Placement]
    truth: dict[str, np.ndarray]
    """{label: pixels to metres east and north of the survey's origin}."""


@pytest.fixture(scope="module")
def ties(survey: Path) -> Ties:
    flight = place_captures(survey)
    used, checks = map(list, zip(*(pair.split() for pair in tie_pairs(flight.captures)), strict=True))
    return Ties(flight, used, checks, adjusted(flight.captures, used), dict(np.load(survey / "truth.npz")))


def test_tie_points_place_captures_to_a_pixel_and_do_not_move_the_whole(ties: Ties) -> None:
    assert p95_m(ties.flight.captures, ties.truth) > 1.5
    assert p95_m(ties.placed, ties.truth) < GSD_M
    assert misfit_m(ties.checks, ties.placed)[0] < 0.2 * GSD_M
    assert misfit_m(ties.checks, ties.flight.captures)[0] > 1.0
    # No tie point is both used and a check.
    for used, check in zip(ties.used, ties.checks, strict=True):
        assert not set(map(tuple, used.first_px)) & set(map(tuple, check.first_px))
    # Tie points are relative: the mean of the GPS positions stays.
    centre = (np.array([SIZE_PX], float) - 1) / 2
    origin_m = transformed(np.array([[LONGITUDE, LATITUDE]]), "EPSG:4326", utm_wkt(LONGITUDE, LATITUDE))[0]
    off_m = [c.on_ground(centre)[0] - geometry.apply(ties.truth[c.label], centre)[0] for c in ties.placed]
    assert np.linalg.norm(np.mean(off_m, axis=0) + ties.flight.origin_m - origin_m) < 2 * GPS_ERROR_M


def test_the_positions_determine_the_scale_if_the_height_is_assumed(ties: Ties) -> None:
    double = []
    for capture in ties.flight.captures:
        back, to_camera = (geometry.translation(*(sign * capture.camera_m)) for sign in (1, -1))
        to_ground, std = back @ np.diag((2, 2, 1)) @ to_camera @ capture.to_ground, capture.pose_std
        wrong = {"height_m": 2 * capture.height_m, "accuracy_m": 30.0, "pose_std": (*std[:2], 0.5, *std[3:])}
        double.append(replace(capture, to_ground=to_ground, **wrong))
    placed = adjusted(double, [pair.split()[0] for pair in tie_pairs(double)])
    assert np.median([c.gsd_m for c in placed]) == pytest.approx(GSD_M, rel=0.35)
    assert p95_m(placed, ties.truth) < GSD_M


def test_wrong_matches_of_a_pair_do_not_move_the_others(ties: Ties) -> None:
    first, *others = ties.used
    wrong = replace(first, second_px=first.second_px + np.array([25.0, -15.0]))
    assert p95_m(adjusted(ties.flight.captures, [wrong, *others]), ties.truth) < GSD_M


@pytest.fixture(scope="module")
def written(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> agalign.MosaicReport:
    return agalign.mosaic(survey, tmp_path_factory.mktemp("mosaic") / "field.tif", indices=["ndvi"])


def test_the_mosaic_is_a_cog_with_all_bands(written: agalign.MosaicReport) -> None:
    assert (written.captures, written.untied, written.left_out) == (9, [], [])
    with rasterio.open(written.path) as field:
        assert field.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert field.overviews(1)
        assert field.descriptions == ("Green", "Red", "NIR", "Red edge")
        assert (field.tags(3)["wavelength"], field.tags()["RADIOMETRY"]) == ("842", "reflectance")
        assert field.crs.to_epsg() == 32631
        assert field.transform.a == -field.transform.e == pytest.approx(GSD_M, rel=0.03)
        assert np.isnan(field.nodata)
        assert float(field.tags()["MISFIT_BETWEEN_CAPTURES_M"]) == pytest.approx(written.misfit_m[0], abs=1e-3)
        bands = field.read()
    assert np.isfinite(bands).all(axis=0).mean() > 0.8
    with rasterio.open(written.path.with_name("field_ndvi.tif")) as index:
        assert index.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        ndvi = index.read(1)
    np.testing.assert_allclose(ndvi, (bands[2] - bands[1]) / (bands[2] + bands[1]), rtol=1e-5)


def test_the_mosaic_shows_the_ground(written: agalign.MosaicReport, ties: Ties) -> None:
    """Each capture, resampled to the mosaic by its refined placement, has the values of the mosaic, seams included."""
    with rasterio.open(written.path) as field:
        bands = field.read()
        to_px = np.array(~field.transform).reshape(3, 3)
    for capture in ties.placed:
        px = geometry.lattice(*SIZE_PX, 30, 20).round()
        x, y = np.floor(geometry.apply(to_px, capture.on_ground(px) + ties.flight.origin_m)).astype(int).T
        with rasterio.open(capture.bands[0].file) as stack:
            own = stack.read()[:, *px.astype(int).T[::-1]]
        inside = (x >= 0) & (y >= 0) & (x < bands.shape[2]) & (y < bands.shape[1])
        own, of_mosaic = own[:, inside], bands[:, y[inside], x[inside]]
        known = np.isfinite(of_mosaic).all(axis=0)
        assert known.mean() > 0.9
        correlation = [np.corrcoef(a, b)[0, 1] for a, b in zip(own[:, known], of_mosaic[:, known], strict=True)]
        assert min(correlation) > 0.9


def test_whole_numbers_keep_their_type_and_holes_are_filled(survey: Path, tmp_path: Path) -> None:
    """Pixels that one capture lacks are those of another; what no capture shows is nodata."""
    shutil.copytree(survey, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "0000SET").glob("*.tif"):
        with rasterio.open(path) as stack:
            values, names = stack.read(), stack.descriptions
        if path.stem == "IMG_0005":
            values[2, 100:140, 140:180] = 0
        write_band(path, (values * 40000).astype(np.uint16), nodata=0)
        with rasterio.open(path, "r+") as stack:
            stack.descriptions = names
    done = agalign_here("mosaic", tmp_path, "-o", tmp_path / "field.tif", "--gsd", "0.2", "-i", "ndvi")
    assert done.returncode == 0, done.stderr
    assert "raw numbers" in done.stderr
    with rasterio.open(tmp_path / "field.tif") as field:
        assert (field.dtypes[0], field.nodata, field.transform.a) == ("uint16", 0, 0.2)
        bands = field.read()
    assert 0 < (bands[0] == 0).mean() < 0.3
    assert bands[0][bands[0] > 0].min() > 3000
    height, width = bands.shape[1:]
    assert (bands[:, height // 3 : -height // 3, width // 3 : -width // 3] > 0).all()


def test_the_command_writes_the_same_and_states_the_misfit(
    written: agalign.MosaicReport, survey: Path, tmp_path: Path
) -> None:
    with scratch_file(tmp_path / "field.tif") as left:
        pass
    left.touch()  # as a mosaic that is killed leaves it: the next one locks the folder and removes it
    done = agalign_here("mosaic", survey, "-o", tmp_path / "field.tif", "-i", "ndvi")
    assert (done.returncode, done.stderr) == (0, "")
    text = " ".join(done.stdout.split())
    assert "Position on the map: accurate to 6.0 m, as the georeference of a capture; no ground control" in text
    assert "tie points that were not used: median 0.0" in text
    assert "Misfit between captures, by the georeference: median" in text
    assert "Mosaic of 9 captures" in text
    assert sorted(os.listdir(tmp_path)) == ["field.tif", "field_ndvi.png", "field_ndvi.tif"]
    for name in os.listdir(tmp_path):
        assert (tmp_path / name).read_bytes() == written.path.with_name(name).read_bytes(), name


def with_changed_entry(part: str = "properties", **changes: Any) -> Callable[[Path], None]:
    """A change of the last capture in the flight map."""

    def change(out: Path) -> None:
        content = json.loads((out / "flight.geojson").read_text())
        content["features"][-1][part].update(changes)
        (out / "flight.geojson").write_text(json.dumps(content))

    return change


DAMAGED = "IMG_0009: left out: its entry in flight.geojson is damaged; run again with --overwrite"
NO_FOOTPRINT = "IMG_0009: left out: it has no footprint in flight.geojson"
NONE_PLACED = "because flight.geojson has no footprints; they need position, altitude, yaw and focal length in the tags"


@pytest.mark.parametrize(
    ("change", "arguments", "code", "said"),
    [
        (with_changed_entry(height_m=[]), (), 3, DAMAGED),
        in_full_run(with_changed_entry(height_m=1e308), (), 3, DAMAGED),
        in_full_run(with_changed_entry(accuracy_m=-1), (), 3, DAMAGED),
        in_full_run(with_changed_entry(longitude=1e308), (), 3, "IMG_0009: left out: "),
        (with_changed_entry(sidecar="../x.json"), (), 3, NO_FOOTPRINT),
        in_full_run(with_changed_entry("geometry", coordinates=[[[1e308, 0]] * 5]), (), 3, NO_FOOTPRINT),
        (with_changed_entry(accuracy_m=math.nan), (), 1, NONE_PLACED),
        (lambda out: (out / "flight.geojson").unlink(), (), 1, NONE_PLACED),
        (None, ("--gsd", "0.0001"), 2, "pixels, which is too many; increase --gsd"),
        (None, ("-i", "nonsense"), 2, "unknown index 'nonsense'"),
        (None, ("-o", "0000SET/IMG_0001.tif"), 2, "give the mosaic a new file that ends in .tif"),
        (None, ("-o", "field.png"), 2, "give the mosaic a new file that ends in .tif"),
    ],
)
def test_errors_are_one_line(
    survey: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[Path], None] | None,
    arguments: tuple[str, ...],
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(survey, tmp_path, dirs_exist_ok=True)
    if change is not None:
        change(tmp_path)
    before = (tmp_path / "0000SET" / "IMG_0001.tif").read_bytes()
    done = agalign_here("mosaic", ".", *arguments)
    assert done.returncode == code, done.stderr
    (line,) = done.stderr.splitlines()
    assert said in line
    assert (tmp_path / "0000SET" / "IMG_0001.tif").read_bytes() == before
    assert (tmp_path / "mosaic.tif").exists() == (code == 3)


def without_texture(survey: Path, out: Path, *numbers: int) -> Path:
    """A copy of the survey, in which captures show one colour and so have no tie points."""
    shutil.copytree(survey, out)
    for number in numbers:
        with rasterio.open(out / "0000SET" / f"IMG_{number:04d}.tif", "r+") as stack:
            stack.write(np.full_like(stack.read(), 0.25))
    return out


@pytest.mark.full
def test_captures_without_tie_points_to_the_largest_group_are_left_out(survey: Path, tmp_path: Path) -> None:
    """The contrast of two captures is reversed, so that they match each other only; another one has no texture."""
    out, labels = without_texture(survey, tmp_path / "out", 9), [f"0000SET/IMG_000{number}" for number in (7, 8, 9)]
    for label in labels[:2]:
        with rasterio.open(out / f"{label}.tif", "r+") as stack:
            stack.write(0.6 - stack.read())

    def shows_the_last(path: Path) -> bool:
        with rasterio.open(path) as field:
            return bool(np.isclose(field.read(1), 0.25, atol=1e-4).any())

    report = agalign.mosaic(out, tmp_path / "field.tif")
    untied = "it has no tie points to those of the mosaic; --untied places it by its georeference"
    assert (report.captures, report.left_out) == (6, [(label, untied) for label in labels])
    assert not shows_the_last(report.path)
    done = agalign_here("mosaic", out, "-o", tmp_path / "all.tif", "--untied")
    assert done.returncode == 0
    place = "placed by the georeference, accurate to 6 m"
    assert f"3 captures without tie points to the others: {place}: {', '.join(labels)}" in " ".join(done.stderr.split())
    # The pair of 7 and 8 is not in the misfit of the six others.
    assert f"Misfit between captures, {report.pairs + 1} overlaps, " in done.stdout
    assert shows_the_last(tmp_path / "all.tif")


def test_nothing_is_written_of_captures_that_do_not_match(survey: Path, tmp_path: Path) -> None:
    out = without_texture(survey, tmp_path / "out", *range(1, 10))
    done = agalign_here("mosaic", out, "-o", tmp_path / "field.tif")
    assert done.returncode == 1
    assert "is not written, because no capture has tie points to another; --untied places them" in done.stderr
    assert not (tmp_path / "field.tif").exists()
    done = agalign_here("mosaic", out, "-o", tmp_path / "field.tif", "--untied")
    assert done.returncode == 0
    assert "Misfit" not in done.stdout


@pytest.mark.full
def test_threads_leave_the_filters_of_warnings_alone(survey: Path) -> None:
    before = list(warnings.filters)
    captures = place_captures(survey).captures
    for _ in range(3):
        tie_pairs(captures)
    assert warnings.filters == before


@pytest.mark.real
@pytest.mark.full
def test_a_real_strip_has_a_fifth_of_the_misfit(real_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    flight = real_data / "flights" / "rededge_m_rowcrop"
    done = agalign_here("align", flight, "-o", out, "--ground-elevation", "92", "--relief", "never")
    assert done.returncode == 0, done.stderr
    report = agalign.mosaic(out, tmp_path / "field.tif")
    assert [label for label, _ in report.left_out] == ["IMG_0007"]
    assert (report.captures, report.pairs) == (3, 3)
    assert report.misfit_m[0] < 0.2 * report.georeference_misfit_m[0]
    assert report.misfit_m[0] < 0.06
