"""What several captures tell about reflectance: vignetting in their mean, jumps over the same ground."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from agalign.cli.terminal import Terminal, explain
from agalign.records.cautions import Caution
from agalign.report.pair_totals import PairTotals
from agalign.values.remedies import JUMP, NOT_FLAT

from ..records.test_sidecar import example

BANDS = "Green", "Red", "NIR"
ROWS, COLUMNS = 12, 16
Image = NDArray[np.float64]


@pytest.fixture
def ground() -> Image:
    """Reflectance of three bands of a field (3, 60, 20), in cells."""
    rng = np.random.default_rng(1)
    texture = gaussian_filter(rng.normal(0.0, 1.0, (3, 60, 20)), (0, 0.7, 0.7))
    return np.reshape((0.08, 0.05, 0.4), (3, 1, 1)) * np.exp(0.5 * texture)


def seen(ground: Image, row: float, rng: np.random.Generator) -> Image:
    """The cells of a capture whose first row is at a fractional row of the ground."""
    top = int(row)
    between = (1 - row % 1) * ground[:, top : top + ROWS] + row % 1 * ground[:, top + 1 : top + 1 + ROWS]
    return between[:, :, :COLUMNS] * np.exp(rng.normal(0.0, 0.02, (3, ROWS, COLUMNS)))


def add(
    totals: PairTotals,
    number: int,
    cells: Image,
    *,
    seconds: float = 2.0,
    radiometry: str = "reflectance by panel",
    dark: tuple[str, ...] = (),
    unit: str = "",
) -> list[Caution]:
    """The cautions about the light of a capture, one each `seconds`."""
    at = np.datetime64("2024-06-01T12:00:00.000") + np.timedelta64(int(1000 * seconds * number), "ms")
    quantity, _, source = radiometry.partition(" by ")
    facts = {"quantity": quantity, "source": source, "std_percent": 3.0, "errors": []}
    bands: list[dict[str, Any]] = [{"band": "LWIR", **facts, "quantity": "temperature", "std_percent": None}]
    bands += [
        {"band": name, **facts, "cell_means": None if name in dark else means.tolist()}
        for name, means in zip(BANDS, cells, strict=True)
    ]
    text = f"temperature by camera calibration and {radiometry}"
    output = {"file": None, "crop": (0, 0, 10, 10), "nodata": "nan", "radiometry": text, "band_radiometry": bands}
    camera = {"make": "DJI", "model": "FC6360", "lens_calibration": unit}
    found = totals.add(f"IMG_{number:04d}", example(output=output, captured_at=f"{at}+00:00", camera=camera))
    return [caution for caution in found if caution.remedy is JUMP]


def jumps(ground: Image, factors: dict[int, Any], step: float = 3.3, **options: Any) -> list[tuple[int, str, float]]:
    """(capture, band, size) of each jump in ten captures along a line, some of which have factors for their bands."""
    totals, rng, found = PairTotals(), np.random.default_rng(0), []
    for number in range(10):
        cells = seen(ground, step * number, rng) * np.reshape(factors.get(number, (1, 1, 1)), (3, 1, 1))
        found += [(number, c.band, c.size) for c in add(totals, number, cells, **options)]
    return found


def test_captures_of_one_ground_agree(ground: Image) -> None:
    assert jumps(ground, {}) == []


def test_an_exposure_time_of_another_camera_is_named_in_its_capture_and_the_next(ground: Image) -> None:
    found = jumps(ground, {4: (1, 1.4, 1)})
    assert [(number, band) for number, band, _ in found] == [(4, "Red"), (5, "Red")]
    assert [size for *_, size in found] == pytest.approx([0.4, 1 - 1 / 1.4], abs=0.05)


def test_a_cloud_that_stays_is_named_once(ground: Image) -> None:
    found = jumps(ground, dict.fromkeys(range(6, 10), (0.6, 0.6, 0.6)))
    assert [(number, band) for number, band, _ in found] == [(6, band) for band in BANDS]
    assert [size for *_, size in found] == pytest.approx([0.4] * 3, abs=0.05)


@pytest.mark.parametrize("options", [{"seconds": 100.0}, {"radiometry": "radiance by camera calibration"}])
def test_a_difference_after_a_long_time_or_of_radiance_is_no_jump(ground: Image, options: dict[str, Any]) -> None:
    assert jumps(ground, {4: (1, 1.4, 1)}, **options) == []


def test_a_difference_of_other_ground_is_no_jump() -> None:
    totals, rng = PairTotals(), np.random.default_rng(2)
    fields = [0.1 * np.exp(gaussian_filter(rng.normal(0.0, 1.0, (3, ROWS, COLUMNS)), (0, 1, 1))) for _ in range(10)]
    assert [add(totals, k, field * (1 + k % 2), seconds=40.0) for k, field in enumerate(fields)] == [[]] * 10


def test_captures_that_end_in_another_order_are_compared_with_the_nearest_in_time(ground: Image) -> None:
    totals, rng = PairTotals(), np.random.default_rng(0)
    found = [
        (number, c.band)
        for number in (0, 1, 3, 2, 5, 4)
        for c in add(totals, number, seen(ground, 3.3 * number, rng) * (1.4 if number == 4 else 1.0))
    ]
    assert found == [(4, band) for band in BANDS]


def darker_corners(ratio: float) -> Image:
    """The cells of a flat field whose corners are darker in NIR by a ratio to the middle."""
    y, x = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    r = np.hypot(3 * y, 4 * x) / 5
    falloff = 1 + (ratio - 1) * np.clip((r - 0.4) / 0.35, 0, 1)
    return np.asarray(0.2 * np.stack([np.ones_like(r), np.ones_like(r), falloff]))


def test_two_cameras_of_a_model_are_told_apart(capsys: pytest.CaptureFixture[str]) -> None:
    totals = PairTotals()
    for k in range(50):
        add(totals, k, darker_corners(0.75 if k < 25 else 1.0), unit="first" if k < 25 else "second")
    (group,) = (g for g in totals.groups() if g.remedy is NOT_FLAT)
    assert [(b.band, b.capture) for b in group.bands] == [("NIR", "IMG_0024")]
    assert "in 25 captures, the corners are -25%" in group.bands[0].reason
    explain([group], Terminal())
    assert "check: 25 bands of 25 captures: the mean of the captures is darker" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("mean", "captures", "is_named"), [(0.75, 25, True), (0.75, 10, False), (0.97, 25, False), (1.4, 25, True)]
)
@pytest.mark.parametrize("radiometry", ["reflectance by panel", "radiance by camera calibration"])
def test_the_mean_of_many_captures_shows_whether_the_vignetting_is_corrected(
    radiometry: str, mean: float, captures: int, is_named: bool
) -> None:
    totals, rng = PairTotals(), np.random.default_rng(0)
    for k in range(captures):
        add(totals, k, darker_corners(mean * np.exp(rng.normal(0.0, 0.15))), radiometry=radiometry)
    groups = [g for g in totals.groups() if g.remedy is NOT_FLAT]
    assert bool(groups) == is_named
    if is_named:
        assert [b.band for b in groups[0].bands] == ["NIR"]
        assert f"in {captures} captures, the corners are" in groups[0].bands[0].reason
        assert groups[0].count == f"{captures} bands of {captures} captures"
        assert groups[0].effect == pytest.approx(abs(mean - 1), abs=0.1)


def test_a_dark_band_is_not_compared(ground: Image) -> None:
    """The near infrared of water: its sidecar has no cells."""
    totals, rng = PairTotals(), np.random.default_rng(0)
    for number in range(4):
        cells = seen(ground, 3.3 * number, rng) * (1.0, 1.4)[number == 2]
        found = add(totals, number, cells, dark=("NIR",))
        assert [c.band for c in found] == ([] if number < 2 else ["Green", "Red"])
