import csv
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from agalign.capture.seeding import find_seed
from agalign.config import JointSettings, SeedSettings, Settings
from agalign.errors import ConfigurationError, InputError
from agalign.evaluation import evaluate as evaluation
from agalign.evaluation.descriptor_learning import learn_descriptor
from agalign.evaluation.image_pairs import PairFiles
from agalign.evaluation.surface import draw_surface, loss_surface
from agalign.flight.model import load_model, save_model
from agalign.method.descriptor import Descriptor
from agalign.method.learned_matches import (
    match_seed,
    matching_network,
    sift_keypoints,
    starter_for_matching,
    visible_in_both,
)
from agalign.method.paper import Training
from agalign.method.patches import patch_positions
from agalign.values import geometry
from agalign.values.issues import NO_SUCH_SEED, Issue

from ..builders import in_full_run, pair_of, texture, two_views, whole
from ..program import agalign_here

pytestmark = pytest.mark.slow

TRUTH = np.array([[1.004, 0.006, 6.0], [-0.005, 0.998, -4.0], [4e-6, -6e-6, 1.0]])


def write_pair(folder: Path, matrix: np.ndarray, seed: int, *size_px: int) -> PairFiles:
    paths = folder / f"{seed}a.png", folder / f"{seed}b.png"
    for path, one in zip(paths, two_views(matrix, *size_px, seed=seed), strict=True):
        cv2.imwrite(str(path), (np.clip(one.pixels * 40 + 128, 1, 254)).astype(np.uint8))
    return PairFiles(f"pair {seed}", "textures", *paths, matrix)


# ---- the protocol


def test_average_precision_counts_nearest_neighbours() -> None:
    f = torch.eye(4)
    assert evaluation.average_precision(f, f) == 1.0
    assert evaluation.average_precision(f, f[[1, 0, 2, 3]]) == 0.5
    assert math.isnan(evaluation.average_precision(f[:0], f[:0]))


def test_homography_error_is_the_mean_over_the_matches() -> None:
    points = geometry.lattice(100, 80, 5, 4)
    assert evaluation.homography_error_px(TRUTH @ geometry.translation(0, 0), TRUTH, points) == 0
    assert evaluation.homography_error_px(geometry.translation(3, 4), np.eye(3), points) == pytest.approx(5)


def test_keypoints_with_a_patch_outside_an_image_do_not_count() -> None:
    fixed, moving = two_views(geometry.translation(120.0, 0.0))
    keypoints = sift_keypoints(fixed)
    kept = visible_in_both(keypoints, geometry.translation(120.0, 0.0), fixed, moving)
    assert 0 < len(kept) < len(keypoints)
    assert patch_positions(kept)[..., 0].max() <= 399 - 120


def test_sift_and_daisy_of_a_mosaic_are_those_of_single_patches() -> None:
    fixed = texture()
    keypoints = sift_keypoints(fixed, maximum=30)
    patches = evaluation.grey_patches(fixed, patch_positions(keypoints, 64))
    alone = torch.cat([evaluation.sift_of_patches(p[None]) for p in patches])
    together = evaluation.sift_of_patches(patches)
    assert torch.cosine_similarity(alone, together).min() > 0.98
    result = evaluation.daisy_of_patches(patches)
    assert torch.cosine_similarity(result[7], evaluation.daisy_of_patches(patches[7:8])[0], dim=0) > 0.99


@pytest.mark.parametrize("name", ["sift", in_full_run("daisy"), "mean.pt@32"])
def test_hand_made_descriptors_find_copies_and_nothing_in_unrelated_images(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A TorchScript module of means over cells is one of them."""
    monkeypatch.chdir(tmp_path)
    with torch.no_grad():
        means = torch.nn.Sequential(torch.nn.AvgPool2d(4), torch.nn.Flatten(), torch.nn.LayerNorm(64))
        torch.jit.trace(means, torch.zeros(2, 1, 32, 32)).save("mean.pt")
    fixed, other = texture(), texture(seed=5)
    keypoints = visible_in_both(sift_keypoints(fixed, maximum=200), np.eye(3), fixed, fixed)
    for moving, low, high in ((fixed, 0.95, 1.0), (other, 0.0, 0.05)):
        describe, _ = evaluation.method_named(name).apply(fixed, moving, np.eye(3))
        assert describe is not None
        assert low <= evaluation.average_precision(*describe(keypoints, np.eye(3))) <= high
    with pytest.raises(InputError, match=r"mean\.pt: not a TorchScript module of 64 x 64 patches"):
        evaluation.method_named("mean.pt@64")


@pytest.mark.full
def test_sift_is_evaluated_once_with_its_own_homography(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 5)
    image = cv2.imread(str(pair.fixed), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(pair.moving), cv2.warpPerspective(image, TRUTH, image.shape[::-1]))
    starts = evaluation.Starts((0.05, 0.1), directions=2)
    (result,) = evaluation.evaluate([pair], {"sift": evaluation.method_named("sift")}, starts)
    assert result.error_px < 0.1
    assert list(evaluation.evaluate([pair], {"sift": evaluation.method_named("sift")}, starts, earlier=[result])) == []


def test_ecc_is_evaluated_from_each_start(tmp_path: Path) -> None:
    pair, starts = write_pair(tmp_path, TRUTH, 5), evaluation.Starts((0.0, 0.01))
    image = cv2.imread(str(pair.fixed), cv2.IMREAD_GRAYSCALE)
    moving = cv2.warpPerspective(image, TRUTH, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    cv2.imwrite(str(pair.moving), moving)
    results = list(evaluation.evaluate([pair], {"ecc": evaluation.method_named("ecc")}, starts))
    assert len(results) == 2
    assert max(result.error_px for result in results) < 0.1


def test_a_start_without_a_result_is_not_left_out_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a method that fails from most starts would have the best row."""
    found = iter([TRUTH, None, None])
    monkeypatch.setattr(evaluation, "homography_by_ecc", lambda *_: next(found))
    monkeypatch.setattr(evaluation, "homography_by_sift", lambda *_: None)
    methods = {name: evaluation.method_named(name) for name in ("ecc", "sift")}
    methods["descriptors"] = evaluation.Method(lambda *_: (None, None), has_homography=False)
    pair = write_pair(tmp_path, TRUTH, 1, 160, 128)
    results = list(evaluation.evaluate([pair], methods, evaluation.Starts((0.05,), directions=3)))
    evaluation.write_results(tmp_path / "table.csv", results)
    rows = evaluation.error_table(evaluation.read_results(tmp_path / "table.csv"))
    columns = [rows[0].index(name) for name in ("method", "median error, px", "under 1 px")]
    assert [[row[c] for c in columns] for row in rows[1:]] == [["ecc", "inf", "1 of 3"], ["sift", "inf", "0 of 1"]]


def test_starts_have_the_requested_error() -> None:
    starts = list(evaluation.Starts((0.0, 0.1), directions=4).of(TRUTH, 400, np.random.default_rng(0)))
    assert [share for share, _, _ in starts] == [0.0, 0.1, 0.1, 0.1, 0.1]
    shifts = [geometry.apply(geometry.compose(geometry.invert(TRUTH), m), [[0.0, 0.0]])[0] for _, _, m in starts]
    np.testing.assert_allclose([np.hypot(*s) for s in shifts], [0, 40, 40, 40, 40], atol=1e-9)
    np.testing.assert_allclose(sum(shifts[1:]), 0, atol=1e-9)


def test_names_of_methods(tmp_path: Path) -> None:
    for name in ("surf", "fast", "fast:twins"):
        known = "sift, daisy, ecc, elastix, fast:siamese, fast:pseudo-siamese, fast:unshared, scratch:"
        with pytest.raises(ConfigurationError, match=f"unknown method '{name}'; choose from {known}"):
            evaluation.method_named(name)
    for name, message in (("none.pt", r"none\.pt: not a TorchScript module"), ("none.safetensors", r"none\.safe")):
        with pytest.raises(InputError, match=message):
            evaluation.method_named(str(tmp_path / name))


@pytest.mark.full
def test_the_loss_is_least_at_the_truth(tmp_path: Path) -> None:
    fixed, moving = two_views(TRUTH)
    settings = JointSettings(recipe="paper", device="cpu")
    offsets = np.array([-40.0, 0.0, 40.0])
    surface = loss_surface(fixed, moving, TRUTH, offsets, settings, Training(keypoints=400, epochs=1))
    assert np.unravel_index(np.nanargmin(surface), surface.shape) == (1, 1)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_the_picture_of_a_surface_can_be_read(tmp_path: Path, suffix: str) -> None:
    draw_surface(np.random.default_rng(0).random((5, 5)), np.linspace(-40, 40, 5), tmp_path / f"surface{suffix}")
    assert cv2.imread(str(tmp_path / f"surface{suffix}")).shape == (552, 552, 3)


# ---- learning from pairs


UNRELATED = texture(seed=70), texture(seed=71)
ON_CPU = Settings(joint=JointSettings(device="cpu"))


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pairs = [pair_of(*two_views(TRUTH, seed=k)) for k in (1, 2)]
    path = tmp_path_factory.mktemp("learnt") / "learnt.safetensors"
    save_model(learn_descriptor([*pairs, pair_of(*UNRELATED)], ON_CPU, steps_a_pair=30), path)
    return path


@pytest.mark.full
def test_a_learned_descriptor_works_on_an_unseen_pair(learnt: Path, tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 9)
    methods = {name: evaluation.method_named(name) for name in (str(learnt), "sift")}
    ours, sift = evaluation.evaluate([pair], methods, evaluation.Starts())
    assert ours.average_precision > 0.7
    assert ours.average_precision > sift.average_precision


def test_nothing_aligned_is_nothing_to_learn_from() -> None:
    blank = pair_of(texture(), whole(np.zeros((320, 400), np.float32)))
    with pytest.raises(InputError, match="no pair could be aligned"):
        learn_descriptor([blank], ON_CPU)
    colour = pair_of(whole(np.stack([texture().pixels] * 3)), texture())
    with pytest.raises(InputError, match="different channels"):
        learn_descriptor([blank, colour], ON_CPU)


# ---- matching


def turned(angle_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    about = geometry.translation(200, 160) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return about @ geometry.translation(-170, -130)


@pytest.mark.parametrize("network", ["starter", in_full_run("learnt")])
def test_matching_finds_rotated_and_distant_images(network: str, request: pytest.FixtureRequest) -> None:
    truth, net = turned(25.0), starter_for_matching((1, 1))
    if network == "learnt":
        model = load_model(request.getfixturevalue("learnt"), lambda: torch.device("cpu"))
        net = matching_network(model.net, 1, (1, 1))
    result = match_seed(net, *two_views(truth, seed=4))
    assert result is not None
    points = geometry.lattice(400, 320, 8, 8)[20:44]
    assert np.median(np.linalg.norm(geometry.apply(result, points) - geometry.apply(truth, points), axis=1)) < 2


def test_matching_finds_nothing_in_unrelated_images() -> None:
    assert match_seed(starter_for_matching((1, 1)), *UNRELATED) is None
    result = find_seed(pair_of(*UNRELATED), SeedSettings(force="match"))
    assert result == Issue(NO_SUCH_SEED, detail="match")


# ---- the commands


@pytest.mark.parametrize("text", ["pair,group,method", "pair,group,method,shift\n"])
def test_a_table_of_another_version_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "rows.csv").write_text(text)
    with pytest.raises(ConfigurationError, match=r"rows\.csv: is not a table of this version"):
        evaluation.read_results(tmp_path / "rows.csv")


@pytest.mark.full
def test_a_descriptor_learned_on_a_pair_beats_sift_with_reversed_contrast(tmp_path: Path) -> None:
    write_pair(tmp_path, TRUTH, 3)
    table, numbers = tmp_path / "pairs.csv", " ".join(f"{v}" for v in TRUTH.ravel())
    table.write_text(f"fixed,moving,homography\n3a.png,3b.png,{numbers}\n")
    methods = "-m", "fast:pseudo-siamese", "-m", "sift"
    done = agalign_here("evaluate", table, *methods, "-o", tmp_path / "rows.csv", "--device", "cpu")
    assert done.returncode == 0, done.stderr
    ours, sift = csv.DictReader((tmp_path / "rows.csv").read_text().splitlines())
    assert float(ours["average_precision"]) > max(0.8, float(sift["average_precision"]))
    assert float(ours["error_px"]) < 0.3
    assert sift["error_px"] == "inf"
    assert "Mean average precision" in done.stdout
    assert re.findall(r"^│ (\S+)", done.stdout, re.MULTILINE) == 2 * ["fast:pseudo-siamese", "sift"]
    lines = [line for line in done.stderr.splitlines() if line.startswith("[1/1] 3a 3b, ")]
    assert ["sift" in line for line in lines] == [False, True]
    # A command that was killed while it wrote a row continues there.
    rows = tmp_path / "rows.csv"
    whole = rows.read_text()
    rows.write_text(whole[:-5])
    done = agalign_here("evaluate", table, *methods, "-o", rows, "--device", "cpu")
    assert "1 result of an earlier command kept" in done.stderr
    assert "[1/1] 3a 3b, fast" not in done.stderr
    without_times = [[line.rpartition(",")[0] for line in text.splitlines()] for text in (whole, rows.read_text())]
    assert without_times[0] == without_times[1]
    rows.write_text("pair,group,method,shift\n")
    assert agalign_here("evaluate", table, "-o", rows).returncode == 2
    for wrong in ("evaluate -m surf", "evaluate --shift far", "learn --sharing twins", "surface -o picture"):
        command, *options = wrong.split()
        assert agalign_here(command, table, *options).returncode == 2


@pytest.mark.full
def test_learn_writes_a_network_and_reports_its_pairs(tmp_path: Path) -> None:
    write_pair(tmp_path, TRUTH, 3)
    write_pair(tmp_path, turned(25.0), 4)
    cv2.imwrite(str(tmp_path / "blank.png"), np.zeros((320, 400), np.uint8))
    table, network = tmp_path / "pairs.csv", tmp_path / "net.safetensors"
    table.write_text("fixed,moving\n3a.png,3b.png\n4a.png,4b.png\n3a.png,blank.png\n")
    done = agalign_here("learn", table, "-o", network, "--steps", "5", "-v")
    assert done.returncode == 0, done.stderr
    assert "3a 3b: aligned" in done.stderr
    assert "4a 4b: aligned" in done.stderr
    assert "learned from 2 of 3 pairs" in done.stderr
    assert load_model(network, lambda: torch.device("cpu")).camera is None


def test_an_unshared_network_keeps_its_own_trunk_when_it_matches() -> None:
    learnt = Descriptor("unshared", (1, 1), half_rectified=True, unit_length=True)
    patches = torch.randn(4, 1, 16, 16)
    torch.testing.assert_close(matching_network(learnt, 1, (1, 1))(patches, 1), learnt(patches, 1))
