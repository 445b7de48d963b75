"""Any other GeoTIFF: multiband files, and files of single bands with any naming scheme."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agalign.cameras.base import Camera, colour_bands
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import filter_channels, filtered_bands, named_by_camera
from agalign.cameras.pix4d import NAMESPACE, listed_bands
from agalign.host.text import shortened
from agalign.pixels.raster import suffix_format
from agalign.values.band_names import compile_pattern, is_band_name, own_stem, split_end, split_start, wavelength_in
from agalign.values.capture import Band


class Generic(Camera):
    """Files that no vendor's module recognises. `pattern` has {capture} and {band}, as in '{capture}_{band}.tif', and
    may have folders, as in '{band}/{capture}.tif'. Without a pattern, the band is at the end of the name, with the
    `layout` "start" at its beginning, with "folder" in the name of the folder.
    """

    name = "generic"

    def __init__(self, pattern: str | None = None, layout: str = "") -> None:
        self._patterns, self._layout = compile_pattern(pattern) if pattern else (), layout
        self.has_free_names = not pattern
        self._folders = pattern.count("/") if pattern else int(layout == "folder")

    def recognises(self, tags: Tags) -> bool:
        return True

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        if suffix_format(path) in ("JPEG", "PNG"):
            if not self.is_named_as_band(path):  # a photograph; another PNG has no band
                return colour_bands(stored) if suffix_format(path) == "JPEG" else ()
            # A number in the name of a picture is not a band. Of three equal channels, the first is read.
            name = self.split(path)[1]
            return (replace(stored[0], name=name, wavelength_nm=wavelength_in(name)),)
        if len(stored) > 1:
            # The channels of a camera with a filter have other bands than their colours, whatever the pattern.
            channels = filter_channels(tags.model)
            if len(stored) == len(channels):
                stored = filtered_bands(channels, stored)
            listed = listed_bands(tags, stored)
            own = [named_by_camera(b.name)[1] for b in listed]
            names = own if all(own) and len(set(own)) == len(own) else [b.name for b in listed]
            named = zip(listed, names, strict=True)
            return tuple(replace(b, name=name or b.colour or f"band_{b.band_index}") for b, name in named)
        (band,) = stored
        described, in_tags = (spectral_part(text) for text in (band.name, tags.text(NAMESPACE, "BandName")))
        own_name = in_tags or tags.text(NAMESPACE, "BandName") or self.split(path)[1]
        file_wavelength_nm = tags.number(NAMESPACE, "CentralWavelength") or wavelength_in(own_name)
        # A description may be the name of the file that another program has read.
        name = described or own_name or band.name or f"band_{band.band_index}"
        return (replace(band, name=name, wavelength_nm=band.wavelength_nm or file_wavelength_nm),)

    def is_named_as_band(self, path: Path) -> bool:
        """Return True for a picture with the name of a band, and not of a photograph."""
        name = self.split(path)[1]
        return is_band_name(name) or bool(name and self._patterns)

    def capture_key(self, path: Path, tags: Tags) -> str:
        return self.split(path)[0]

    def capture_name(self, path: Path) -> str:
        # `red.tif` and `nir.tif` in a folder are a capture with the name of the folder.
        return self.split(path)[0] or path.absolute().parent.name

    def capture_folder(self, path: Path) -> Path:
        return path.parents[min(self._folders, len(path.parents) - 1)]

    def split(self, path: Path) -> tuple[str, str]:
        """Return (capture, band) from the file name; the band is empty if the name contains none."""
        name = "/".join(path.parts[-1 - self._folders :])
        for pattern in self._patterns:
            if match := pattern.fullmatch(name):
                return match["capture"], match["band"]
        if self._patterns:
            return path.stem, ""
        return split_elsewhere(path, self._layout) or split_stem(own_stem(path))


def split_elsewhere(path: Path, layout: str) -> tuple[str, str] | None:
    """Return (capture, band) of a file with the band in its folder or at the beginning of its name, or None."""
    stem = own_stem(path)
    (capture, band), prefixed = split_stem(stem), split_start(stem)
    if layout == "folder" and is_band_name(path.parent.name):
        return (capture, band) if is_band_name(band) else (stem, split_end(path.parent.name)[1])
    return prefixed if layout == "start" and not (capture and is_band_name(band)) else None


def split_stem(stem: str) -> tuple[str, str]:
    """Return (capture, band) of a file name without suffix; the band is empty if the name contains none."""
    own = named_by_camera(stem)
    return own if own[1] else split_end(stem)


def spectral_part(text: str) -> str:
    """Return the name of the spectral band in a text: all of it, or its end as that of a file name; empty if none."""
    text = shortened(text)
    band = split_stem(text)[1]
    return text if is_band_name(text) else band if is_band_name(band) or named_by_camera(text)[1] else ""
