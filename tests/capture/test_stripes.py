from pathlib import Path

import numpy as np
import pytest
import rasterio

import agalign
from agalign.synthetic.cameras import REDEDGE
from agalign.synthetic.flight import Shot, plan_flight, write_shots
from agalign.synthetic.ground import Field
from agalign.synthetic.score import score_against_truth

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE_PX = (480, 360)


def stripes(light: Field, _rng: np.random.Generator) -> Field:
    """White column stripes, equal in all bands, of +-20 % of the range."""
    low, high = np.percentile(light, (1, 99))
    pattern = np.random.default_rng(5).uniform(-0.2, 0.2, light.shape[1]).astype(np.float32)
    return np.asarray(light + (high - low) * pattern, np.float32)


def test_a_capture_with_common_stripes_is_aligned(tmp_path: Path) -> None:
    poses, ground, rng = plan_flight(1, SIZE_PX, rng_seed=3)
    truth = write_shots(tmp_path, [Shot(poses[0], ground, stripes)], SIZE_PX, REDEDGE, rng)
    reports = agalign.align_folder(tmp_path, tmp_path / "out")
    scores = score_against_truth(reports, truth)
    assert [score.status for score in scores] == ["aligned"] * 4
    assert max(score.median_px for score in scores) < 0.3
    (sidecar,) = (report.sidecar for report in reports)
    x0, y0, width, height = sidecar.output.crop
    (source,), (stack,) = tmp_path.rglob(sidecar.reference.file), (tmp_path / "out").rglob(sidecar.output.file)
    with rasterio.open(source) as read, rasterio.open(stack) as written:
        pixels = written.read(1 + written.descriptions.index(sidecar.reference.band))
        np.testing.assert_array_equal(pixels, read.read(1)[y0 : y0 + height, x0 : x0 + width])
