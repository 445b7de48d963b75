"""Alignments of reduced images that are refined on the files."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from agalign.cameras.discover import discover
from agalign.capture import full_resolution
from agalign.capture.align_bands import align_capture_bands
from agalign.capture.full_resolution import at_full_resolution
from agalign.config import JointSettings, Settings
from agalign.errors import UnreadableFileError
from agalign.fit import window_fit
from agalign.flight.rig import distance_px
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction, Seed
from agalign.values.capture import Capture
from agalign.values.mapping import PixelMapping
from agalign.values.residual import Residual

from ..builders import joint_result, residual_of, two_views

pytestmark = pytest.mark.slow

SIZE = 1000, 800
TRUTH = np.array([[1.002, 0.004, 12.4], [-0.003, 0.999, -7.7], [1e-6, -1e-6, 1.0]])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("large")
    green, nir = (view.pixels for view in two_views(TRUTH, *SIZE))
    for name, image in {"green": green, "nir": nir, "red": nir}.items():
        tifffile.imwrite(folder / f"field_{name}.tif", (30000 + 4000 * image).astype(np.uint16), metadata=None)
    return discover(folder).captures[0]


def aligned_on_reduced_images() -> Alignment:
    """An alignment of reduced images with an error of several px of the files."""
    off = geometry.compose(TRUTH, geometry.translation(1.2, -0.6))
    centres = geometry.lattice(*SIZE, 12, 9) * 0.9 + np.array(SIZE) * 0.05
    residual = residual_of(centres, (0.0, 0.0))
    joint = joint_result(off, std_px=1.0, covariance=np.eye(8))
    return Alignment(PixelMapping(off), SIZE, (), Seed("identity", np.eye(3), 30.0), joint, residual, 2.5)


def refined(capture: Capture, alignment: Alignment) -> Alignment:
    return at_full_resolution(capture.reference, capture.moving[0], alignment)


def test_bands_are_refined_on_the_files_and_one_with_an_unreadable_tile_fails(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    resample_tile = full_resolution.resample_tile

    def unreadable(band: Any, *rest: Any, **options: Any) -> Any:
        if band.name == "nir":
            raise UnreadableFileError(f"{band.path}: cannot be read (tile 7); copy it from the card again")
        return resample_tile(band, *rest, **options)

    monkeypatch.setattr(full_resolution, "resample_tile", unreadable)
    monkeypatch.setattr("agalign.capture.band_pair._LONGEST_SIDE_PX", 400)
    result = align_capture_bands(capture, Settings(joint=JointSettings(device="cpu")), None, lambda *_: None)
    assert {name: a.status for name, a in result.items()} == {"nir": "failed", "red": "aligned"}
    assert "field_nir.tif: cannot be read (tile 7)" in (result["nir"].reason or "")
    assert geometry.corner_error_px(result["red"].fixed_to_moving, TRUTH, *SIZE) < 0.2
    assert result["red"].residual.centres_px.max() > 700  # px of the file


def test_a_refinement_that_fails_verification_leaves_the_earlier_result(capture: Capture) -> None:
    good = aligned_on_reduced_images()
    better = refined(capture, good)
    assert geometry.corner_error_px(better.fixed_to_moving, TRUTH, *SIZE) < 0.05
    assert better.joint.corner_std_px < 0.1
    unsure = replace(good, joint=replace(good.joint, retrieval=0.05))
    assert refined(capture, unsure) is unsure


def test_the_windows_that_verify_share_no_pixel_with_those_of_the_fit(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[np.ndarray] = []
    fit_windows = window_fit.fit_windows

    def recorded(mapping: PixelMapping, residual: Residual, *rest: Any, **named: Any) -> Any:
        fitted.append(residual.centres_px)
        return fit_windows(mapping, residual, *rest, **named)

    monkeypatch.setattr(window_fit, "fit_windows", recorded)
    residual = refined(capture, aligned_on_reduced_images()).residual
    assert len(residual.centres_px) > 50
    apart = np.abs(residual.centres_px[:, None] - np.concatenate(fitted)[None]).max(axis=-1)
    assert len(np.unique(residual.cells, axis=0)) == len(residual.cells)  # windows of several tiles have own cells
    assert apart.min() >= 50  # the side of the windows: five in each of four tiles


def test_a_refinement_is_compared_with_the_prediction_of_the_rig(capture: Capture) -> None:
    expected, elsewhere = (geometry.compose(TRUTH, geometry.translation(off_px, 0.0)) for off_px in (0.5, 4.0))
    prediction = Prediction(expected, "bands", 0.4, off_px=99.0)
    result = refined(capture, replace(aligned_on_reduced_images(), prediction=prediction))
    assert result.prediction.off_px == pytest.approx(distance_px(result.fixed_to_moving, expected, SIZE))
    assert result.prediction.off_px == pytest.approx(0.5, abs=0.05)
    contradicted = replace(result, prediction=Prediction(elsewhere, "bands", 0.2, off_px=2.9))
    assert refined(capture, contradicted) is contradicted


def test_each_tile_of_the_reference_is_read_once(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: Counter[Any] = Counter()
    read_tile = full_resolution.read_tile

    def counted(band: Any, tile: Any, dataset: Any) -> Any:
        if band.name == capture.reference.name:
            reads[tile] += 1
        return read_tile(band, tile, dataset)

    monkeypatch.setattr(full_resolution, "read_tile", counted)
    refined(capture, aligned_on_reduced_images())
    assert len(reads) >= 8
    assert set(reads.values()) == {1}


def test_an_unreadable_reference_is_an_error_of_the_capture(capture: Capture, tmp_path: Path) -> None:
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    reference = replace(capture.reference, path=tmp_path / "broken.tif")
    with pytest.raises(UnreadableFileError, match=r"broken\.tif"):
        at_full_resolution(reference, capture.moving[0], aligned_on_reduced_images())
