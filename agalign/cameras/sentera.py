"""Sentera 6X (one folder per band) and Double 4K (two folders of JPEGs with equal names).

6X files are by default already registered by the camera, so that the identity is tried as well as Sentera:AlignMatrix,
which maps a band to the colour camera. The second camera of the Double 4K has red edge in its red channel and near
infrared in its blue channel; the two cameras expose 0.3 s apart, which causes an offset of hundreds of pixels.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, colour_bands
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import SENTERA_FILTERS, filtered_bands
from agalign.values.capture import Band, Pose

_BAND_FOLDER = re.compile(r"^(?:\d+-)?(?P<name>[A-Za-z ]+?)-(?P<wavelength>\d{3,4})(?:-(?P<width>\d+))?$")
_SENTERA = "sentera.com"


class Sentera(Camera):
    """Sentera 6X and Double 4K."""

    name = "Sentera"
    capture_ids = ((pix4d.NAMESPACE, "CaptureUUID"), (_SENTERA, "CaptureUUID"), (_SENTERA, "ImageUniqueID"))
    flight_ids = ((pix4d.NAMESPACE, "FlightUUID"), (_SENTERA, "FlightUUID"), (_SENTERA, "FlightUniqueID"))
    band_in_name = re.compile(r"_\d{3}_\d{2,3}$")

    def recognises(self, tags: Tags) -> bool:
        return "sentera" in tags.make.lower() or any(namespace == _SENTERA for namespace, _ in tags.xmp)

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        if len(stored) > 1:
            return _listed_bands(tags, stored) or _channel_bands(path, tags, stored)
        matrix = tags.numbers(_SENTERA, "AlignMatrix", 9)
        to_rig = np.array(matrix).reshape(3, 3) if len(matrix) == 9 else None
        folder = _BAND_FOLDER.match(path.parent.name)
        band = pix4d.described(stored[0], tags, folder["name"] if folder else path.stem)
        if folder and band.wavelength_nm is None:
            width = float(folder["width"]) if folder["width"] else None
            band = replace(band, wavelength_nm=float(folder["wavelength"]), bandwidth_nm=width)
        return (replace(band, lens=pix4d.perspective_lens(tags) if to_rig is None else None, to_rig=to_rig),)

    def pose(self, tags: Tags) -> Pose | None:
        altitude = "AboveGroundAltitude"
        return pix4d.pose_of(tags, tags.number(_SENTERA, altitude) or tags.number(pix4d.NAMESPACE, altitude))

    def capture_folder(self, path: Path) -> Path:
        folder = path.parent
        named = _BAND_FOLDER.match(folder.name) or re.match(
            r"^(?:\d+-)?(?:n?RGB|NDRE|NDVI|NIR|RE|LWIR)$", folder.name, re.IGNORECASE
        )
        return folder.parent if named else folder


def _channel_bands(path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
    """The bands of a photograph by the filter in the name of its folder or model, else red, green and blue."""
    bandpass = next((k for k in SENTERA_FILTERS if k in f"{path.parent.name} {tags.model}".upper()), None)
    if bandpass is None:
        # The colour camera of the Double 4K takes part by default, that of the 6X does not.
        return tuple(replace(b, is_from_photograph="6X" in tags.model.upper()) for b in colour_bands(stored))
    return tuple(replace(b, one_lens=True) for b in filtered_bands(SENTERA_FILTERS[bandpass], stored))


def _listed_bands(tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
    """The bands of a photograph as its tags list them by channel; a channel without a wavelength is left out."""
    bands, lens = pix4d.listed_bands(tags, stored), pix4d.perspective_lens(tags)
    if any(not b.name or b.wavelength_nm is None for b in bands):
        return ()
    names = {"RedEdge": "Red edge"}
    return tuple(replace(b, name=names.get(b.name, b.name), one_lens=True, lens=lens) for b in bands if b.wavelength_nm)
