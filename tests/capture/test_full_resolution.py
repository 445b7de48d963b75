"""Alignments of reduced images that are refined on the files."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import tifffile

from agalign.batch.capture_task import quiet
from agalign.cameras.discover import discover
from agalign.capture import full_resolution
from agalign.capture.align_bands import CaptureEstimation, align_capture_bands
from agalign.capture.band_pair import BandPair
from agalign.capture.by_rig import RigPrediction
from agalign.capture.candidate import BandCandidates, Candidate, mapping_error
from agalign.capture.decision import decide
from agalign.capture.full_resolution import at_full_resolution
from agalign.capture.reference import Reference
from agalign.capture.warped_pair import WarpedPair
from agalign.config import JointSettings, Settings
from agalign.errors import UnreadableFileError
from agalign.fit import window_fit
from agalign.fit.held_out import chessboard
from agalign.flight.rig import distance_px
from agalign.pixels.raster import open_raster
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction, Seed
from agalign.values.capture import Capture
from agalign.values.choices import FamilyChoice, Geometry
from agalign.values.geometry import PairScales
from agalign.values.image import Tile
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.residual import Residual

from ..builders import joint_result, residual_of, two_views, whole

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]

SIZE, HALF_PX = (1000, 800), (500, 400)
SEED = Seed("identity", np.eye(3), 30.0)
TRUTH = np.array([[1.002, 0.004, 12.4], [-0.003, 0.999, -7.7], [1e-6, -1e-6, 1.0]])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("large")
    green, nir = (view.pixels for view in two_views(TRUTH, *SIZE))
    for name, image in {"green": green, "nir": nir, "red": nir}.items():
        tifffile.imwrite(folder / f"field_{name}.tif", (30000 + 4000 * image).astype(np.uint16), metadata=None)
    return discover(folder).captures[0]


@pytest.fixture(scope="module")
def pair(capture: Capture) -> BandPair:
    """Images of half the size of the files."""
    reference, nir = capture.reference, capture.moving[0]
    images = [whole(cv2.resize(rasterio.open(b.path).read(1), HALF_PX).astype(np.float32)) for b in (reference, nir)]
    scales = PairScales.of((SIZE, SIZE), (HALF_PX, HALF_PX))
    seeds = {"identity": np.eye(3)}
    return BandPair("nir", Reference(images[0]), images[1], seeds, (nir,), scales, is_lens_known=True)


def on_reduced_images(pair: BandPair, **joint: Any) -> Candidate:
    """An alignment of reduced images with an error of several px of the files."""
    off = geometry.compose(TRUTH, geometry.translation(1.2, -0.6))
    windows = residual_of(geometry.lattice(*HALF_PX, 12, 9) * 0.9 + np.array(HALF_PX) * 0.05, (0.0, 0.0))
    result = joint_result(pair.scales.between_images(off), std_px=1.0, covariance=0.001 * np.eye(8), **joint)
    mapping = pair.mapping(result.fixed_to_moving)
    error = mapping_error(pair, mapping, result.covariance_px2, windows)
    return Candidate(pair, mapping, error, windows, result)


def refined(capture: Capture, start: Candidate) -> Candidate:
    result = at_full_resolution(capture.reference, start)
    assert isinstance(result, Candidate)
    return result


def in_files(*candidates: Candidate, of_rig: Prediction | None = None) -> Alignment:
    """The alignment between the files with these candidates."""
    pair = candidates[0].pair
    predictions = {} if of_rig is None else {"nir": RigPrediction(pair, of_rig)}
    result = decide([BandCandidates(pair, SEED, None, list(candidates))], (), predictions)
    return result["nir"].in_file_px(pair.scales, SIZE)


def test_bands_are_refined_on_the_files_and_one_with_an_unreadable_tile_fails(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    resample_tile = full_resolution.resample_tile

    def unreadable(band: Any, *rest: Any, **options: Any) -> Any:
        if band.name == "nir":
            raise UnreadableFileError(f"{band.path}: cannot be read (tile 7); copy it from the card again")
        return resample_tile(band, *rest, **options)

    monkeypatch.setattr(full_resolution, "resample_tile", unreadable)
    for module in ("band_pair", "reference"):
        monkeypatch.setattr(f"agalign.capture.{module}.LONGEST_SIDE_PX", 400)
    result = align_capture_bands(capture, Settings(joint=JointSettings(device="cpu")), None, lambda *_: None)
    assert {name: a.status for name, a in result.items()} == {"nir": "failed", "red": "aligned"}
    assert "field_nir.tif: cannot be read (tile 7)" in (result["nir"].reason or "")
    assert geometry.corner_error_px(result["red"].fixed_to_moving, TRUTH, *SIZE) < 0.2
    assert result["red"].residual.centres_px.max() > 700  # px of the file


@pytest.mark.parametrize(("family", "is_refined"), [("auto", True), ("translation", False)])
def test_a_kind_of_mapping_that_the_user_chose_is_not_refined_to_a_homography(
    capture: Capture, pair: BandPair, family: FamilyChoice, is_refined: bool
) -> None:
    settings = Settings(joint=JointSettings(model_family=family, device="cpu"))
    start = on_reduced_images(pair)
    bands = {"nir": BandCandidates(pair, SEED, None, [start])}
    estimation = CaptureEstimation(settings, None, quiet, bands=bands)
    result = estimation._refine_on_files(estimation.decided(), capture)["nir"]
    assert result.status == "aligned"
    assert (result.mapping is not start.mapping) is is_refined


def test_each_tile_has_a_chessboard_of_its_windows(capture: Capture) -> None:
    """Adjacent windows have different colours wherever a tile is, and none have the same cell."""
    reference, moving = capture.reference, capture.moving[0]
    tiles = {(0, 0): Tile(30, 10, 360, 330), (1, 0): Tile(400, 10, 360, 330), (0, 1): Tile(30, 450, 360, 330)}
    with open_raster(reference.path, reference.page) as source:
        chosen = [(cell, tile, full_resolution._windows(source, reference, tile)) for cell, tile in tiles.items()]
    residual = full_resolution._residual(moving, PixelMapping(TRUTH), chosen)
    assert len(np.unique(residual.cells, axis=0)) == len(residual.cells) > 20
    apart = np.abs(residual.centres_px[:, None] - residual.centres_px).sum(axis=2)
    first, second = np.nonzero((apart > 0) & (apart < 1.5 * residual.spacing_px))  # neighbours in a row or a column
    assert len(first) > 40
    colours = chessboard(residual).numbers
    assert (colours[first] != colours[second]).all()
    in_first, in_second = (
        (residual.centres_px >= (t.x0, t.y0)) & (residual.centres_px < (t.x0 + t.width, t.y0 + t.height))
        for t in list(tiles.values())[:2]
    )
    assert residual.cells[in_second.all(axis=1), 0].min() - residual.cells[in_first.all(axis=1), 0].max() == 1


def test_windows_of_neighbouring_tiles_are_adjacent_however_large_the_file_is(capture: Capture) -> None:
    """Tiles that are far apart are neighbours too: a misaligned area between them is in both."""
    reference, moving = capture.reference, capture.moving[0]
    tiles = {(3, 0): Tile(30, 10, 360, 330), (4, 0): Tile(600, 10, 360, 330)}
    with open_raster(reference.path, reference.page) as source:
        chosen = [(cell, tile, full_resolution._windows(source, reference, tile)) for cell, tile in tiles.items()]
    columns = full_resolution._residual(moving, PixelMapping(TRUTH), chosen).cells[:, 0]
    assert sorted(set(columns)) == list(range(columns.min(), columns.max() + 1))


def test_a_refinement_that_fails_verification_leaves_the_earlier_result(capture: Capture, pair: BandPair) -> None:
    good = on_reduced_images(pair)
    assert good.issues == ()
    better = in_files(good, refined(capture, good))
    assert geometry.corner_error_px(better.fixed_to_moving, TRUTH, *SIZE) < 0.05
    assert better.joint.corner_std_px < 0.1
    assert better.residual.centres_px.max() > 700
    unsure = refined(capture, on_reduced_images(pair, retrieval=0.05))
    assert unsure.issues != ()
    kept = in_files(good, unsure)
    assert kept.status == "aligned"
    np.testing.assert_allclose(kept.fixed_to_moving, in_files(good).fixed_to_moving)


def test_the_displacement_field_of_the_reduced_images_continues_by_chance_far_from_tiles(
    capture: Capture, pair: BandPair
) -> None:
    start = on_reduced_images(pair)
    nodes = np.zeros((9, 11, 2))
    nodes[..., 0] = 0.5 * np.sin(np.arange(11))
    p95_px: dict[Geometry, float] = {"homography": 0.9, "field": 0.4}
    field = DisplacementField(50.0, nodes)
    bent = replace(start, mapping=replace(start.mapping, field=field), held_out_p95_px=p95_px)
    result = refined(capture, bent)
    error = result.error
    assert error.field_std_px == pytest.approx(0.35, abs=0.05)  # 0.5 / sqrt(2)
    assert error.lens_std_px is None
    assert result.held_out_p95_px == p95_px


@pytest.mark.parametrize(
    ("shift_px", "issues"), [((0.0, 0.0), set()), ((1.8, 0.0), {"inaccurate", "close_windows", "cluster"})]
)
def test_windows_that_the_displacement_field_is_not_fitted_to_verify_it_after_tiles_too(
    capture: Capture, pair: BandPair, shift_px: tuple[float, float], issues: set[str]
) -> None:
    flat = on_reduced_images(pair)
    bent = replace(flat, mapping=replace(flat.mapping, field=DisplacementField(50.0, np.zeros((9, 11, 2)))))
    # The start is off by (1.2, -0.6) px of the files, by which the windows seem to be at rest.
    start_px = bent.residual.shifts_px + np.array([-0.6, 0.3]) + np.array(shift_px)
    start = replace(bent, residual=bent.residual.with_shifts(start_px))
    assert {issue.kind.code for issue in refined(capture, start).issues} == issues


def test_areas_without_data_do_not_count_in_georeferenced_files(capture: Capture, pair: BandPair) -> None:
    image = pair.reference.image
    left = Reference(replace(image, valid=image.valid & (np.arange(HALF_PX[0]) < HALF_PX[0] // 2)))
    known = on_reduced_images(replace(pair, reference=left, seed_matrices={"geo": np.eye(3)}))
    start = Candidate.of(WarpedPair.of(known.pair, known.mapping), known.joint)
    assert refined(capture, start).common_px[:, 0].max() < HALF_PX[0] // 2


def test_each_window_is_verified_by_a_fit_that_shares_no_pixel_with_it(
    capture: Capture, pair: BandPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[Residual] = []
    fit_windows = window_fit.fit_windows

    def recorded(mapping: PixelMapping, residual: Residual, *rest: Any, **named: Any) -> Any:
        fitted.append(residual)
        return fit_windows(mapping, residual, *rest, **named)

    monkeypatch.setattr(window_fit, "fit_windows", recorded)
    residual = in_files(refined(capture, on_reduced_images(pair))).residual
    assert len(residual.centres_px) > 100
    assert len(np.unique(residual.cells, axis=0)) == len(residual.cells)  # windows of several tiles have own cells
    for fold, of_fit in enumerate(fitted[-2:]):
        verified = residual.where(chessboard(residual).numbers == fold)
        apart = np.abs(verified.centres_px[:, None] - of_fit.centres_px[None]).max(axis=-1)
        assert apart.min() >= 50  # the side of the windows: five in each of four tiles


def test_a_refinement_is_compared_with_the_prediction_of_the_rig(capture: Capture, pair: BandPair) -> None:
    expected, elsewhere = (geometry.compose(TRUTH, geometry.translation(off_px, 0.0)) for off_px in (0.5, 4.0))
    good = on_reduced_images(pair)
    candidates = good, refined(capture, good)
    result = in_files(*candidates, of_rig=Prediction(expected, "bands", 0.4))
    assert result.prediction.off_px == pytest.approx(distance_px(result.fixed_to_moving, expected, SIZE))
    assert result.prediction.off_px == pytest.approx(0.5, abs=0.05)
    contradicted = in_files(*candidates, of_rig=Prediction(elsewhere, "bands", 0.2))
    # The result on the reduced images does not contradict it, and stays.
    assert contradicted.status == "aligned"
    np.testing.assert_allclose(contradicted.fixed_to_moving, in_files(good).fixed_to_moving)


def test_each_tile_of_the_reference_is_read_once(
    capture: Capture, pair: BandPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: Counter[Any] = Counter()
    read_tile = full_resolution.read_tile

    def counted(band: Any, tile: Any, dataset: Any) -> Any:
        if band.name == capture.reference.name:
            reads[tile] += 1
        return read_tile(band, tile, dataset)

    monkeypatch.setattr(full_resolution, "read_tile", counted)
    refined(capture, on_reduced_images(pair))
    assert len(reads) >= 8
    assert set(reads.values()) == {1}


def test_an_unreadable_reference_is_an_error_of_the_capture(capture: Capture, pair: BandPair, tmp_path: Path) -> None:
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    reference = replace(capture.reference, path=tmp_path / "broken.tif")
    with pytest.raises(UnreadableFileError, match=r"broken\.tif"):
        at_full_resolution(reference, on_reduced_images(pair))
