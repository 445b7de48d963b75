"""One quantity: the standard error of a band, its error at points, its error map, and whether it is delivered."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_flights.depth import CLOSE_RANGE

import agalign
from agalign.batch import capture_task as batch
from agalign.capture.align_bands import CaptureEstimation
from agalign.capture.by_rig import RigPrediction
from agalign.capture.candidate import Candidate
from agalign.config import Settings
from agalign.records.captures import bands_of
from agalign.records.sidecar import BandResult, Sidecar
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values import geometry
from agalign.values.alignment import JointResult, Prediction, Seed
from agalign.values.capture import Band, Capture
from agalign.values.choices import ReliefUse
from agalign.values.geometry import Matrix
from agalign.values.issues import CLOSE_WINDOWS, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.moved_area import MovedArea
from agalign.values.pixel_units import PixelScale

from ..builders import decided, in_full_run, joint_result, pair_of, residual_of, texture
from ..capture.test_by_relief import REFERENCE, Rendered
from ..conftest import Shared
from ..rasters.test_relief_map import scene_in
from ..run_outputs import aligned

SIZE = 640, 480


def change_band(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the pixels of a file."""
    with rasterio.open(path, "r+") as dataset:
        dataset.write(change(dataset.read(1)).astype(np.uint16), 1)


def noise(pixels: np.ndarray) -> np.ndarray:
    return 20_000 + 1500 * np.random.default_rng(0).normal(size=pixels.shape)


def noisy(pixels: np.ndarray) -> np.ndarray:
    added = np.random.default_rng(3).normal(0, 0.2 * float(pixels.mean()), pixels.shape)
    return (pixels + added).clip(1, 65_000)


def saturated_at_the_right(pixels: np.ndarray) -> np.ndarray:
    result = pixels.copy()
    result[:, int(0.3 * pixels.shape[1]) :] = 65_535
    return result


def estimate_and_write(
    capture: Capture, planes: Mapping[str, Matrix], out: Path, relief: ReliefUse, lost: str = "Red"
) -> None:
    """Write a capture whose bands have these homographies, but one that is lost and that a rig predicts."""

    def results(_: CaptureEstimation, seeds: Any, *__: object) -> dict[str, JointResult]:
        known = {name: joint_result(planes[name], covariance=1e-3 * np.eye(8)) for name in seeds}
        return {name: replace(j, retrieval=0.0) if name == lost else j for name, j in known.items()}

    def predictions(estimation: CaptureEstimation, *_: object) -> dict[str, RigPrediction]:
        parallax, prediction = estimation.decided()["NIR"].mapping.parallax, Prediction(planes[lost], "bands", 0.3)
        return {lost: RigPrediction(estimation.bands[lost].pair, prediction, parallax)}

    settings = agalign.Settings(
        relief=agalign.ReliefSettings(use=relief), write=agalign.WriteSettings(crop="none", error_map=True)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CaptureEstimation, "_optimised", results)
        patch.setattr(CaptureEstimation, "_predictions", predictions)
        outcome = batch.process_capture(batch.Task(capture, out, settings))
    assert outcome.failed_products == ()


@pytest.fixture(scope="module")
def with_relief(shared: Shared) -> Path:
    """The output of a capture with relief, of which Red edge is noisy and Red is lost."""

    def make(folder: Path) -> None:
        capture, truth = scene_in(folder / "in", SIZE)
        moving = [b for b in CLOSE_RANGE.bands if b.name != REFERENCE.name]
        planes = {b.name: Rendered(SIZE, truth, {}, moving).plane(b) for b in moving}
        for name, change in {"Red edge": noisy, "Red": noise}.items():
            change_band(next(b.path for b in capture.bands if b.name == name), change)
        estimate_and_write(capture, planes, folder / "out", "auto")

    return shared("with_relief", make) / "out"


@pytest.fixture(scope="module")
def without_relief(shared: Shared, flight: Path, aligned_flight: Path) -> Path:
    """The output of a flat capture, of which Red edge is saturated in a part and Red is lost."""

    def make(folder: Path) -> None:
        copy = shutil.copytree(flight, folder / "in", ignore=shutil.ignore_patterns("IMG_0002_*"))
        (capture,) = agalign.discover(copy).captures
        known = read_sidecar(next(path for path in find_sidecars(aligned_flight) if path.stem == capture.name))
        planes = {b.band: b.homography.fixed_to_moving for b in known.bands if b.homography is not None}
        for name, change in {"Red edge": saturated_at_the_right, "Red": noise}.items():
            change_band(next(b.path for b in capture.bands if b.name == name), change)
        estimate_and_write(capture, planes, folder / "out", "never")

    return shared("without_relief", make) / "out"


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("output", "kinds", "rel"),
    [
        in_full_run("with_relief", {("aligned", None), ("predicted", "windows"), ("predicted", "bands")}, 0.02),
        ("without_relief", {("aligned", None), ("predicted", "windows"), ("predicted", "bands")}, 0.01),
    ],
)
def test_the_standard_error_is_that_of_the_points_and_of_the_map(
    output: str, kinds: set[tuple[str, str | None]], rel: float, request: pytest.FixtureRequest
) -> None:
    (path,) = find_sidecars(request.getfixturevalue(output))
    with rasterio.open(path.with_suffix(".error.tif")) as source:
        maps = dict(zip(source.descriptions, source.read(), strict=True))
    sidecar, seen = read_sidecar(path), set()
    for band in sidecar.bands:
        if band.status == "reference":
            continue
        alignment = agalign.read_alignment(path, band.band)
        width, height = alignment.size_px
        points = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        mapped = alignment.map(points)
        inside = ((mapped >= -0.5) & (mapped <= np.subtract(band.size_px, 0.5))).all(axis=-1)
        error_px = alignment.error_px(points)
        assert rms(maps[band.band]) == pytest.approx(rms(error_px), rel=0.01)
        assert alignment.std_px == pytest.approx(rms(error_px[inside]), rel=rel)
        if band.status == "predicted":
            ratio = geometry.magnification(alignment.fixed_to_moving, width, height)
            assert band.prediction.std_px / ratio == pytest.approx(rms(error_px[inside]), rel=rel)
            assert band.prediction.std_px / ratio == pytest.approx(alignment.std_px, abs=2e-4)
        seen.add((band.status, band.prediction.source if band.status == "predicted" else None))
        assert (alignment.mapping.parallax is not None) == (output == "with_relief")
    assert seen == kinds


@pytest.mark.parametrize(
    ("std_px", "accept_px", "is_usable"), [(1.00004, 1.0, True), (1.00006, 1.0, False), (0.99996, 0.99999, False)]
)
def test_a_band_is_delivered_by_the_standard_error_that_is_written(
    std_px: float, accept_px: float, is_usable: bool
) -> None:
    """In the run that estimates it, in its sidecar, and in what is read back."""
    pair = pair_of(texture(64, 48), texture(64, 48))
    mapping, error = pair.mapping(np.eye(3)), MappingError((64, 48), rig_std_px=std_px)
    windows, issue = residual_of(np.zeros((4, 2)), (0.0, 0.0)), Issue(CLOSE_WINDOWS, 0.8, 0.9, "1 px")
    candidate = Candidate(pair, mapping, error, windows, joint_result(), given_issues=(issue,))
    estimated = decided(pair, Seed("rig", np.eye(3), 30.0), [candidate])
    reference, nir = (Band(name, Path(f"{name}.tif"), 1, 64, 48, "uint16") for name in ("Green", "NIR"))
    capture = Capture("a", Path(), (reference, nir), 0)
    written = BandResult.model_validate_json(BandResult.of(nir, estimated, capture).model_dump_json(by_alias=True))
    again = written.alignment((64, 48), written.mapping(None))
    assert again.prediction.std_px == estimated.prediction.std_px
    assert again.status == estimated.status == written.status == "predicted"
    assert [known.is_usable(accept_px) for known in (estimated, written, again)] == [is_usable] * 3


@pytest.mark.parametrize(
    ("magnification", "std_band_px", "status", "words"),
    [
        (0.07, 0.88, "ok", "12.57 px of the reference (0.88 px of the band)"),
        (0.07, 1.2, "degraded", "17.14 px of the reference (1.20 px of the band)"),
        (2.0, 0.9, "ok", "0.45 px of the reference (0.90 px of the band)"),
        # Less than 1 px of the reference, the coarser of the two: the limit in px of the band is stricter.
        (2.0, 1.2, "degraded", "0.60 px of the reference (1.20 px of the band)"),
        (1.05, 0.5, "ok", "0.50 px"),
    ],
)
def test_an_error_has_its_value_in_both_pixels_and_the_limit_holds_in_the_coarser(
    magnification: float, std_band_px: float, status: str, words: str
) -> None:
    """A thermal, a panchromatic, and a narrow band."""
    size_px, std_px = (640, 480), std_band_px / magnification
    mapping = PixelMapping(np.diag([magnification, magnification, 1.0]))
    moving_px = tuple(round(side * magnification) for side in size_px)
    reference = Band("Green", Path("g.tif"), 1, *size_px, "uint16")
    band = Band("Other", Path("o.tif"), 1, *moving_px, "uint16")
    prediction = Prediction(mapping.fixed_to_moving, "windows", std_band_px)
    error = MappingError(size_px, rig_std_px=std_px)
    alignment = aligned(mapping, size_px, "predicted", prediction=prediction, error=error, std_px=std_px)
    sidecar = Sidecar.estimated(Capture("a", Path(), (reference, band), 0), {"Other": alignment}, Settings())
    part = sidecar.bands[1]
    assert sidecar.status == status
    assert part.is_usable(1.0) == alignment.is_usable(1.0) == (status == "ok")
    if status == "ok":
        assert min(part.error.std_px, part.error.std_band_px) <= 1
    assert (part.error.std_px, part.error.std_band_px) == pytest.approx((std_px, std_band_px))
    assert part.reason.endswith(f"expected error {words}")
    problem = bands_of(sidecar, Path())[1].problem
    stated = f"Other is predicted with an expected error of {words}, above 1 px of the band ("
    assert problem.startswith(stated if status == "degraded" else "the pixels of Other were not written")
    assert (part.error.other_px is None) == ("reference" not in words)
    earlier = part.error.model_copy(update={"std_band_px": None})
    assert (earlier.other_px, earlier.in_words) == (None, f"{std_px:.2f} px of the reference")
    confirmed = aligned(mapping, size_px, std_px=std_px)
    assert confirmed.std_band_px == pytest.approx(std_band_px)


def test_areas_that_moved_are_equal_in_the_run_and_in_its_sidecar() -> None:
    outline_px = np.array([[3.0, 4.0], [27.0, 4.0], [27.0, 31.0]])
    area = MovedArea(outline_px, (8.123456, -1.0)).rescaled(PixelScale(1.7, 1.7))
    error = MappingError((64, 48), np.zeros((8, 8)), moved=(area,))
    seed = Seed("rig", np.eye(3), 30.0)
    estimated = agalign.Alignment(PixelMapping(np.eye(3)), (64, 48), (), seed, error=error, std_px=0.1)
    reference, nir = (Band(name, Path(f"{name}.tif"), 1, 64, 48, "uint16") for name in ("Green", "NIR"))
    capture = Capture("a", Path(), (reference, nir), 0)
    written = BandResult.model_validate_json(BandResult.of(nir, estimated, capture).model_dump_json(by_alias=True))
    again = written.alignment((64, 48), written.mapping(None))
    assert again.error.moved == (area,)
    assert np.array_equal(again.error_map_px, estimated.error_map_px)
    assert again.error_map_px.max() == pytest.approx(1.7 * np.hypot(8.123456, 1.0), abs=1e-3)
