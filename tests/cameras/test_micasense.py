from pathlib import Path

import numpy as np
import pytest
import tifffile

from agalign.cameras.metadata import Tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.pix4d import BAND_NAME, NAMESPACE, panel_in
from agalign.pixels.raster import probe


def test_thermal_bands_count_in_hundredths_of_a_kelvin(tmp_path: Path) -> None:
    path = tmp_path / "IMG_0001_6.tif"
    tifffile.imwrite(path, np.zeros((48, 64), np.uint16), photometric="minisblack", metadata=None)
    tags = Tags(
        make="MicaSense", model="Altum", xmp={BAND_NAME: ("LWIR",), (NAMESPACE, "CentralWavelength"): ("11000",)}
    )
    (band,) = MicaSense().bands(path, tags, probe(path))
    assert (band.radiometry.quantity, band.radiometry.gain) == ("temperature", 0.01)


@pytest.mark.parametrize(
    ("values", "albedo", "corners"),
    [
        ({"CalibrationPicture": "2", "Albedo": "0.51", "ReflectArea": "40,10,20,10,20,30,40,30"}, 0.51, 4),
        ({"CalibrationPicture": "1"}, None, 0),
        ({"CalibrationPicture": "1", "ReflectArea": "40,10,20,10,20,30,4000,30"}, None, 0),
        ({"ReflectArea": "40,10,20,10,20,30,40,30"}, None, 4),
        ({"CalibrationPicture": "2", "Albedo": "51", "ReflectArea": "1,2,3"}, None, 0),
    ],
)
def test_panels_as_firmware_writes_them(values: dict[str, str], albedo: float | None, corners: int) -> None:
    result = panel_in(Tags(xmp={(NAMESPACE, k): (v,) for k, v in values.items()}), (64, 48))
    assert (result.albedo, len(result.corners_px)) == (albedo, corners)


@pytest.mark.parametrize(
    "values",
    [
        {}, {"CalibrationPicture": "0"}, {"CalibrationPicture": "0", "ReflectArea": "40,10,20,10,20,30,40,30"},
        {"ReflectArea": "0,0,0,0,0,0,0,0"}, {"ReflectArea": "40,10,20,10,20,30,4000,30"}, {"Albedo": "0.5"},
    ],
)  # fmt: skip
def test_other_captures_are_no_panels(values: dict[str, str]) -> None:
    assert panel_in(Tags(xmp={(NAMESPACE, k): (v,) for k, v in values.items()}), (64, 48)) is None
