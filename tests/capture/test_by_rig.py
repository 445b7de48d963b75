import csv
import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import torch

import agalign
from agalign.batch.capture_task import CaptureReport
from agalign.batch.flight_learning import learn_flight
from agalign.cameras.discover import discover
from agalign.capture import align_bands
from agalign.capture.align_bands import PairAligner, align_capture_bands, align_pairs
from agalign.capture.band_pair import read_pairs
from agalign.capture.by_rig import bands_to_learn, with_predictions
from agalign.config import CheckSettings, Settings
from agalign.flight.model import FlightModel, load_model
from agalign.method.joint import Results, refine_with
from agalign.products.sidecar.convert import capture_status
from agalign.synthetic.flight import make_flight
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction
from agalign.values.issues import Issue
from agalign.verify.checks import CLOSE_WINDOWS

from ..conftest import Shared

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
Run = tuple[Path, dict[str, CaptureReport]]


def make_five(folder: Path) -> None:
    make_flight(folder, captures=5, size_px=(400, 300), rng_seed=5, altitude_m=(12.0, 30.0))
    rng = np.random.default_rng(0)
    images = folder / "0000SET" / "000"
    lost = [images / "IMG_0003_4.tif", *images.glob("IMG_0005_*.tif")]
    assert len(lost) == 6
    for path in lost:
        with rasterio.open(path, "r+") as dataset:
            dataset.write((20_000 + 1500 * rng.normal(size=(1, 300, 400))).astype(np.uint16))


@pytest.fixture(scope="module")
def five(shared: Shared) -> Path:
    """Five captures: the NIR of the third is noise, the fifth is over water."""
    return shared("five", make_five)


@pytest.fixture(scope="module")
def run(five: Path, shared: Shared) -> Run:
    """The output folder and the reports of the five captures, without accepted predictions."""
    settings = Settings(check=CheckSettings(accept_predicted_px=0.0))

    def align(folder: Path) -> None:
        reports = {r.label[-8:]: r for r in agalign.align_folder(five, folder / "out", settings=settings)}
        (folder / "reports.pickle").write_bytes(pickle.dumps(reports))

    folder = shared("aligned_five", align)
    return folder / "out", pickle.loads((folder / "reports.pickle").read_bytes())


@pytest.fixture(scope="module")
def model(run: Run) -> FlightModel:
    (path,) = (run[0] / "models").iterdir()
    return load_model(path, lambda: torch.device("cpu"))


def learned(five: Path, start: FlightModel | None = None) -> FlightModel:
    return learn_flight(discover(five).captures, Settings(), lambda *_: None, start=start)


def bands_of(five: Path, number: int, model: FlightModel) -> dict[str, Alignment]:
    """The bands of a capture, aligned with the flight's model."""
    return align_capture_bands(discover(five).captures[number], Settings(), model, lambda *_: None)


def test_a_valid_model_is_kept(five: Path, model: FlightModel) -> None:
    again = learned(five, model)
    assert again.net is model.net
    assert again.rig is model.rig


@pytest.mark.full
def test_an_outdated_model_is_learned_again(five: Path, model: FlightModel) -> None:
    offsets_px = dict(zip(model.bands, (12.0, -12.0, 9.0, -9.0), strict=True))
    elsewhere = {b: geometry.translation(offsets_px[b], offsets_px[b] / 3) @ m for b, m in model.rig.mean.items()}
    moved = replace(model, rig=replace(model.rig, mean=elsewhere), mappings=elsewhere)
    assert learned(five, moved).rig is not moved.rig


@pytest.mark.full
def test_a_band_that_its_first_seed_does_not_align_is_part_of_the_rig(
    five: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a capture is lower than the others, its bands start too far off; the model's mappings are nearer."""
    verify = PairAligner.verify

    def without_nir(self: PairAligner, *arguments: Any) -> None:
        verify(self, *arguments)
        if self.model is None:
            self.result["NIR"] = replace(self.result["NIR"], status="seed_only")

    monkeypatch.setattr(PairAligner, "verify", without_nir)
    assert "NIR" in learned(five).rig.mean


def test_mappings_that_learning_refined_are_verified_and_not_refined_again(
    five: Path, model: FlightModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    refined: list[int] = []

    def statuses(number: int, model: FlightModel) -> set[str]:
        """Return the statuses of the bands of a capture. If its pairs are refined, it is added to `refined`."""

        def refine(*arguments: Any) -> Results:
            refined.append(number)
            return refine_with(*arguments)

        monkeypatch.setattr(align_bands, "refine_with", refine)
        return {a.status for a in bands_of(five, number, model).values()}

    assert statuses(0, model) == {"aligned"}
    assert refined == []
    assert statuses(2, model) == {"aligned", "predicted"}  # its NIR is noise, so learning could not align it
    assert statuses(0, replace(model, refined={})) == {"aligned"}
    assert refined == [2, 0]
    # Mappings of other images, here shifted by 30 px, do not pass verification.
    shift = geometry.translation(30.0, 0.0)
    shifted = {
        key: {
            band: replace(p, result=replace(p.result, fixed_to_moving=p.result.fixed_to_moving @ shift))
            for band, p in pairs.items()
        }
        for key, pairs in model.refined.items()
    }
    assert statuses(0, replace(model, refined=shifted)) == {"aligned"}
    assert refined == [2, 0, 0]


def test_a_failed_band_is_predicted_with_a_standard_error(five: Path, model: FlightModel) -> None:
    result = bands_of(five, 2, model)
    assert [b for b, a in result.items() if a.status == "aligned"] == ["Blue", "Red", "Red edge"]
    nir = result["NIR"]
    assert nir.status == "predicted"
    assert nir.prediction.source == "bands"
    truth = json.loads((five / "truth.json").read_text())["IMG_0003"]["bands"]["IMG_0003_4.tif"]["fixed_to_moving"]
    error_px = geometry.corner_error_px(nir.fixed_to_moving, np.array(truth), 400, 300)
    assert error_px < 3 * nir.prediction.std_px
    assert "from the capture's other bands" in (nir.reason or "")
    assert result["Red"].prediction.off_px is not None


def test_a_prediction_of_a_plane_contains_the_parallax_of_the_flight(five: Path, model: FlightModel) -> None:
    with_relief = replace(model, rig=replace(model.rig, parallax_px=dict.fromkeys(model.rig.mean, 3.0)))
    std_px = [bands_of(five, 2, m)["NIR"].prediction.std_px for m in (model, with_relief)]
    assert std_px[1] == pytest.approx(np.hypot(std_px[0], 3.0))


def test_a_capture_over_water_is_predicted_without_learning(run: Run) -> None:
    out, reports = run
    water = reports["IMG_0005"].sidecar
    assert {b.status for b in water.bands} == {"reference", "predicted"}
    assert {b.prediction.source for b in water.bands if b.prediction} <= {"neighbours", "flight"}
    assert (out / "0000SET" / "000" / "IMG_0005.tif").is_file()
    # Nothing was learned from scratch for it.
    assert {b.joint.recipe for b in water.bands if b.joint} <= {"flight"}
    # The user's limit decides which predictions are accepted; here none is.
    assert [reports[f"IMG_000{k}"].sidecar.status for k in (1, 3, 5)] == ["ok", "degraded", "degraded"]
    bands = reports["IMG_0003"].sidecar.bands
    assert capture_status(bands, 0.0) == "degraded"
    assert capture_status(bands, 50.0) == "ok"
    rows = list(csv.DictReader((out / "summary.csv").read_text().splitlines()))
    (nir,) = [r for r in rows if r["capture"] == "IMG_0003" and r["band"] == "NIR"]
    assert (nir["status"], nir["prediction_from"]) == ("predicted", "bands")
    assert float(nir["prediction_std_px"]) > 0
    assert "; predicted from " in (out / "index.html").read_text()


def test_an_alignment_that_contradicts_the_rig_is_rejected(five: Path, model: FlightModel) -> None:
    """The images match with a shift of one period, which contradicts the other bands, in a flight with relief too."""
    mean = model.rig.mean
    moved = mean | {"NIR": geometry.compose(geometry.translation(25, 0), mean["NIR"])}
    result = bands_of(five, 0, replace(model, rig=replace(model.rig, mean=moved, parallax_px={"NIR": 10.0})))
    assert result["NIR"].status == "predicted"
    assert result["NIR"].issues[0].code == "unexpected_px"
    assert result["NIR"].issues[0].value == pytest.approx(25, abs=3)
    assert result["Red"].status == "aligned"


def test_a_more_accurate_prediction_by_windows_is_kept(five: Path, model: FlightModel) -> None:
    """A displacement field with many misaligned windows is `predicted` too; the rig does not contain relief."""
    capture = discover(five).captures[0]
    settings = Settings()
    pairs, _ = read_pairs(capture, settings.seed, model)
    result = align_pairs(pairs, settings, lambda *_: None, model)
    nir = result["NIR"]
    for std_px, away_px, source in ((0.001, 0.0, "windows"), (50.0, 0.0, "bands"), (0.001, 40.0, "bands")):
        matrix = geometry.compose(geometry.translation(away_px, 0), nir.fixed_to_moving)
        mapping = replace(nir.mapping, fixed_to_moving=matrix)
        prediction, issues = Prediction(matrix, "windows", std_px), (Issue(CLOSE_WINDOWS, 0.8, 0.9, "1 px"),)
        of_windows = replace(nir, status="predicted", mapping=mapping, issues=issues, prediction=prediction)
        checked = with_predictions(pairs, {**result, "NIR": of_windows}, model.rig, capture)["NIR"]
        assert (checked.status, checked.prediction.source) == ("predicted", source)


def test_a_band_is_learned_from_scratch_if_its_prediction_is_not_usable(five: Path, model: FlightModel) -> None:
    """A plane does not contain the parallax of the flight."""
    capture = discover(five).captures[0]
    pairs, _ = read_pairs(capture, Settings().seed, model)
    result = align_pairs(pairs, Settings(), lambda *_: None, model)
    result["NIR"] = replace(result["NIR"], status="seed_only", seed=replace(result["NIR"].seed, trusted=True))
    with_relief = replace(model.rig, parallax_px={"NIR": 10.0})
    assert bands_to_learn(pairs, result, model.rig, capture, 1.0) == set()
    assert bands_to_learn(pairs, result, with_relief, capture, 1.0) == {"NIR"}


def test_a_rotated_band_is_not_predicted_by_the_rig(five: Path, model: FlightModel, tmp_path: Path) -> None:
    """A rotated lens contradicts the rig; neither its prediction nor the result may be accepted."""
    copy = tmp_path / "five"
    shutil.copytree(five, copy)
    path = copy / "0000SET" / "000" / "IMG_0001_3.tif"
    with rasterio.open(path, "r+") as dataset:
        about = cv2.getRotationMatrix2D((199.5, 149.5), 5.0, 1.0)
        image = cv2.warpAffine(dataset.read(1), about, (400, 300), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        dataset.write(image, 1)
    result = bands_of(copy, 0, model)
    assert result["Red"].status == "failed"
    assert result["Red"].issues[0].code == "unexpected_px"
    assert result["NIR"].status == "aligned"
