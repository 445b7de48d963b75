"""Tags of output files: band names, wavelengths, units, radiometry, camera and time."""

from collections.abc import Mapping, Sequence
from typing import Any

from agalign.config import WriteSettings
from agalign.products.layout import Layer
from agalign.values.capture import Band, Capture, Georeference, Quantity

UNITS: Mapping[Quantity, str] = {
    "radiance": "W m-2 sr-1 nm-1", "relative radiance": "", "reflectance": "1", "relative reflectance": "1",
    "temperature": "degC",
}  # fmt: skip
"""Units in the notation of UDUNITS."""


def describe(dataset: Any, capture: Capture, layers: Sequence[Layer], settings: WriteSettings) -> None:
    """Set tags, units, scales and descriptions of an open rasterio dataset with these layers as bands."""
    raw = settings.radiometry == "off"
    tags = {
        "TIFFTAG_SOFTWARE": "agalign",
        "TIFFTAG_DATETIME": capture.captured_at[:19].replace("-", ":").replace("T", " "),
        "CAPTURE_ID": capture.capture_id,
        "CAMERA": f"{capture.camera.make} {capture.camera.model}".strip(),
        "REFERENCE_BAND": capture.reference.name,
    }
    if not raw:
        tags |= _radiometry(layers)
    tags |= georeference_tags(capture.reference.georeference)
    dataset.update_tags(**{k: v for k, v in tags.items() if v})
    if not raw:
        _describe_quantities(dataset, layers)
    elif any(layer.band.scale_offset != (1.0, 0.0) for layer in layers):
        dataset.scales, dataset.offsets = zip(*(layer.band.scale_offset for layer in layers), strict=True)
    for index, layer in enumerate(layers, start=1):
        dataset.set_band_description(index, layer.band.name)
        _describe_wavelength(dataset, index, layer.band)


def georeference_tags(georeference: Georeference | None) -> dict[str, str]:
    """Return tags that mark a georeference by the camera's pose as approximate; empty for that of an input file."""
    if georeference is None or georeference.accuracy_m is None:
        return {}
    return {
        "GEOREFERENCE": "approximate, from GPS position, altitude, yaw and focal length; no ground control",
        "GEOREFERENCE_ACCURACY_M": f"{georeference.accuracy_m:g}",
    }


def _radiometry(layers: Sequence[Layer]) -> dict[str, str]:
    known = [layer.band.radiometry for layer in layers if layer.band.radiometry is not None]
    return {
        "RADIOMETRY": " and ".join(dict.fromkeys(r.quantity for r in known)),
        "RADIOMETRY_SOURCE": " and ".join(dict.fromkeys(r.source for r in known)),
    }


def _describe_quantities(dataset: Any, layers: Sequence[Layer]) -> None:
    quantities = [None if layer.band.radiometry is None else layer.band.radiometry.quantity for layer in layers]
    if not any(quantities):
        return
    dataset.units = [UNITS[q] if q is not None else "" for q in quantities]
    for index, quantity in enumerate(quantities, start=1):
        if quantity is not None:
            dataset.update_tags(index, QUANTITY=quantity)


def _describe_wavelength(dataset: Any, index: int, band: Band) -> None:
    if band.wavelength_nm is None:
        return
    width = {} if band.bandwidth_nm is None else {"fwhm": f"{band.bandwidth_nm:g}"}
    dataset.update_tags(index, wavelength=f"{band.wavelength_nm:g}", wavelength_units="nm", **width)
    width_um = {} if band.bandwidth_nm is None else {"FWHM_UM": f"{band.bandwidth_nm / 1000:g}"}
    dataset.update_tags(index, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=f"{band.wavelength_nm / 1000:g}", **width_um)
