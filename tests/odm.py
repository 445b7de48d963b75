"""A file as OpenDroneMap 3.6 reads it, written from its rules: `ODM_Photo` in opendm/photo.py for the tags, and
`dn_to_radiance`, `vignette_map` and `compute_irradiance` in opendm/multispectral.py for the numbers, and
`ODM_Reconstruction.detect_multi_camera` in opendm/types.py for the order of the bands.

It looks up XMP values by the prefix that the camera wrote, in each rdf:Description in turn; a later one replaces an
earlier one. Values are elements, `@` marks attributes, and the items of a sequence are joined by spaces.
"""

import math
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import exifread
import numpy as np
import rasterio
import xmltodict

_PLACES = {
    **dict.fromkeys(("RGB", "REDGREENBLUE"), "0"),
    **{"RED": "1", "R": "1", "GREEN": "2", "G": "2", "BLUE": "3", "B": "3", "NIR": "4", "N": "4"},
    **{"REDEDGE": "5", "RE": "5", "PANCHRO": "6", "LWIR": "7", "L": "7"},
}
"""Places of bands in an orthophoto, since version 3.3."""
_UUIDS = "@drone-dji:CaptureUUID", "MicaSense:CaptureId", "@Camera:ImageUniqueID", "@Camera:CaptureUUID"


def pixels_in(path: Path) -> np.ndarray:
    """(height, width) of a file of one band."""
    with rasterio.open(path) as dataset:
        return np.asarray(dataset.read(1))


class OdmPhoto:
    """The tags of one image."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            self.exif: dict[str, Any] = exifread.process_file(file, details=True, extract_thumbnail=False)

    @cached_property
    def descriptions(self) -> list[dict[str, Any]]:
        data = self.path.read_bytes()
        start, end = data.find(b"<x:xmpmeta"), data.find(b"</x:xmpmeta")
        if start >= end:
            return []
        packet = xmltodict.parse(data[start : end + len(b"</x:xmpmeta>")])
        parts = packet["x:xmpmeta"]["rdf:RDF"]["rdf:Description"]
        return parts if isinstance(parts, list) else [parts]

    def xmp(self, *names: str) -> str | None:
        """The value under the first of these names that a description has."""
        result = None
        for part in self.descriptions:
            given = next((part[name] for name in names if part.get(name) is not None), None)
            if isinstance(given, dict):
                items = given.get("rdf:Seq", {}).get("rdf:li")
                given = " ".join(items) if isinstance(items, list) else items
            result = given or result
        return result

    def xmp_numbers(self, *names: str) -> list[float]:
        """Items that are separated by spaces; a list with commas cannot be read."""
        return [float(item) for item in (self.xmp(*names) or "").split()]

    def exif_number(self, *names: str) -> float:
        return next(float(self.exif[name].values[0]) for name in names if name in self.exif)

    @property
    def band_name(self) -> str:
        name = self.xmp("Camera:BandName", "@Camera:BandName", "FLIR:BandName") or "RGB"
        return "".join(c for c in name if c.isascii() and c.isalnum())

    @property
    def band_index(self) -> str:
        return self.xmp("DLS:SensorId", "@Camera:RigCameraIndex", "Camera:RigCameraIndex") or "0"

    @property
    def capture_uuid(self) -> str | None:
        return self.xmp(*_UUIDS)

    @property
    def camera_id(self) -> tuple[str, str, tuple[int, ...], float]:
        """Make, model, size and focal length per width: images with equal ids are of one camera."""
        shape = pixels_in(self.path).shape
        unit_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
        focal_ratio = 0.85
        if "EXIF FocalLengthIn35mmFilm" in self.exif:
            focal_ratio = self.exif_number("EXIF FocalLengthIn35mmFilm") / 36.0
        elif "EXIF FocalPlaneXResolution" in self.exif:
            unit = unit_mm[int(self.exif_number("EXIF FocalPlaneResolutionUnit"))]
            width_mm = shape[1] / self.exif_number("EXIF FocalPlaneXResolution") * unit
            focal_ratio = self.exif_number("EXIF FocalLength") / width_mm
        make, model = (str(self.exif[f"Image {name}"].values).strip() for name in ("Make", "Model"))
        return make, model, shape, round(focal_ratio, 4)

    @property
    def vignetting(self) -> tuple[list[float], list[float]]:
        """(centre, coefficients), empty if there are none."""
        names = (
            ("Camera:VignettingCenter", "Sentera:VignettingCenter"),
            ("Camera:VignettingPolynomial", "Sentera:VignettingPolynomial"),
        )
        centre, k = (self.xmp_numbers(*n) for n in names)
        return (centre, k) if len(centre) == 2 and k else ([], [])

    @property
    def horizontal_irradiance(self) -> float | None:
        """W / m^2 / nm if the tag of the unit is there; else the number as it is."""
        irradiance = self.xmp("Camera:HorizontalIrradiance")
        if irradiance is not None:
            return float(irradiance) * float(self.xmp("Camera:IrradianceScaleToSIUnits") or 1.0)
        other = self.xmp("Camera:SpectralIrradiance", "Camera:Irradiance")
        return float(other) if other is not None and self.camera_id[0] == "DJI" else None

    def reflectance(self) -> np.ndarray:
        """(height, width): pi times radiance, divided by the irradiance."""
        pixels = pixels_in(self.path).astype(np.float32)
        y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
        a1, a2, a3 = self.xmp_numbers("MicaSense:RadiometricCalibration")
        black = np.mean(self.exif["Image BlackLevel" if "Image BlackLevel" in self.exif else "Image Tag 0xC61A"].values)
        speeds = "EXIF ISOSpeed", "EXIF PhotographicSensitivity", "EXIF ISOSpeedRatings"
        exposure_s, gain = self.exif_number("EXIF ExposureTime"), self.exif_number(*speeds) / 100
        signal = (pixels - float(black)) / 2 ** self.exif_number("Image BitsPerSample")
        centre, k = self.vignetting
        if k:
            r = np.hypot(x - centre[0], y - centre[1])
            signal = signal / np.polynomial.polynomial.polyval(r, (1.0, *k))
        signal = (signal / (1.0 + a2 * y / exposure_s - a3 * y)).clip(0)
        return np.asarray(math.pi * a1 * signal / (gain * exposure_s) / (self.horizontal_irradiance or 1.0))


def bands_of_orthophoto(photos: Iterable[OdmPhoto]) -> list[str]:
    """The names of the bands in the order in which the orthophoto has them; an alpha band follows.

    Bands with other names are last, in the order of their index.
    """
    indices: dict[str, str] = {}
    for photo in photos:
        indices.setdefault(photo.band_name, photo.band_index)
    return sorted(indices, key=lambda name: _PLACES.get(name.upper(), f"9{indices[name]}"))
