import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.capture.seeding import find_seed
from agalign.cli.main import app
from agalign.config import JointSettings, SeedSettings, Settings
from agalign.errors import ConfigurationError, InputError
from agalign.evaluation.descriptor_learning import learn_descriptor
from agalign.evaluation.evaluate import (
    Starts,
    average_precision,
    daisy_of_patches,
    error_table,
    evaluate,
    grey_patches,
    homography_error_px,
    method_named,
    precision_table,
    sift_of_patches,
    write_results,
)
from agalign.evaluation.image_pairs import PairFiles
from agalign.evaluation.surface import draw_surface, loss_surface
from agalign.flight.model import load_model, save_model
from agalign.method.descriptor import Descriptor
from agalign.method.match import match_seed, matching_network, sift_keypoints, starter_for_matching, visible_in_both
from agalign.method.paper import Training
from agalign.method.patches import patch_positions
from agalign.values import geometry
from agalign.values.image import Raster
from agalign.values.issues import NO_SUCH_SEED, Issue

from ..builders import in_full_run, pair_of, texture, two_views, whole

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
    assert average_precision(f, f) == 1.0
    assert average_precision(f, f[[1, 0, 2, 3]]) == 0.5
    assert math.isnan(average_precision(f[:0], f[:0]))


def test_homography_error_is_the_mean_over_the_matches() -> None:
    points = geometry.lattice(100, 80, 5, 4)
    assert homography_error_px(TRUTH @ geometry.translation(0, 0), TRUTH, points) == 0
    assert homography_error_px(geometry.translation(3, 4), np.eye(3), points) == pytest.approx(5)


def test_keypoints_with_a_patch_outside_an_image_do_not_count() -> None:
    fixed, moving = two_views(geometry.translation(120.0, 0.0))
    keypoints = sift_keypoints(fixed)
    kept = visible_in_both(keypoints, geometry.translation(120.0, 0.0), fixed, moving)
    assert 0 < len(kept) < len(keypoints)
    assert patch_positions(kept)[..., 0].max() <= 399 - 120


def test_sift_and_daisy_of_a_mosaic_are_those_of_single_patches() -> None:
    fixed = texture()
    keypoints = sift_keypoints(fixed, maximum=30)
    patches = grey_patches(fixed, patch_positions(keypoints, 64))
    alone = torch.cat([sift_of_patches(p[None]) for p in patches])
    together = sift_of_patches(patches)
    assert torch.cosine_similarity(alone, together).min() > 0.98
    result = daisy_of_patches(patches)
    assert torch.cosine_similarity(result[7], daisy_of_patches(patches[7:8])[0], dim=0) > 0.99


@pytest.mark.parametrize("name", ["sift", in_full_run("daisy")])
def test_hand_made_descriptors_find_copies_and_nothing_in_unrelated_images(name: str) -> None:
    fixed, other = texture(), texture(seed=5)
    keypoints = visible_in_both(sift_keypoints(fixed, maximum=200), np.eye(3), fixed, fixed)
    for moving, low, high in ((fixed, 0.99, 1.0), (other, 0.0, 0.05)):
        describe, _ = method_named(name)(fixed, moving, np.eye(3))
        assert describe is not None
        assert low <= average_precision(*describe(keypoints, np.eye(3))) <= high


def test_starts_have_the_requested_error() -> None:
    starts = list(Starts((0.0, 0.1), directions=4).of(TRUTH, 400, np.random.default_rng(0)))
    assert [share for share, _ in starts] == [0.0, 0.1, 0.1, 0.1, 0.1]
    shifts = [geometry.apply(geometry.compose(geometry.invert(TRUTH), m), [[0.0, 0.0]])[0] for _, m in starts]
    np.testing.assert_allclose([np.hypot(*s) for s in shifts], [0, 40, 40, 40, 40], atol=1e-9)
    np.testing.assert_allclose(sum(shifts[1:]), 0, atol=1e-9)


def test_names_of_methods(tmp_path: Path) -> None:
    for name in ("surf", "fast:twins"):
        with pytest.raises(ConfigurationError, match=f"unknown method '{name}'"):
            method_named(name)
    for name, message in (("none.pt", r"none\.pt: not a TorchScript module"), ("none.safetensors", r"none\.safe")):
        with pytest.raises(InputError, match=message):
            method_named(str(tmp_path / name))


def test_a_torchscript_descriptor_is_evaluated(tmp_path: Path) -> None:
    path = tmp_path / "flat.pt"
    with torch.no_grad():
        flat = torch.nn.Sequential(torch.nn.AvgPool2d(4), torch.nn.Flatten(), torch.nn.LayerNorm(64))
        torch.jit.trace(flat, torch.zeros(2, 1, 32, 32)).save(str(path))
    fixed = texture()
    keypoints = visible_in_both(sift_keypoints(fixed, maximum=200), np.eye(3), fixed, fixed)
    describe, _ = method_named(f"{path}@32")(fixed, fixed, np.eye(3))
    assert describe is not None
    assert average_precision(*describe(keypoints, np.eye(3))) > 0.95
    with pytest.raises(InputError, match="64 x 64"):
        method_named(f"{path}@64")


def test_a_descriptor_learned_on_a_pair_beats_sift_with_reversed_contrast(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 3)
    methods = {name: method_named(name, device="cpu") for name in ("fast:pseudo-siamese", "sift")}
    results = list(evaluate([pair], methods, Starts((0.05,))))
    ours, sift = results
    assert ours.average_precision > 0.8
    assert ours.average_precision > sift.average_precision
    assert ours.error_px < 0.3
    assert math.isnan(sift.error_px)
    assert [row[0] for row in precision_table(results)] == ["method", "fast:pseudo-siamese", "sift"]
    assert error_table(results)[1][:2] == ["fast:pseudo-siamese", "5.0%"]
    write_results(tmp_path / "rows.csv", results)
    rows = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    assert float(rows[0]["error_px"]) == pytest.approx(ours.error_px, rel=1e-3)


@pytest.mark.full
def test_the_loss_is_least_at_the_truth(tmp_path: Path) -> None:
    fixed, moving = two_views(TRUTH)
    settings = JointSettings(recipe="paper", device="cpu")
    offsets = np.array([-40.0, 0.0, 40.0])
    surface = loss_surface(fixed, moving, TRUTH, offsets, settings, Training(keypoints=400, epochs=1))
    assert np.unravel_index(np.nanargmin(surface), surface.shape) == (1, 1)
    draw_surface(surface, offsets, tmp_path / "surface.png")
    assert cv2.imread(str(tmp_path / "surface.png")).shape == (552, 552, 3)


# ---- learning from pairs


UNRELATED = texture(seed=70), texture(seed=71)
ON_CPU = Settings(joint=JointSettings(device="cpu"))


def rough_pair(name: str, fixed: Raster, moving: Raster) -> BandPair:
    return BandPair(name, Reference(fixed), moving, {"user": np.eye(3)})


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pairs = [rough_pair(str(k), *two_views(TRUTH, seed=k)) for k in (1, 2)]
    statuses = dict[str, str]()

    model = learn_descriptor(
        [*pairs, rough_pair("unrelated", *UNRELATED)],
        ON_CPU,
        steps_a_pair=30,
        on_pair=lambda name, result: statuses.update({name: result.status}),
    )
    assert [statuses[name] == "aligned" for name in ("1", "2", "unrelated")] == [True, True, False]
    path = tmp_path_factory.mktemp("learnt") / "learnt.safetensors"
    save_model(model, path)
    return path


@pytest.mark.full
def test_a_learned_descriptor_works_on_an_unseen_pair(learnt: Path, tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 9)
    methods = {name: method_named(name) for name in (str(learnt), "sift")}
    ours, sift = evaluate([pair], methods, Starts())
    assert ours.average_precision > 0.7
    assert ours.average_precision > sift.average_precision


def test_nothing_aligned_is_nothing_to_learn_from() -> None:
    unrelated = rough_pair("u", *UNRELATED)
    with pytest.raises(InputError, match="no pair could be aligned"):
        learn_descriptor([unrelated], ON_CPU)
    colour = rough_pair("c", whole(np.stack([texture().pixels] * 3)), UNRELATED[1])
    with pytest.raises(InputError, match="different channels"):
        learn_descriptor([unrelated, colour], ON_CPU)


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


def test_evaluate_prints_tables_and_writes_rows(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 3, 240, 200)
    table = tmp_path / "pairs.csv"
    numbers = " ".join(f"{v}" for v in TRUTH.ravel())
    table.write_text(f"fixed,moving,homography\n{pair.fixed.name},{pair.moving.name},{numbers}\n")
    runner = CliRunner()
    done = runner.invoke(app, ["evaluate", str(table), "-o", str(tmp_path / "rows.csv")])
    assert done.exit_code == 0
    assert "Mean average precision" in done.stdout
    methods = [row["method"] for row in csv.DictReader((tmp_path / "rows.csv").read_text().splitlines())]
    assert methods == ["fast:siamese", "fast:pseudo-siamese", "fast:unshared", "sift"]
    assert all(done.stdout.count(name) == 2 for name in methods[:3])
    wrong = runner.invoke(app, ["evaluate", str(table), "-m", "surf"])
    assert wrong.exit_code == 2
    assert "unknown method" in wrong.stderr
    assert runner.invoke(app, ["evaluate", str(tmp_path / "none")]).exit_code == 1
    assert runner.invoke(app, ["evaluate", str(table), "--shift", "far"]).exit_code == 2
    assert runner.invoke(app, ["learn", str(table), "--sharing", "twins"]).exit_code == 2
    assert runner.invoke(app, ["surface", str(table), "-o", "picture"]).exit_code == 2


def test_learn_writes_a_network_and_reports_its_pairs(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, TRUTH, 3)
    table, network = tmp_path / "pairs.csv", tmp_path / "net.safetensors"
    table.write_text(f"fixed,moving\n{pair.fixed.name},{pair.moving.name}\n")
    done = CliRunner().invoke(app, ["learn", str(table), "-o", str(network), "--steps", "5", "-v"])
    assert done.exit_code == 0, done.output
    assert "3a 3b: aligned" in done.stderr
    assert "learned from 1 of 1 pairs" in done.stderr
    assert load_model(network, lambda: torch.device("cpu")).camera == ""


def test_an_unshared_network_keeps_its_own_trunk_when_it_matches() -> None:
    learnt = Descriptor("unshared", (1, 1), half_rectified=True, unit_length=True)
    patches = torch.randn(4, 1, 16, 16)
    torch.testing.assert_close(matching_network(learnt, 1, (1, 1))(patches, 1), learnt(patches, 1))
