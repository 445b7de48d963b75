"""MAPIR: LATTICE arrays, one file per camera, and Survey3, which has three bands and one lens.

File names are `capture_<serial>_<sequence>_<date>_<time>_<fraction>.tiff`; the part after the serial number identifies
the capture. The model `LATT-<sensor>-<lens>-F<filter>` contains the wavelength. There are no rig tags.
Files of two Survey3 are joined if they have one name, in a folder for each camera that is named by its filter (RGN).
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agalign.cameras.base import Camera
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import SURVEY3_FILTERS, filter_channels, filtered_bands, survey3_filter
from agalign.values.band_names import own_stem
from agalign.values.capture import Band

_FILE = re.compile(r"^capture_(?P<serial>[^_]+)_(?P<moment>.+)$", re.IGNORECASE)


class Mapir(Camera):
    """MAPIR LATTICE and Survey3."""

    name = "MAPIR"

    def recognises(self, tags: Tags) -> bool:
        return "mapir" in tags.make.lower() or tags.model.upper().startswith(("LATT-", "SURVEY3"))

    def has_one_lens(self, tags: Tags) -> bool:
        return tags.model.upper().startswith("SURVEY3")

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        if len(stored) > 1:
            known = filtered_bands(filter_channels(tags.model), stored)
            unnamed = (replace(b, name=f"band_{b.band_index}", wavelength_nm=None) for b in stored)
            return tuple(replace(b, one_lens=True) for b in known or unnamed)
        bandpass = re.search(r"-F(?P<wavelength>\d{3,4})$", tags.model)
        if not bandpass:
            file = _FILE.match(own_stem(path))
            by_model = survey3_filter(tags.model) or "band_1"
            return (replace(stored[0], name=f"band_{file['serial']}" if file else by_model),)
        wavelength_nm = float(bandpass["wavelength"])
        longest_nm = {"Blue": 500, "Green": 600, "Red": 690, "Red edge": 760, "NIR": 1100}
        name = next((n for n, nm in longest_nm.items() if wavelength_nm <= nm), f"{wavelength_nm:g}nm")
        return (replace(stored[0], name=name, wavelength_nm=wavelength_nm),)

    def capture_folder(self, path: Path) -> Path:
        return path.parent.parent if path.parent.name.upper() in SURVEY3_FILTERS else path.parent

    def capture_name(self, path: Path) -> str:
        file = _FILE.match(own_stem(path))
        return f"capture_{file['moment']}" if file else path.stem
