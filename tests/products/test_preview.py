"""The sheet of small pictures beside a capture: where each lies on it, and how large it may be."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from agalign.products.drawing import ReducedBands
from agalign.products.preview import ReliefView, preview_bytes, write_preview

from ..conftest import textured_image


def grey(seed: int, width: int = 640, height: int = 480) -> np.ndarray:
    return (128 + 40 * textured_image(width, height, seed)).clip(0, 255).astype(np.uint8)


@pytest.fixture
def views() -> ReducedBands:
    """Green and NIR, of which only Green was written."""
    return ReducedBands({"Green": grey(1), "NIR": grey(2)}, {"Green": grey(3)}, (640, 480))


def test_every_picture_lies_where_the_sidecar_says(views: ReducedBands, tmp_path: Path) -> None:
    errors = {"NIR": np.full((4, 5), 0.25, np.float32)}
    part = write_preview(views, ["Green", "NIR"], errors, tmp_path / "a.preview.jpg", preview_bytes(1))
    sheet = cv2.imread(str(tmp_path / part.file), cv2.IMREAD_GRAYSCALE)
    (w, h), (dw, dh) = part.tile_px, part.detail_px
    assert sheet.shape == (3 * h + 2 * dh, 2 * w)

    def like(result: np.ndarray, image: np.ndarray) -> float:
        there = cv2.resize(image, result.shape[::-1], interpolation=cv2.INTER_AREA)
        return float(np.corrcoef(result.ravel(), there.ravel())[0, 1])

    assert like(sheet[:h, :w], views.before["Green"]) > 0.98
    assert like(sheet[:h, w:], views.before["NIR"]) > 0.98
    assert like(sheet[h : 2 * h, :w], views.after["Green"]) > 0.98
    assert sheet[h : 2 * h, w:].max() < 4, "what was not written is black"
    x, y = round(part.detail[0] * 640), round(part.detail[1] * 480)
    assert like(sheet[2 * h : 2 * h + dh, dw : 2 * dw], views.before["NIR"][y : y + dh, x : x + dw]) > 0.98
    assert like(sheet[2 * h + dh : 2 * h + 2 * dh, :dw], views.after["Green"][y : y + dh, x : x + dw]) > 0.98
    assert np.median(sheet[2 * h + 2 * dh :, w:]) == pytest.approx(255 * 0.25 / part.error_full_px, abs=3)  # type: ignore[operator]


@pytest.mark.parametrize("has_errors", [False, True])
def test_the_relief_is_the_last_row(views: ReducedBands, tmp_path: Path, has_errors: bool) -> None:
    parallax_px = np.linspace(-3, 7, 320, dtype=np.float32)[None].repeat(240, axis=0)
    parallax_px[:2, :2] = 1000.0  # wrong pixels take no contrast
    errors = {"NIR": np.full((4, 5), 0.25, np.float32)} if has_errors else {}
    relief = ReliefView(parallax_px, (1.23456, 2.5))
    part = write_preview(views, ["Green", "NIR"], errors, tmp_path / "a.preview.jpg", preview_bytes(1), relief)
    assert part.relief is not None
    low, high = part.relief.parallax_px
    assert (low, high) == pytest.approx((-2.9, 6.9), abs=0.1)
    assert part.relief.range_m == (1.235, 2.5)
    sheet = cv2.imread(str(tmp_path / part.file), cv2.IMREAD_GRAYSCALE)
    (w, h), (_, dh) = part.tile_px, part.detail_px
    row = sheet[(3 if has_errors else 2) * h + 2 * dh :]
    assert row.shape == (h, 2 * w)
    assert row[:, w:].max() < 4
    shown = low + row[h // 2, :w].astype(float) / 255 * (high - low)
    np.testing.assert_allclose(shown, np.linspace(-3, 7, w).clip(low, high), atol=0.25)


def test_a_level_relief_can_be_shown() -> None:
    assert ReliefView(np.full((4, 5), 2.0, np.float32), None).grey.max() == 0


@pytest.mark.parametrize("captures", [1, 200, 1000])
def test_all_previews_of_a_flight_have_a_limit(views: ReducedBands, tmp_path: Path, captures: int) -> None:
    path = tmp_path / "a.preview.jpg"
    write_preview(views, ["Green", "NIR"], {}, path, preview_bytes(captures))
    assert path.stat().st_size <= preview_bytes(captures)
    assert captures * preview_bytes(captures) <= 44_000_000


def test_images_smaller_than_a_tile_are_shown_as_they_are(tmp_path: Path) -> None:
    tiny = {"Green": grey(1, 60, 41), "NIR": grey(2, 60, 41)}
    part = write_preview(ReducedBands(tiny, tiny, (60, 41)), ["Green", "NIR"], {}, tmp_path / "a.preview.jpg", 10_000)
    assert part.tile_px == (56, 40)
    assert part.detail[2] <= 1
    assert part.detail[3] <= 1
