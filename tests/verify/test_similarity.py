import cv2
import numpy as np
import pytest
import SimpleITK as sitk
from skimage.metrics import normalized_mutual_information, structural_similarity

from agalign.capture.reference import Reference
from agalign.values.image import Raster
from agalign.values.residual import Similarity
from agalign.verify.similarity import FixedSimilarity, fixed_bins, joint_histogram, normalised_mutual_information

from ..builders import two_views
from ..conftest import textured_image


def similarity(fixed: np.ndarray, moving: np.ndarray, valid: np.ndarray | None = None) -> Similarity:
    valid = np.ones(fixed.shape, bool) if valid is None else valid
    return FixedSimilarity(Raster(fixed, valid)).to(Raster(moving, valid))


def test_mattes_mi_is_that_of_itk_with_the_padding_of_elastix() -> None:
    fixed, moving = (view.pixels for view in two_views(np.eye(3)))
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(numberOfHistogramBins=32)
    method.SetMetricSamplingStrategy(method.NONE)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetInitialTransform(sitk.TranslationTransform(2))
    theirs = method.MetricEvaluate(sitk.GetImageFromArray(fixed), sitk.GetImageFromArray(moving))
    actual = similarity(fixed, moving).mattes_mi
    assert actual < 0
    # Elastix pads the moving image by one bin and the fixed one by none, ITK both by two: constant for these images.
    assert actual == pytest.approx(1.0169 * theirs, rel=2e-4)


def test_nmi_is_scikit_image_s_two_for_a_copy_and_one_for_independence() -> None:
    assert normalised_mutual_information(np.eye(32) / 32) == pytest.approx(2)
    assert normalised_mutual_information(np.full((32, 32), 1 / 1024)) == pytest.approx(1)
    one, other = (view.pixels for view in two_views(np.eye(3)))
    joint, _, _ = np.histogram2d(one.ravel(), other.ravel(), 32)
    result = normalised_mutual_information(joint / joint.sum())
    assert result == pytest.approx(normalized_mutual_information(one, other, bins=32), abs=1e-6)


def test_gradient_correlation_ignores_reversed_contrast() -> None:
    image = textured_image(320, 240)
    assert similarity(image, -2 * image).gradient_correlation == pytest.approx(1, abs=1e-5)
    assert abs(similarity(image, textured_image(320, 240, 1)).gradient_correlation) < 0.1


def test_structure_ssim_agrees_with_scikit_image() -> None:
    a, b = textured_image(320, 240), textured_image(320, 240) + 0.5 * textured_image(320, 240, 1)

    def gradient(image: np.ndarray) -> np.ndarray:
        g = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
        return (g - g.mean()) / g.std()

    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    _, full = structural_similarity(gradient(a), gradient(b), data_range=1.0, **options)
    actual = similarity(a, b.astype(np.float32)).structure_ssim
    assert actual == pytest.approx(full[5:-5, 5:-5].mean(), abs=5e-3)


def test_similarity_uses_only_valid_pixels() -> None:
    fixed, moving = (view.pixels for view in two_views(np.eye(3)))
    valid = np.ones(fixed.shape, bool)
    valid[:, :100] = False
    outlier = fixed.copy()
    outlier[:, :100] = 1e6
    whole = similarity(outlier, moving, valid)
    assert whole.overlap == pytest.approx(0.75)
    crop = similarity(fixed[:, 100:].copy(), moving[:, 100:].copy())
    assert whole.mattes_mi == pytest.approx(crop.mattes_mi, abs=1e-6)
    assert whole.ncc == pytest.approx(crop.ncc, abs=1e-6)
    nothing = vars(similarity(fixed, moving, np.zeros(fixed.shape, bool)))
    assert nothing.pop("overlap") == 0.0
    assert np.isnan(list(nothing.values())).all()
    stripes = np.broadcast_to(np.arange(fixed.shape[1]) % 3 > 0, fixed.shape)  # no gradient has all of its pixels
    of_stripes = similarity(fixed, moving, stripes)
    assert np.isfinite([of_stripes.mattes_mi, of_stripes.nmi, of_stripes.ncc]).all()
    assert np.isnan([of_stripes.gradient_correlation, of_stripes.structure_ssim]).all()


@pytest.mark.filterwarnings("error")
def test_large_values_that_hardly_vary_are_binned() -> None:
    constant = np.full(100, 1e30, np.float32)
    bins = fixed_bins(constant, (1e30, 1e30))
    assert set(bins) == {0}
    assert joint_histogram(bins, constant, (1e30, 1e30)).sum() == pytest.approx(1.0)


def test_windows_without_valid_pixels_are_skipped() -> None:
    fixed, moving = two_views(np.eye(3))
    valid = np.ones(fixed.valid.shape, bool)
    valid[:, 200:] = False
    residual = Reference(Raster(fixed.pixels, valid)).windows.residuals(Raster(moving.pixels, valid))
    assert len(residual.centres_px) > 0
    assert residual.centres_px[:, 0].max() < 200
    nothing = Reference(fixed).windows.residuals(Raster(moving.pixels, ~fixed.valid))
    assert (len(nothing.centres_px), nothing.median_px, nothing.coverage) == (0, np.inf, 0.0)
