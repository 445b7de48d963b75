import numpy as np
import pytest
import tifffile

from agalign.cameras.discover import discover
from agalign.capture import band_pair
from agalign.capture.align import align_capture_bands
from agalign.config import JointSettings, Settings
from agalign.values import geometry
from agalign.values.capture import Capture

from ..conftest import textured_pair

pytestmark = pytest.mark.slow

SIZE = 1500, 1200
TRUTH = np.array([[1.002, 0.004, 12.4], [-0.003, 0.999, -7.7], [1e-6, -1e-6, 1.0]])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("large")
    for name, image in zip(("green", "nir"), textured_pair(TRUTH, *SIZE), strict=True):
        tifffile.imwrite(folder / f"field_{name}.tif", (30000 + 4000 * image).astype(np.uint16), metadata=None)
    return discover(folder).captures[0]


def error_px(capture: Capture) -> float:
    settings = Settings(joint=JointSettings(device="cpu"))
    result = align_capture_bands(capture, settings, None, lambda *_: None)["nir"]
    assert result.status == "aligned"
    assert result.residual is not None
    assert result.residual.centres_px.max() > 1000  # px of the file
    return geometry.corner_error_px(result.fixed_to_moving, TRUTH, *SIZE)


def test_what_was_found_on_reduced_images_is_sharpened_on_the_files(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(band_pair, "_LONGEST_SIDE_PX", 400)
    sharpened = error_px(capture)
    monkeypatch.setattr("agalign.capture.align.at_full_resolution", lambda _r, _m, alignment, _c: alignment)
    reduced = error_px(capture)
    assert sharpened < 0.05
    assert sharpened < 0.5 * reduced
