import numpy as np
import pytest

from agalign.errors import ConfigurationError, InputError
from agalign.products.indices import INDICES, bands_for, compute, index_named

NAMES = ("Blue-444", "Blue", "Green", "Red-650", "Red", "Red edge-705", "Red edge", "NIR")
NM = (444.0, 475.0, 560.0, 650.0, 668.0, 705.0, 717.0, 842.0)


def test_bands_are_those_nearest_to_the_nominal_wavelength() -> None:
    assert [NAMES[i] for i in bands_for(INDICES["ndvi"], NAMES, NM)] == ["NIR", "Red"]
    assert [NAMES[i] for i in bands_for(INDICES["ndre"], NAMES, NM)] == ["NIR", "Red edge"]
    assert [NAMES[i] for i in bands_for(INDICES["evi"], NAMES, NM)] == ["NIR", "Red", "Blue"]


def test_without_wavelengths_the_names_count() -> None:
    names = ("red", "NIR", "RedEdge")
    assert bands_for(INDICES["ndre"], names, (None,) * 3) == [1, 2]


def test_a_missing_band_is_named() -> None:
    with pytest.raises(InputError, match="ndre needs a red edge band; there are Red, NIR"):
        bands_for(INDICES["ndre"], ("Red", "NIR"), (668.0, 840.0))


def test_an_unknown_index_is_a_usage_error() -> None:
    assert index_named(" NDVI ").name == "ndvi"
    with pytest.raises(ConfigurationError, match="unknown index 'abc'; choose from ndvi"):
        index_named("abc")


def test_values_and_nodata() -> None:
    nir, red = np.float32([[0.5, 0.0, np.nan, 0.3]]), np.float32([[0.1, 0.0, 0.2, -0.3]])
    result = compute(INDICES["ndvi"], [nir, red])
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, [[0.4 / 0.6, np.nan, np.nan, np.nan]], rtol=1e-6)
    blue = np.float32([[0.05] * 4])
    np.testing.assert_allclose(
        compute(INDICES["evi"], [nir, red, blue])[0, 0], 2.5 * 0.4 / (0.5 + 0.6 - 0.375 + 1), rtol=1e-6
    )
    np.testing.assert_allclose(compute(INDICES["savi"], [nir, red])[0, 0], 1.5 * 0.4 / 1.1, rtol=1e-6)
    np.testing.assert_allclose(compute(INDICES["cire"], [nir, red])[0, 0], 4.0, rtol=1e-6)


@pytest.mark.parametrize("index", INDICES.values(), ids=lambda i: i.name)
def test_vegetation_is_above_bare_soil(index: object) -> None:
    crop = {"blue": 0.04, "green": 0.1, "red": 0.05, "red edge": 0.28, "nir": 0.5}
    soil = {"blue": 0.08, "green": 0.12, "red": 0.18, "red edge": 0.22, "nir": 0.26}
    values = [compute(index, [np.float32([[of[r]]]) for r in index.roles])[0, 0] for of in (crop, soil)]  # type: ignore[attr-defined]
    assert (values[0] > values[1]) != (index.name == "ndwi")  # type: ignore[attr-defined]


def test_a_panchromatic_band_is_nobodys_red() -> None:
    with pytest.raises(InputError, match="needs a red band"):
        bands_for(INDICES["ndvi"], ("Blue", "Panchro", "NIR"), (475.0, 634.5, 842.0))
