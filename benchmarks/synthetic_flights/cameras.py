"""Cameras other than the demo's, with the layouts, tags and files of real units; cameras.json describes their bands."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from agalign.cameras.base import rotation
from agalign.cameras.tiff_directory import rational
from agalign.synthetic import cameras
from agalign.synthetic.cameras import BandSpec, CameraSpec, Exposure, MicaSenseCamera, write_tiff
from agalign.values import geometry
from agalign.values.geometry import Matrix

_HERE = Path(__file__).parent
_DJI, _SENTERA = ((_HERE / name).read_text(encoding="utf-8") for name in ("dji.xmp", "sentera.xmp"))
_BAND_NAMES = {"Green": "G", "Red": "R", "RedEdge": "RE", "NIR": "NIR"}
_SERIAL = "SYNTHETIC0000001"
_TO_COLOUR = 1.7162, (1296.0, 972.0), (2639.9, 1978.0), 2592
"""Of one real Mavic 3M, band frame to colour photograph: scale, a point in each, and the width of the frame in px."""


@dataclass(frozen=True)
class DjiCamera(CameraSpec):
    """A Mavic 3 Multispectral: a TIFF per band, and a photograph of the colour camera."""

    maker = "DJI"
    calibrated: bool = True
    """The mappings of the bands to a common plane are in the tags, not only their optical centres."""

    def capture_name(self, number: int) -> str:
        return f"DJI_{20260621100000 + number}_{number:04d}"

    def file_name(self, band: BandSpec, number: int) -> str:
        name = self.capture_name(number)
        return f"{name}_D.JPG" if band.sees == "colour" else f"{name}_MS_{_BAND_NAMES[band.name]}.TIF"

    def write_band(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write (height, width) pixels and their tags; a colour photograph is written band after band."""
        if band.sees == "colour":
            self._write_colour(path, pixels, band, exposure)
            return
        own = (
            f'   drone-dji:SensorIndex="{band.rig_index}" {self._plane(band, exposure.size_px)}>\n'
            f"   <Camera:BandName>{band.name}</Camera:BandName>\n"
            f"   <Camera:CentralWavelength>{band.wavelength_nm:g}</Camera:CentralWavelength>\n"
            f"   <Camera:WavelengthFWHM>{band.bandwidth_nm:g}</Camera:WavelengthFWHM>\n"
        )
        write_tiff(path, pixels, self, band, exposure, _dji_xmp(band, exposure, exposure.size_px, own), _SERIAL, {}, {})

    def _plane(self, band: BandSpec, size_px: tuple[int, int]) -> str:
        """The tags that map a band's pixels to the common plane, or to the photograph."""
        if self.calibrated:
            return f'drone-dji:CalibratedHMatrix="{_numbers(to_plane(self.bands[self.reference], band, size_px))}"'
        x, y = (v * size_px[0] / 1280 for v in band.centre_offset_px)
        scale, here, there, own_px = _TO_COLOUR
        designed = (
            geometry.translation(*there) @ np.diag([scale, scale, 1.0]) @ geometry.translation(*np.negative(here))
        )
        # Both images are reduced alike.
        reduced = np.diag([size_px[0] / own_px, size_px[0] / own_px, 1.0])
        return (
            f'drone-dji:RelativeOpticalCenterX="{x:.5f}" drone-dji:RelativeOpticalCenterY="{y:.5f}" '
            f'drone-dji:DewarpHMatrix="{_numbers(reduced @ designed @ np.linalg.inv(reduced))}"'
        )

    def _write_colour(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write one plane of a photograph and keep the others; without a file they are dark."""
        planes = [b.name for b in self.bands if b.sees == "colour"]
        kept = path.with_suffix(".npy")
        before = np.load(kept) if kept.is_file() else np.zeros((*pixels.shape, len(planes)), np.uint8)
        share = np.clip(
            (pixels.astype(np.float32) - cameras.BLACK_LEVEL) / (cameras.WHITE_LEVEL - cameras.BLACK_LEVEL), 0, 1
        )
        before[..., planes.index(band.name)] = np.rint(255 * share ** (1 / 2.2))
        if planes.index(band.name) < len(planes) - 1:
            np.save(kept, before)
            return
        kept.unlink(missing_ok=True)
        size_px = round(pixels.shape[1] / band.size_ratio[0]), round(pixels.shape[0] / band.size_ratio[1])
        exif = Image.Exif()
        exif.update({271: self.maker, 272: self.model, 306: exposure.moment})
        height, width = pixels.shape
        of_exif = {0x9003: exposure.moment, 0x920A: band.focal_length_mm, 0xA431: _SERIAL}
        exif.get_ifd(0x8769).update(of_exif | {0xA002: width, 0xA003: height})
        xmp = _dji_xmp(band, exposure, size_px, ">").encode()
        Image.fromarray(before).save(path, quality=95, subsampling=0, exif=exif, xmp=xmp)


def _dji_xmp(band: BandSpec, exposure: Exposure, size_px: tuple[int, int], own: str) -> str:
    """Return the packet of a band or photograph with what both have in common."""
    model, pose, (k1, k2, p1, p2, k3) = band.lens(*size_px), exposure.pose, band.distortion
    x, y = ((n - 1) / 2 for n in band.size_px(size_px))
    dewarp = model.fx_px, model.fy_px, model.cx_px - x, model.cy_px - y, k1, k2, p1, p2, k3
    return _DJI.format(
        pose=pose,
        pitch_deg=pose.pitch_deg - 90,
        north_m_s=-pose.velocity_m_s[1],
        lens=model,
        x=x,
        y=y,
        dewarp=",".join(map(str, dewarp)),
        uuid=f"synthetic{exposure.number:023d}",
        own=own,
    )


def _numbers(matrix: NDArray[np.float64]) -> str:
    return ",".join(f"{v:.9g}" for v in geometry.normalised(matrix).ravel())


class SenteraCamera(CameraSpec):
    """A 6X: a folder per band, registered on board."""

    maker = "Sentera"

    def capture_name(self, number: int) -> str:
        return f"IMG_{number:05d}"

    def file_name(self, band: BandSpec, number: int) -> str:
        """With the folder of the band."""
        spectrum = f"{band.wavelength_nm:.0f}", f"{band.bandwidth_nm:.0f}"
        folder = "-".join((str(band.rig_index), band.name, *spectrum))
        return f"{folder}/{'_'.join((self.capture_name(number), *spectrum))}.tif"

    def write_band(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        plane = geometry.normalised(to_plane(self.bands[self.reference], band, exposure.size_px))
        matrix = "".join(f"<rdf:li>{v:.9g}</rdf:li>" for v in plane.ravel())
        xmp = _SENTERA.format(band=band, capture=f"synthetic{exposure.number:011d}", matrix=matrix)
        write_tiff(path, pixels, self, band, exposure, xmp, "SY6X0001", {}, {0x829A: rational(cameras.EXPOSURE_S)})


def _camera(name: str, kind: type[CameraSpec]) -> CameraSpec:
    """Return a camera of cameras.json."""
    entry = json.loads((_HERE / "cameras.json").read_text(encoding="utf-8"), object_hook=_tuples)[name]
    return kind(**{**entry, "bands": tuple(BandSpec(**band) for band in entry["bands"])})


def _tuples(entry: dict[str, object]) -> dict[str, object]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}


MAVIC = _camera("mavic", DjiCamera)
"""Its bands are exposed one after another: at 8 m/s and 28 m up near infra-red moves by 62 px against green between
opposite headings.
"""
MAVIC_3M = _camera("mavic-3m", DjiCamera)
"""As one real unit is: no CalibratedHMatrix, bands without distortion, and a colour camera that sees 1.19 times as far
to each side; at 8 m/s and 28 m up near infra-red moves by 32 px against red between opposite headings.
"""
ALTUM, ALTUM_PT = (_camera(name, MicaSenseCamera) for name in ("altum", "altum-pt"))
SENTERA_6X = _camera("6x", SenteraCamera)
"""One folder per band; registered on board except for the parallax and small angles."""


def to_plane(reference: BandSpec, band: BandSpec, size_px: tuple[int, int]) -> Matrix:
    """Return the homography from undistorted pixels of a band to those of the reference, for lenses at one position."""
    rays = rotation(*band.rig_degrees) @ np.linalg.inv(band.lens(*size_px).matrix)
    return np.asarray(reference.lens(*size_px).matrix @ rotation(*reference.rig_degrees).T @ rays)
