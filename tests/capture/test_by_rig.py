import csv
import pickle
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import torch

import agalign
from agalign.batch.capture_report import CaptureReport
from agalign.batch.capture_task import quiet
from agalign.batch.flight_learning import learn_flight
from agalign.batch.learning_tasks import LearningCapture
from agalign.cameras.discover import discover
from agalign.capture.align_bands import CaptureEstimation, align_capture_bands, bands_to_learn
from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.by_relief import UnderRelief
from agalign.capture.by_rig import observed
from agalign.capture.candidate import BandCandidates, Candidate
from agalign.config import CheckSettings, Settings
from agalign.flight.model import FlightModel, load_model
from agalign.records.sidecar import capture_status
from agalign.synthetic.cameras import BANDS, REDEDGE
from agalign.synthetic.flight import make_flight
from agalign.values import geometry
from agalign.values.alignment import Alignment, Alignments, Seed
from agalign.values.capture import Capture
from agalign.values.issues import CLOSE_WINDOWS, INACCURATE, RETRIEVAL, Issue
from agalign.values.mapping_error import MappingError

from ..conftest import Shared, read_json

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
SIZE = 400, 300
Run = tuple[Path, dict[str, CaptureReport]]
Captures = tuple[Capture, ...]


def make_five(folder: Path) -> None:
    camera = replace(REDEDGE, bands=tuple(b for b in BANDS if b.name in ("Green", "Red", "NIR")), reference=0)
    make_flight(folder, captures=5, size_px=SIZE, rng_seed=5, camera=camera, altitude_m=(12.0, 30.0))
    rng = np.random.default_rng(0)
    images = folder / "0000SET" / "000"
    for path in (images / "IMG_0003_4.tif", *images.glob("IMG_0005_*.tif")):
        with rasterio.open(path, "r+") as dataset:
            dataset.write((20_000 + 1500 * rng.normal(size=(1, *SIZE[::-1]))).astype(np.uint16))


@pytest.fixture(scope="module")
def five(shared: Shared) -> Path:
    """Five captures of three bands: the NIR of the third is noise, the fifth is over water."""
    return shared("five", make_five)


@pytest.fixture(scope="module")
def captures(five: Path) -> Captures:
    return discover(five).captures


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


def learned(captures: Captures, start: FlightModel | None = None) -> FlightModel:
    return learn_flight(captures, Settings(), lambda *_: None, start=start)


def bands_of(capture: Capture, model: FlightModel) -> dict[str, Alignment]:
    """The bands of a capture, aligned with the flight's model."""
    return align_capture_bands(capture, Settings(), model, lambda *_: None)


@dataclass(frozen=True)
class Estimated:
    """A capture with all candidates of its bands."""

    capture: Capture
    pairs: list[BandPair]
    estimation: CaptureEstimation

    @classmethod
    def of(cls, capture: Capture, model: FlightModel) -> "Estimated":
        pairs, _ = read_pairs(capture, Settings().seed, model)
        estimation = CaptureEstimation(Settings(), model, quiet)
        estimation.align(pairs, capture)
        return cls(capture, pairs, estimation)

    def with_nir(self, *candidates: Candidate, issue: Issue | None = None, seed: Seed | None = None) -> "Estimated":
        """The same with other candidates of the NIR."""
        known = self.estimation.bands["NIR"]
        nir = BandCandidates(known.pair, seed or known.found, issue, list(candidates))
        reliefs = [without_nir(relief) for relief in self.estimation.reliefs]
        bands = {**self.estimation.bands, "NIR": nir}
        return replace(self, estimation=replace(self.estimation, bands=bands, reliefs=reliefs))

    def predicted(self, relief_std_px: float = 0.0, **of_rig: Any) -> Alignments:
        """The alignments with predictions of a rig with other facts, in a flight with this relief."""
        model = self.estimation.model
        bands = {
            n: replace(b, pair=replace(b.pair, relief_std_px=relief_std_px)) for n, b in self.estimation.bands.items()
        }
        changed = replace(self.estimation, bands=bands, model=replace(model, rig=replace(model.rig, **of_rig)))
        return changed.decided(changed._predictions(changed.decided(), self.capture))


def without_nir(relief: UnderRelief) -> UnderRelief:
    return {name: c for name, c in relief.items() if name != "NIR"}


@pytest.fixture(scope="module")
def first(captures: Captures, model: FlightModel) -> Estimated:
    return Estimated.of(captures[0], model)


def test_a_valid_model_is_kept(captures: Captures, model: FlightModel) -> None:
    again = learned(captures, model)
    assert again.net is model.net
    assert again.rig is model.rig


@pytest.mark.full
def test_an_outdated_model_is_learned_again(captures: Captures, model: FlightModel) -> None:
    elsewhere = {b: geometry.translation(12.0, 4.0 * sign) @ model.rig.mean[b] for b, sign in (("Red", 1), ("NIR", -1))}
    moved = replace(model, rig=replace(model.rig, mean=elsewhere), mappings=elsewhere)
    assert learned(captures, moved).rig is not moved.rig


@pytest.mark.full
def test_a_band_that_its_first_seed_does_not_align_is_part_of_the_rig(
    captures: Captures, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a capture is lower than the others, its bands start too far off; the model's mappings are nearer."""
    add = CaptureEstimation.add

    def with_nir_failed(self: CaptureEstimation, *arguments: Any) -> None:
        add(self, *arguments)
        if self.model is None:
            self.bands["NIR"].candidates.clear()
            self.bands["NIR"].issue = Issue(RETRIEVAL, 0.1, 0.2)
            self.reliefs = [without_nir(relief) for relief in self.reliefs]

    monkeypatch.setattr(CaptureEstimation, "add", with_nir_failed)
    assert "NIR" in learned(captures).rig.mean


def test_a_failed_band_is_predicted_with_a_standard_error(five: Path, captures: Captures, model: FlightModel) -> None:
    third = Estimated.of(captures[2], model)
    result = third.predicted()
    nir = result["NIR"]
    assert (nir.status, nir.prediction.source) == ("predicted", "bands")
    truth = read_json(five / "truth.json")["IMG_0003"]["bands"]["IMG_0003_4.tif"]["fixed_to_moving"]
    assert geometry.corner_error_px(nir.fixed_to_moving, np.array(truth), *SIZE) < 3 * nir.prediction.std_px
    assert "from the capture's other bands" in (nir.reason or "")
    assert (result["Red"].status, result["Red"].prediction.off_px is None) == ("aligned", False)
    # The prediction of a plane contains the parallax of the flight.
    with_relief = third.predicted(3.0)["NIR"]
    assert with_relief.prediction.std_px == pytest.approx(np.hypot(nir.prediction.std_px, 3.0), abs=1e-4)


def test_a_capture_over_water_is_predicted_without_learning(run: Run) -> None:
    out, reports = run
    water = reports["IMG_0005"].sidecar
    assert {b.status for b in water.bands} == {"reference", "predicted"}
    assert {b.prediction.source for b in water.bands if b.prediction} <= {"neighbours", "flight"}
    assert (out / "0000SET" / "000" / "IMG_0005.tif").is_file()
    # Nothing was learned from scratch for it.
    assert {b.joint.recipe for b in water.bands if b.joint} <= {"flight"}
    # The user's limit decides which predictions are accepted; here none is. The blue and red edge bands are missing.
    sidecars = [reports[f"IMG_000{k}"].sidecar for k in (1, 3, 5)]
    assert [capture_status(s.bands, (), s.accept_predicted_px) for s in sidecars] == ["ok", "degraded", "degraded"]
    assert {s.status for s in sidecars} == {"degraded"}
    assert sidecars[0].missing_bands == ["Blue", "Red edge"]
    assert capture_status(reports["IMG_0003"].sidecar.bands, (), 50.0) == "ok"
    rows = list(csv.DictReader((out / "summary.csv").read_text().splitlines()))
    (nir,) = [r for r in rows if r["capture"] == "IMG_0003" and r["band"] == "NIR"]
    assert (nir["status"], nir["prediction_from"]) == ("predicted", "bands")
    assert float(nir["prediction_std_px"]) > 0
    assert "; predicted from " in (out / "index.html").read_text()


def test_an_alignment_that_contradicts_the_rig_is_rejected(first: Estimated, model: FlightModel) -> None:
    """The images match with a shift of one period, which contradicts the other bands, in a flight with relief too."""
    moved = {**model.rig.mean, "NIR": geometry.compose(geometry.translation(25, 0), model.rig.mean["NIR"])}
    result = first.predicted(10.0, mean=moved)
    assert (result["NIR"].status, result["NIR"].issues[0].code) == ("predicted", "unexpected_px")
    assert result["NIR"].issues[0].value == pytest.approx(25, abs=3)


def test_a_more_accurate_prediction_by_windows_is_kept(first: Estimated) -> None:
    """A displacement field with many misaligned windows is `predicted` too; the rig does not contain relief."""
    nir, pair = first.estimation.decided()["NIR"], first.estimation.bands["NIR"].pair
    issues = (Issue(CLOSE_WINDOWS, 0.8, 0.9, "1 px"),)
    for std_px, away_px, source in ((0.001, 0.0, "windows"), (50.0, 0.0, "bands"), (0.001, 40.0, "bands")):
        matrix = geometry.compose(geometry.translation(away_px, 0), nir.fixed_to_moving)
        mapping = replace(nir.mapping, fixed_to_moving=matrix).without_parallax
        error = MappingError(pair.fixed.size_px, std_px**2 / 2 * np.eye(8))
        of_windows = Candidate(pair, mapping, error, nir.residual, nir.joint, given_issues=issues)
        checked = first.with_nir(of_windows).predicted()["NIR"]
        assert (checked.status, checked.prediction.source) == ("predicted", source)


def test_a_band_is_learned_from_scratch_if_its_prediction_is_not_usable(first: Estimated, model: FlightModel) -> None:
    """A plane does not contain the parallax of the flight."""
    seed = replace(first.estimation.bands["NIR"].seed, trusted=True)
    lost = first.with_nir(issue=Issue(RETRIEVAL, 0.1, 0.2), seed=seed).estimation.decided()
    in_relief = [replace(pair, relief_std_px=10.0) for pair in first.pairs]
    for pairs, names in (first.pairs, set()), (in_relief, {"NIR"}):
        assert bands_to_learn(pairs, lost, model.rig, first.capture) == names
    # The seed of the tags replaced a chance peak, as over water: nothing in the images can be learned.
    replaced = first.with_nir(issue=Issue(RETRIEVAL, 0.0, 0.2), seed=replace(seed, score=0.0)).estimation.decided()
    of_chance = replace(replaced["NIR"], joint=None)
    assert bands_to_learn(in_relief, {**replaced, "NIR": of_chance}, model.rig, first.capture) == set()


def test_bands_are_predicted_from_others_without_what_these_contain_of_the_rig(first: Estimated) -> None:
    """Else the images of a band would predict the band itself, by the rig and the other bands."""
    result = first.estimation.decided()
    nir = result["NIR"]
    moved = geometry.compose(geometry.translation(0.5, 0.0), nir.fixed_to_moving)
    by_images = replace(nir.joint, fixed_to_moving=moved, by_images=None)
    with_rig = {**result, "NIR": replace(nir, joint=replace(nir.joint, by_images=by_images))}
    known = observed(first.pairs, with_rig, first.capture)
    scales = first.estimation.bands["NIR"].pair.scales
    np.testing.assert_allclose(known.mappings["NIR"], scales.between_files(moved))


def test_a_rig_is_learned_from_inaccurate_bands_too(first: Estimated) -> None:
    """Their standard errors contain the shifts of their windows."""
    nir, pair = first.estimation.decided()["NIR"], first.estimation.bands["NIR"].pair
    known = observed(first.pairs, first.estimation.decided(), first.capture)
    inaccurate, misaligned = Issue(INACCURATE, 0.2, 0.1, "0.5 px"), Issue(CLOSE_WINDOWS, 0.8, 0.9, "1 px")
    for issues, is_learned in (((inaccurate,), True), ((inaccurate, misaligned), False)):
        error = replace(nir.error, rig_std_px=0.7)
        of_windows = Candidate(pair, nir.mapping, error, nir.residual, nir.joint, given_issues=issues)
        estimation = replace(first.with_nir(of_windows).estimation, reliefs=[])
        learned_from = LearningCapture.of(first.capture, estimation)
        assert learned_from.aligned == {"Red"}
        bands = {"Red", "NIR"} if is_learned else {"Red"}
        assert set(learned_from.residuals) == set(learned_from.observation.mappings) == bands
        assert not learned_from.is_aligned
        if is_learned:
            std_px = pair.in_reference_file_px(estimation.decided()["NIR"].std_px)
            assert learned_from.observation.std_px["NIR"] == std_px > 0.7 > 3 * known.std_px["NIR"]


@pytest.mark.parametrize("off_px", [8.0, 25.0])
def test_of_two_bands_that_contradict_each_other_neither_is_accurate(first: Estimated, off_px: float) -> None:
    """A shift along the baselines is that of a nearer scene, too: nothing decides which of them is wrong."""
    nir, baseline = first.estimation.decided()["NIR"], np.array(first.estimation.model.rig.baselines["NIR"])
    x, y = off_px * baseline / np.linalg.norm(baseline)
    matrix = geometry.compose(geometry.translation(x, y), nir.fixed_to_moving)
    mapping = replace(nir.mapping, fixed_to_moving=matrix).without_parallax
    pair = first.estimation.bands["NIR"].pair
    joint = replace(nir.joint, by_images=None)
    shifted = Candidate(pair, mapping, nir.error, nir.residual, joint, given_issues=())
    for alignment in first.with_nir(shifted).predicted().values():
        assert (alignment.status, alignment.issues[0].code) == ("predicted", "unexpected_px")
        assert alignment.prediction.std_px > 3.0


@pytest.mark.full
def test_a_model_is_learned_again_if_one_lens_has_moved(captures: Captures, model: FlightModel) -> None:
    nir = geometry.compose(geometry.translation(5.0, 0.0), model.rig.mean["NIR"])
    moved = replace(model, rig=replace(model.rig, mean={**model.rig.mean, "NIR": nir}))
    assert learned(captures, moved).rig is not moved.rig


def test_a_flight_without_a_rig_of_its_own_has_none_that_its_bands_contradict(
    captures: Captures, model: FlightModel
) -> None:
    """One capture determines no rig. A rig may lack a band of the network, too."""
    without_red = {name: mean for name, mean in model.rig.mean.items() if name != "Red"}
    assert learned(captures[:1], replace(model, rig=replace(model.rig, mean=without_red))).rig is not None
    nir = geometry.compose(geometry.translation(12.0, -9.0), model.rig.mean["NIR"])
    moved = replace(model.rig, mean={**model.rig.mean, "NIR": nir})
    assert learned(captures[:1], replace(model, rig=moved)).rig is None


@pytest.mark.full
def test_a_flight_that_nothing_can_be_learned_from_has_the_rig_of_the_given_model(
    captures: Captures, model: FlightModel, tmp_path: Path
) -> None:
    water = captures[4]
    copies = []
    for number in range(3):
        bands = tuple(
            replace(b, path=Path(shutil.copy(b.path, tmp_path / f"{number}_{b.path.name}"))) for b in water.bands
        )
        copies.append(replace(water, bands=bands, name=f"{water.name}{number}", root=tmp_path, folder=Path()))
    assert learned(copies) is None
    assert learned(copies, model).rig is model.rig


def test_a_rotated_band_is_not_predicted_by_the_rig(five: Path, model: FlightModel, tmp_path: Path) -> None:
    """A rotated lens contradicts the rig; neither its prediction nor the result may be accepted."""
    copy = shutil.copytree(five, tmp_path / "five")
    with rasterio.open(copy / "0000SET" / "000" / "IMG_0001_3.tif", "r+") as dataset:
        about = cv2.getRotationMatrix2D((199.5, 149.5), 5.0, 1.0)
        image = cv2.warpAffine(dataset.read(1), about, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        dataset.write(image, 1)
    result = bands_of(discover(copy).captures[0], model)
    assert (result["Red"].status, result["Red"].issues[0].code) == ("failed", "unexpected_px")
    assert result["NIR"].status == "aligned"
