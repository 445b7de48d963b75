"""Synthetic cameras that write DJI's files: a TIFF per band, and a photograph of the colour camera."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from agalign.synthetic.rig import BandSpec, CameraSpec, Exposure, to_plane
from agalign.synthetic.tags import BLACK_LEVEL, WHITE_LEVEL, write_tiff
from agalign.values import geometry

_BAND_NAMES = {"Green": "G", "Red": "R", "RedEdge": "RE", "NIR": "NIR"}
_SERIAL = "SYNTHETIC0000001"
_TO_COLOUR = 1.7162, (1296.0, 972.0), (2639.9, 1978.0), (2592, 5280)
"""Of one real Mavic 3M, band frame to colour photograph: scale, a point in each, and their widths in px."""


@dataclass(frozen=True)
class DjiCamera(CameraSpec):
    """A Mavic 3 Multispectral."""

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
        xmp = _DJI.format(
            name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm, index=band.rig_index,
            of_bands=self._plane(band, exposure.size_px), **_facts(band, exposure, exposure.size_px),
        )  # fmt: skip
        write_tiff(path, pixels, self, band, exposure, xmp, _SERIAL, {}, {})

    def _plane(self, band: BandSpec, size_px: tuple[int, int]) -> str:
        """The tags that map a band's pixels to the common plane, or to the photograph."""
        if self.calibrated:
            plane = geometry.normalised(to_plane(self.bands[self.reference], band, size_px))
            return f'drone-dji:CalibratedHMatrix="{_numbers(plane)}"'
        x, y = (v * size_px[0] / 1280 for v in band.centre_offset_px)
        scale, here, there, widths = _TO_COLOUR
        own, colour = (
            np.diag([w / full, w / full, 1.0])
            for w, full in zip((size_px[0], size_px[0] * widths[1] / widths[0]), widths, strict=True)
        )
        designed = (
            geometry.translation(*there) @ np.diag([scale, scale, 1.0]) @ geometry.translation(-here[0], -here[1])
        )
        to_colour = _numbers(geometry.normalised(colour @ designed @ np.linalg.inv(own)))
        return (
            f'drone-dji:RelativeOpticalCenterX="{x:.5f}" drone-dji:RelativeOpticalCenterY="{y:.5f}" '
            f'drone-dji:DewarpHMatrix="{to_colour}"'
        )

    def _write_colour(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write one plane of a photograph and keep the others; without a file they are dark."""
        planes = [b.name for b in self.bands if b.sees == "colour"]
        kept = path.with_suffix(".npy")
        before = np.load(kept) if kept.is_file() else np.zeros((*pixels.shape, len(planes)), np.uint8)
        share = np.clip((pixels.astype(np.float32) - BLACK_LEVEL) / (WHITE_LEVEL - BLACK_LEVEL), 0, 1)
        before[..., planes.index(band.name)] = np.rint(255 * share ** (1 / 2.2))
        if planes.index(band.name) < len(planes) - 1:
            np.save(kept, before)
            return
        kept.unlink(missing_ok=True)
        size_px = round(pixels.shape[1] / band.size_ratio[0]), round(pixels.shape[0] / band.size_ratio[1])
        xmp = _DJI_COLOUR.format(**_facts(band, exposure, size_px))
        moment = exposure.moment
        exif = Image.Exif()
        exif.update({271: self.maker, 272: self.model, 306: moment})
        exif.get_ifd(0x8769).update({0x9003: moment, 0x920A: band.focal_length_mm, 0xA431: _SERIAL})
        Image.fromarray(before).save(path, quality=95, subsampling=0, exif=exif, xmp=xmp.encode())


def _facts(band: BandSpec, exposure: Exposure, size_px: tuple[int, int]) -> dict[str, object]:
    """What bands and photograph have in common."""
    width, height = band.size_px(size_px)
    pose = exposure.pose
    model, centre = band.lens(*size_px), ((width - 1) / 2, (height - 1) / 2)
    k1, k2, p1, p2, k3 = band.distortion
    offset = (model.cx_px - centre[0], model.cy_px - centre[1])
    east, south = pose.velocity_m_s
    return {
        "x": centre[0], "y": centre[1], "focal": model.fx_px, "altitude": pose.altitude_m, "yaw": pose.yaw_deg,
        "pitch": pose.pitch_deg - 90, "roll": pose.roll_deg, "north_m_s": -south, "east_m_s": east,
        "uuid": f"synthetic{exposure.number:023d}",
        "dewarp": f"2026-01-01;{model.fx_px},{model.fy_px},{offset[0]},{offset[1]},{k1},{k2},{p1},{p2},{k3}",
    }  # fmt: skip


def _numbers(matrix: NDArray[np.float64]) -> str:
    return ",".join(f"{v:.9g}" for v in matrix.ravel())


_DJI_OPEN = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
   xmlns:Camera="http://pix4d.com/camera/1.0"
   drone-dji:CaptureUUID="{uuid}" drone-dji:RelativeAltitude="{altitude:+.2f}" drone-dji:GimbalYawDegree="{yaw:+.2f}"
   drone-dji:GimbalPitchDegree="{pitch:+.2f}" drone-dji:GimbalRollDegree="{roll:+.2f}"
   drone-dji:FlightXSpeed="{north_m_s:+.1f}" drone-dji:FlightYSpeed="{east_m_s:+.1f}" drone-dji:FlightZSpeed="+0.0"
   drone-dji:CalibratedFocalLength="{focal:.6f}"
   drone-dji:CalibratedOpticalCenterX="{x:.6f}" drone-dji:CalibratedOpticalCenterY="{y:.6f}"
   drone-dji:DewarpData="{dewarp}" drone-dji:DewarpFlag="0"
"""
_DJI_CLOSE = """  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""
_DJI = f"""{_DJI_OPEN}   drone-dji:SensorIndex="{{index}}" {{of_bands}}>
   <Camera:BandName>{{name}}</Camera:BandName>
   <Camera:CentralWavelength>{{wavelength:g}}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{{fwhm:g}}</Camera:WavelengthFWHM>
{_DJI_CLOSE}"""
_DJI_COLOUR = f"{_DJI_OPEN}>{_DJI_CLOSE}"
