import numpy as np
import pytest
import SimpleITK as sitk
from skimage.metrics import normalized_mutual_information, structural_similarity

from agalign.capture.reference import Reference
from agalign.values.alignment import Residual
from agalign.values.image import Raster
from agalign.verify.metrics import (
    FixedSimilarity,
    cubic_spline,
    fixed_bins,
    joint_histogram,
    mutual_information,
    normalised_mutual_information,
)

from ..conftest import textured_image, textured_pair

EVERYWHERE = np.ones((240, 320), bool)


def similarity(fixed: np.ndarray, moving: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    return FixedSimilarity(Raster(fixed, valid)).to(Raster(moving, valid))


def tile_residuals(fixed: Raster, moving: Raster) -> Residual:
    return Reference(fixed).windows.residuals(moving)


def elastix_mattes(fixed: np.ndarray, moving: np.ndarray) -> float:
    """Mattes MI as defined by elastix, pixel by pixel, independent of the package."""
    bins = 32
    density = np.zeros((bins, bins))

    def terms(values: np.ndarray, padding: int) -> np.ndarray:
        span = values.max() - values.min()
        low, high = values.min() - 0.01 * span, values.max() + 0.01 * span
        size = (high - low) / (bins - 2 * padding - 1)
        return values / size - (low / size - padding)

    for f, m in zip(terms(fixed, 0), terms(moving, 1), strict=True):
        row = int(np.floor(f + 0.5))
        first = int(np.floor(m)) - 1
        for column in range(first, first + 4):
            if 0 <= column < bins:
                density[row, column] += float(cubic_spline(np.array([m - column]))[0])
    density /= density.sum()
    pf, pm = density.sum(axis=1), density.sum(axis=0)
    total = 0.0
    for i in range(bins):
        for j in range(bins):
            if density[i, j] > 1e-16:
                total += density[i, j] * np.log(density[i, j] / (pf[i] * pm[j]))
    return total


def test_mattes_mi_equals_its_definition() -> None:
    fixed = textured_image(90, 70).ravel().astype(np.float64)
    moving = np.sin(fixed) + 0.3 * textured_image(90, 70, 1).ravel()
    bins = fixed_bins(fixed.astype(np.float32), (float(fixed.min()), float(fixed.max())))
    actual = mutual_information(
        joint_histogram(bins, moving.astype(np.float32), (float(moving.min()), float(moving.max())))
    )
    assert actual == pytest.approx(elastix_mattes(fixed, moving), rel=1e-3)


def test_mattes_mi_is_close_to_that_of_itk() -> None:
    fixed, moving = textured_pair(np.eye(3))
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(numberOfHistogramBins=32)
    method.SetMetricSamplingStrategy(method.NONE)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetInitialTransform(sitk.TranslationTransform(2))
    theirs = method.MetricEvaluate(sitk.GetImageFromArray(fixed), sitk.GetImageFromArray(moving))
    actual = similarity(fixed, moving, np.ones(fixed.shape, bool))["mattes_mi"]
    assert actual < 0
    assert actual == pytest.approx(theirs, rel=0.05)


def test_nmi_is_two_for_a_copy_and_one_for_independence() -> None:
    copy = np.eye(32) / 32
    assert normalised_mutual_information(copy) == pytest.approx(2)
    assert normalised_mutual_information(np.full((32, 32), 1 / 1024)) == pytest.approx(1)


def test_the_spline_is_a_partition_of_unity() -> None:
    x = np.linspace(0, 1, 11)
    total = sum(cubic_spline(x - k) for k in range(-3, 4))
    np.testing.assert_allclose(total, 1)


def test_gradient_correlation_ignores_reversed_contrast() -> None:
    image = textured_image(320, 240)
    assert similarity(image, -2 * image, EVERYWHERE)["gradient_correlation"] == pytest.approx(1, abs=1e-5)
    assert abs(similarity(image, textured_image(320, 240, 1), EVERYWHERE)["gradient_correlation"]) < 0.1


def test_structure_ssim_agrees_with_scikit_image() -> None:
    import cv2

    a, b = textured_image(320, 240), textured_image(320, 240) + 0.5 * textured_image(320, 240, 1)

    def gradient(image: np.ndarray) -> np.ndarray:
        g = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
        return (g - g.mean()) / g.std()

    _, full = structural_similarity(
        gradient(a),
        gradient(b),
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    actual = similarity(a, b.astype(np.float32), EVERYWHERE)["structure_ssim"]
    assert actual == pytest.approx(full[5:-5, 5:-5].mean(), abs=5e-3)


def test_similarity_uses_only_valid_pixels() -> None:
    fixed, moving = textured_pair(np.eye(3))
    valid = np.ones(fixed.shape, bool)
    valid[:, :100] = False
    spoiled = fixed.copy()
    spoiled[:, :100] = 1e6
    whole = similarity(spoiled, moving, valid)
    assert whole["overlap"] == pytest.approx(0.75)
    crop = similarity(fixed[:, 100:].copy(), moving[:, 100:].copy(), valid[:, 100:])
    assert whole["mattes_mi"] == pytest.approx(crop["mattes_mi"], abs=1e-6)
    assert whole["ncc"] == pytest.approx(crop["ncc"], abs=1e-6)
    assert similarity(fixed, moving, ~np.ones(fixed.shape, bool)) == {"overlap": 0.0}


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.25), (3.0, 2.0)])
def test_tile_residuals_measure_a_known_shift(shift: tuple[float, float]) -> None:
    matrix = np.eye(3)
    matrix[:2, 2] = shift
    fixed, moving = textured_pair(matrix)
    valid = np.ones(fixed.shape, bool)
    residual = tile_residuals(Raster(fixed, valid), Raster(moving, valid))
    assert residual.coverage == 1.0
    np.testing.assert_allclose(np.median(residual.shifts_px, axis=0), shift, atol=0.08)
    assert residual.median_px == pytest.approx(np.hypot(*shift), abs=0.1)


def test_tile_residuals_of_unrelated_images_are_large_or_unmeasured() -> None:
    valid = np.ones((320, 400), bool)
    pair = [Raster(textured_image(400, 320, s), valid) for s in (1, 2)]
    residual = tile_residuals(*pair)
    assert residual.coverage < 0.6 or residual.median_px > 3


def test_tiles_without_structure_are_skipped() -> None:
    fixed, moving = textured_pair(np.eye(3))
    valid = np.ones(fixed.shape, bool)
    valid[:, 200:] = False
    residual = tile_residuals(Raster(fixed, valid), Raster(moving, valid))
    assert len(residual.centres_px) > 0
    assert residual.centres_px[:, 0].max() < 200


def test_windows_without_valid_pixels_are_skipped() -> None:
    one, other = textured_pair(np.eye(3))
    nowhere = Raster(other, np.zeros(other.shape, bool))
    result = tile_residuals(Raster(one, np.ones(one.shape, bool)), nowhere)
    assert len(result.centres_px) == 0
    assert (result.median_px, result.coverage) == (np.inf, 0.0)


def test_normalised_mutual_information_is_scikit_image_s() -> None:
    one, other = textured_pair(np.eye(3), 320, 240)
    joint, _, _ = np.histogram2d(one.ravel(), other.ravel(), 32)
    result = normalised_mutual_information(joint / joint.sum())
    assert result == pytest.approx(normalized_mutual_information(one, other, bins=32), abs=1e-6)
