"""The benchmark of band pairs: its scorer on known homographies, its sets, and how it treats methods."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bands import score
from bands.images import VARIANTS, degraded, locate, read
from bands.results import VOTED, add_results, comparison, read_results, with_predicted, with_range
from bands.run import asked, by_vote, claim, lens_corrected, mapped_by, write_mappings
from common import read_ties
from figures_csv import Provenance
from opendronemap import SOURCE, matrix_of_pair, voted_matrices
from peers import METHODS, WEIGHTS, Mapped, Rated, UnavailableError, method_named, sift
from synthetic_flights.aligned import sidecar_of

from agalign.cameras.discover import discover
from agalign.records.sidecar import GridPart
from agalign.values import geometry

from ..conftest import raising

pytestmark = pytest.mark.full

TRUE = np.array([[1.01, 0.02, 30.0], [-0.015, 0.99, -12.0], [1e-5, 2e-5, 1.0]])
TIES_PX = np.stack(np.meshgrid(np.arange(40.0, 600, 40), np.arange(40.0, 440, 40)), axis=-1).reshape(-1, 2)


def shifted(dx: float, dy: float) -> np.ndarray:
    return np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]]) @ TRUE


@pytest.fixture
def sets() -> dict[str, Any]:
    """One set of two captures with two bands each and exact truth."""
    there = score.apply(TRUE, TIES_PX)
    inside = ((there >= 0) & (there <= (639, 479))).all(axis=1)
    ties = {"ties": np.hstack([TIES_PX, there])[inside].tolist()}
    captures = {c: {"reference": f"{c}_g.png", "pairs": {f"{c}_{b}.png": ties for b in "rn"}} for c in "12"}
    files = {f"{c}_{b}.png": {"size_px": [640, 480]} for c in "12" for b in "grn"}
    return {"field": {"set": "field", "files": files, "captures": captures}}


@pytest.fixture
def pair(sets: dict[str, Any]) -> score.Pair:
    return score.pairs_of(sets["field"])[0]


def grid_of(matrix: np.ndarray, here: np.ndarray) -> dict[str, Any]:
    return {"reference_px": here.tolist(), "moving_px": score.apply(matrix, here).tolist()}


def row(file: str, **values: Any) -> dict[str, Any]:
    return {"method": "m", "set": "field", "capture": file[0], "file": file, **values}


def test_the_error_of_a_known_homography_and_of_its_grid_is_exact(pair: score.Pair) -> None:
    by_homography = score.errors_px({"homography": shifted(0.3, 0.4).tolist()}, pair)
    assert by_homography == pytest.approx(0.5, abs=1e-9)
    by_grid = score.errors_px({"grid": grid_of(shifted(0.6, 0.8), geometry.lattice(640, 480, 33, 25))}, pair)
    assert np.median(by_grid) == pytest.approx(1.0, abs=1e-3)


def test_the_area_outside_a_grid_counts_as_wrong(sets: dict[str, Any]) -> None:
    here = np.array([[0, 0], [200, 0], [200, 200], [0, 200], [100, 100.0]])
    (first, *_) = score.score_pairs([row("1_r.png", grid=grid_of(TRUE, here))], sets)
    assert first.median_px == np.inf
    assert score.summary([first])[0].wrong_claims == 1


def test_wrong_claims_refusals_and_estimates_without_a_claim_are_counted_apart(sets: dict[str, Any]) -> None:
    rows = [
        row("1_r.png", homography=shifted(0.1, 0).tolist()),
        row("1_n.png", homography=shifted(7, 0).tolist()),
        row("2_r.png"),
        row("2_n.png", homography=shifted(9, 0).tolist(), claimed="no"),
    ]
    (result,) = score.summary(score.score_pairs(rows, sets))
    assert (result.pairs, result.claimed, result.wrong_claims, result.refused, result.unclaimed) == (4, 2, 1, 1, 1)
    assert (result.under_half_px, result.under_1_px) == (0.25, 0.25)
    assert (result.median_px, result.worst_px, result.unclaimed_median_px) == pytest.approx((3.55, 7.0, 9.0))
    assert "| m | 4 | 2 | **1** | 1 | 1 (9.00 px) | 25% |" in score.markdown([result])


def test_missing_pairs_are_refused_and_unknown_pairs_raise(sets: dict[str, Any]) -> None:
    one = row("1_r.png", homography=TRUE.tolist())
    (result,) = score.summary(score.score_pairs([one], sets))
    assert (result.claimed, result.refused) == (1, 3)
    for rows, problem in (
        ([one, one], "two rows"),
        ([row("1_x.png")], "no such pair"),
        ([{**one, "set": "moon"}], "no set"),
        ([row("1_r.png", homography="1 2 3")], "no mapping"),
    ):
        with pytest.raises(ValueError, match=problem):
            score.score_pairs(rows, sets)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_written_mappings_are_read_again(sets: dict[str, Any], tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"mine{suffix}"
    rows = [row("1_r.png", homography=shifted(0, 0.25).tolist(), variant="turn 10", seconds=0.5), row("1_n.png")]
    if suffix == ".csv":
        write_mappings(rows, path)
    else:
        path.write_text(json.dumps(rows))
    turned, plain = score.summary(score.score_pairs(score.read_results(path), sets))
    assert (turned.variant, turned.pairs, turned.seconds) == ("turn 10", 2, 0.5)
    assert (plain.variant, plain.refused) == (score.AS_IT_IS, 4)


def test_the_scorer_does_not_import_agalign() -> None:
    code = "import sys, score; print(any(m.split('.')[0] in ('agalign', 'cv2', 'torch') for m in sys.modules))"
    folder = Path(score.__file__).parent
    assert subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True).stdout == "False\n"


@pytest.mark.parametrize("variant", ["turn 3", "turn 20", "scale 0.8"])
def test_an_image_moves_as_its_truth_does(pair: score.Pair, variant: str) -> None:
    y, x = np.mgrid[:480, :640]
    image = (60000 * np.exp(-((x - 400.0) ** 2 + (y - 150.0) ** 2) / 50)).astype(np.uint16)
    result = degraded(image, pair, variant).astype(float)
    centre = np.array([(result * x).sum(), (result * y).sum()]) / result.sum()
    (there,) = score.apply(score.movement(variant, (640, 480)), np.array([[400.0, 150.0]]))
    assert centre == pytest.approx(there, abs=0.02)


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_are_the_same_in_every_run_and_keep_size_and_type(pair: score.Pair, variant: str) -> None:
    image = np.random.default_rng(1).integers(1, 60000, (480, 640)).astype(np.uint16)
    image[:50] = 0
    one, other = (degraded(image, pair, variant) for _ in range(2))
    assert np.array_equal(one, other)
    assert (one.shape, one.dtype) == (image.shape, image.dtype)
    assert np.array_equal(one, image) == (variant in ("as it is", "lens-corrected"))


@pytest.mark.parametrize("name", sorted(score.read_sets()))
def test_a_set_is_sound(name: str) -> None:
    assert (score.SETS / f"{name}.json").stat().st_size < 200_000
    description = score.read_sets()[name]
    assert description["set"] == name
    assert {"camera", "difficulty", "published", "convention", "truth", "truth_std_px"} <= set(description)
    for entry in description["files"].values():
        assert re.fullmatch("[0-9a-f]{64}", entry["sha256"])
        assert entry["bytes"] > 0
    for pair in score.pairs_of(description):
        assert 30 < len(pair.reference_px) <= 400
        w, h = description["files"][pair.reference]["size_px"]
        assert ((pair.reference_px >= 0) & (pair.reference_px <= (w - 1, h - 1))).all()
    assert all(score.pairs_of(description, variant) for variant in VARIANTS)


@pytest.mark.real
def test_the_images_are_those_of_the_checksums(real_data: Path) -> None:
    sets = score.read_sets()
    located, missing = locate(real_data, sets)
    assert not missing
    assert {name: len(paths) for name, paths in located.items()} == {n: len(s["files"]) for n, s in sets.items()}


def test_images_that_are_not_there_are_named(tmp_path: Path) -> None:
    sets = score.read_sets()
    file = next(iter(sets["p4m_forest"]["files"].values()))
    (tmp_path / "as large.TIF").write_bytes(bytes(file["bytes"]))
    located, missing = locate(tmp_path, sets)
    assert not located
    assert len(missing["p4m_forest"]) == 5


def test_a_method_that_raises_has_refused(pair: score.Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {name: tmp_path / name for name in (pair.reference, pair.file)}
    for path in paths.values():
        cv2.imwrite(str(path), np.full((480, 640), 9, np.uint8))
    assert asked(raising(RuntimeError("out of luck")), pair, score.AS_IT_IS, paths, {}) == {}
    assert "refused (RuntimeError: out of luck)" in capsys.readouterr().err
    result = asked(lambda _f, _m: Rated(np.eye(3), 7.0), pair, score.AS_IT_IS, paths, {})
    assert (result["homography"], result["rating"]) == (np.eye(3).tolist(), 7.0)


def test_a_method_is_loaded_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("def align(fixed, moving):\n    return None\n")
    assert method_named(f"{path}:align")(np.eye(3), np.eye(3)) is None
    for name in ("no such method", f"{tmp_path}/other.py:align"):
        with pytest.raises(UnavailableError):
            method_named(name)


def test_a_limit_is_chosen_on_the_other_half_of_the_pairs(sets: dict[str, Any]) -> None:
    """Pairs 1_r and 2_r are one half, 1_n and 2_n the other, whose highest rating of a wrong claim is 6."""
    rows = [
        row("1_r.png", homography=TRUE.tolist(), rating=5),
        row("2_r.png", homography=TRUE.tolist(), rating=7),
        row("1_n.png", homography=shifted(9, 0).tolist(), rating=6),
        row("2_n.png", homography=TRUE.tolist(), rating=2),
    ]
    limited = score.limited(score.score_pairs(rows, sets), sets)
    assert {(s.file, s.claimed) for s in limited} == {
        ("1_r.png", False),
        ("2_r.png", True),
        ("1_n.png", True),
        ("2_n.png", True),
    }
    assert {s.method for s in limited} == {"m, with a limit"}


def test_results_are_added_and_those_of_another_version_removed(
    sets: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, order = tmp_path / "results.csv", [("m", score.AS_IT_IS), ("m", "turn 10")]
    plain = score.score_pairs([row("1_r.png", homography=TRUE.tolist(), seconds=0.5)], sets)
    turned = score.score_pairs([row("1_r.png", variant="turn 10")], sets)
    add_results(path, turned, order)
    assert [r.variant for r in add_results(path, plain, order)] == [score.AS_IT_IS] * 4 + ["turn 10"] * 2
    assert read_results(path)[0].median_px == 0
    monkeypatch.setattr("bands.results.Provenance.of", lambda _: Provenance("later", "other"))
    assert {r.commit for r in add_results(path, plain, order)} == {"later"}
    assert len(read_results(path)) == 4
    (first, *_) = comparison(read_results(path), {"field": {**sets["field"], "published": {}}})
    assert (first.table, first.name, first.n) == ("comparison, originals", "m", "4 pairs")
    assert first.cells == {
        "accepted": "1",
        "wrong": "0",
        "accepted within 0.5 px": "1",
        "median error, px": "0.000",
        "CPU time, s": "0.5",
    }


@pytest.mark.parametrize("name", ["ALIKED + MAGSAC", "ALIKED + LightGlue"])
def test_the_weights_of_aliked_are_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("peers._NEEDS", {})
    monkeypatch.delenv(WEIGHTS, raising=False)
    with pytest.raises(UnavailableError, match="set ALIKED_WEIGHTS to a folder with aliked-n16"):
        method_named(name)


@pytest.mark.parametrize("name", ["ECC, identity", "ECC, agalign's start", "MicaSense"])
def test_ecc_finds_a_small_shift_and_rates_it(name: str) -> None:
    fixed = cv2.GaussianBlur(np.random.default_rng(2).uniform(0, 60000, (240, 320)), (0, 0), 3)
    fixed = (1 + 60000 * (fixed - fixed.min()) / np.ptp(fixed)).astype(np.uint16)
    moving = cv2.warpAffine(fixed, np.array([[1, 0, 3.0], [0, 1, -2.0]]), (320, 240), borderMode=cv2.BORDER_REFLECT)
    tags = ({"identity": np.eye(3)},) if name != "ECC, identity" else ()
    result = METHODS[name](fixed, moving, *tags)
    assert result.fixed_to_moving[:2, 2] == pytest.approx([3, -2], abs=0.1)
    assert 0.8 < result.rating <= 1


def test_sift_has_no_bias_after_half_a_turn() -> None:
    """OpenCV's key points are off by a quarter of a pixel without precise upscaling."""
    rng = np.random.default_rng(1)
    noise = sum(cv2.resize(rng.normal(size=(n, n)), (400, 400), interpolation=cv2.INTER_CUBIC) for n in (25, 50, 100))
    fixed = (128 + 30 * noise).clip(1, 255).astype(np.uint8)
    result = sift(fixed, np.ascontiguousarray(fixed[::-1, ::-1]))
    there = geometry.apply(result.fixed_to_moving, np.array([[200.0, 200.0]]))
    assert there == pytest.approx(np.array([[199.0, 199.0]]), abs=0.05)


def test_only_what_is_called_aligned_is_claimed() -> None:
    corners = [[0, 0], [1, 0], [0, 1]]
    grid = GridPart(reference_px=corners, moving_px=corners)
    band = sidecar_of("IMG_0001", 1, (160, 120), raw=False).bands[1].model_copy(update={"grid": grid})
    claims = {s: claim(band.model_copy(update={"status": s})) for s in ("aligned", "predicted", "seed_only", "failed")}
    assert (claims["aligned"]["claimed"], claims["predicted"]["claimed"]) == ("yes", "no")
    assert claims["seed_only"] == claims["failed"] == claim(None) == {}


def test_lens_corrected_images_are_scored_between_raw_pixels(flight: Path) -> None:
    truth = read_ties(flight / "truth.json")["IMG_0001_4.tif"]
    bands = {b.path.name: b for c in discover(flight).captures for b in c.bands}
    both = [(read(bands[name].path), bands[name]) for name in (truth["reference"], "IMG_0001_4.tif")]
    result = lens_corrected(lambda _f, _m: np.array(truth["fixed_to_moving"]), *both)
    here, there = np.hsplit(np.array(truth["ties"]), 2)
    pair = score.Pair("synthetic", "1", truth["reference"], "IMG_0001_4.tif", here, there, both[1][1].size_px)
    assert np.median(score.errors_px(result, pair)) < 0.02


def test_a_mapping_that_is_no_homography_is_scored_as_it_is(pair: score.Pair) -> None:
    """Its displacement varies along x with a period of 640 px, which no homography has."""

    def bent(points_px: np.ndarray) -> np.ndarray:
        return score.apply(TRUE, points_px) + 2 * np.sin(points_px[:, :1] / 100) * [0.6, 0.8]

    image = np.zeros((480, 640), np.uint8)
    row = mapped_by(lambda _f, _m: Mapped(bent, False, 0.4), image, image)
    assert (row["claimed"], row["std_px"]) == ("no", 0.4)
    assert score.errors_px(row, pair) == pytest.approx(2 * np.abs(np.sin(pair.reference_px[:, 0] / 100)), abs=2e-3)


def test_predictions_with_a_small_standard_error_are_counted_apart(sets: dict[str, Any], tmp_path: Path) -> None:
    rows = [
        row("1_r.png", homography=TRUE.tolist(), variant="blur 3 px", claimed="no", std_px=0.9),
        row("1_n.png", homography=shifted(3, 0).tolist(), variant="blur 3 px", claimed="no", std_px=1.1),
    ]
    results = add_results(tmp_path / "results.csv", score.score_pairs(rows, sets), [])
    assert [(r.claimed, r.std_px) for r in results] == [(False, 0.9), (False, 1.1)]
    assert [(r.method, r.claimed) for r in with_predicted(results)] == [
        ("m, with predicted", True),
        ("m, with predicted", False),
    ]


def test_runs_of_a_method_are_one_row_with_their_range(sets: dict[str, Any], tmp_path: Path) -> None:
    rows = [
        row(file, homography=shifted(error_px, 0).tolist(), method=f"{VOTED}, run {number}")
        for number, error_px in enumerate((0.1, 0.3, 1.2), 1)
        for file in ("1_r.png", "1_n.png", "2_r.png", "2_n.png")
    ]
    results = add_results(tmp_path / "results.csv", score.score_pairs(rows, sets), [])
    *_, by_set = comparison(results, {"field": {**sets["field"], "published": {}}})
    assert (by_set.table, by_set.name, by_set.n) == ("OpenDroneMap", "field", "4 pairs")
    assert by_set.cells["flight: median, px"] == "0.300 (0.100-1.200)"
    assert by_set.cells["flight: beyond 1 px"] == "0 (0-4)"
    assert with_range(["-", "-"]) == "-"


# ---- OpenDroneMap

needs_opendronemap = pytest.mark.skipif(SOURCE not in os.environ, reason=f"needs {SOURCE}")


def shifted_pair(dx: float, dy: float) -> tuple[np.ndarray, np.ndarray]:
    """Return an image, and another one in which its content is at another place, by (dx, dy) px."""
    noise = np.random.default_rng(3).normal(size=(6, 480, 640)).astype(np.float32)
    scene = sum(
        sigma**2 * cv2.GaussianBlur(n, (0, 0), sigma) for n, sigma in zip(noise, (1, 2, 3, 4, 6, 9), strict=True)
    )
    fixed = (60000 * (scene - scene.min()) / np.ptp(scene)).astype(np.uint16)
    moving = cv2.warpAffine(fixed, np.float64([[1, 0, dx], [0, 1, dy]]), (640, 480), borderMode=cv2.BORDER_REFLECT)
    return fixed, moving


def test_a_matrix_of_opendronemap_is_inverted(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenDroneMap warps the moving image by it, so that it maps pixels of the moving image."""
    to_fixed = np.array([[1, 0, -5], [0, 1, 3], [0, 0, 1.0]])
    fixed, moving = shifted_pair(5, -3)
    difference = cv2.absdiff(cv2.warpPerspective(moving, to_fixed, (640, 480)), fixed)
    assert not difference[10:-10, 10:-10].any()
    fake = type("multispectral", (), {"compute_homography": staticmethod(lambda *_: (to_fixed, None, "feat"))})
    monkeypatch.setattr("opendronemap._multispectral", lambda: fake)
    there = score.apply(matrix_of_pair(fixed, moving), np.array([[100.0, 100.0]]))
    assert there == pytest.approx(np.array([[105.0, 97.0]]))
    with pytest.raises(ValueError, match="not implemented"):
        matrix_of_pair(fixed, moving[::2, ::2])


def test_the_source_of_opendronemap_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SOURCE, raising=False)
    with pytest.raises(UnavailableError, match="set ODM_SOURCE to the path of a checkout"):
        method_named("OpenDroneMap, capture")
    with pytest.raises(UnavailableError):
        by_vote({}, {}, [], score.AS_IT_IS)


@needs_opendronemap
def test_opendronemap_finds_a_known_shift() -> None:
    fixed, moving = shifted_pair(7, -4)
    there = score.apply(matrix_of_pair(fixed, moving), TIES_PX)
    assert there == pytest.approx(TIES_PX + np.array([7, -4]), abs=0.3)


@needs_opendronemap
def test_captures_vote_for_the_matrix_of_opendronemap() -> None:
    """The third capture has another shift and scale, which no other has."""
    fixed, moving = shifted_pair(7, -4)
    other = cv2.warpAffine(moving, np.array([[1.05, 0, 9], [0, 1.05, 9.0]]), (640, 480))
    images = {f"{n}_{band}.tif": image for n in "123" for band, image in (("g", fixed), ("n", moving))}
    images["3_n.tif"] = other
    bands = {file: {"g": "Green", "n": "NIR"}[file[2]] for file in images}
    references = {file: file.replace("n", "g", 1) for file in images if "n" in file}
    matrices = voted_matrices(images, bands, references)
    assert list(matrices) == ["NIR"]
    assert score.apply(matrices["NIR"], TIES_PX) == pytest.approx(TIES_PX + np.array([7, -4]), abs=0.3)
    with pytest.raises(ValueError, match="aligns to Green, and not to NIR"):
        voted_matrices(images, bands, {reference: file for file, reference in references.items()})
