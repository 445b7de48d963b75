"""The camera of the synthetic flight of `agalign demo`: its bands, and its files with MicaSense's names and tags."""

from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign.cameras.tiff_directory import Directory, Entry, add_directories, byte_string, rational, short, text
from agalign.synthetic.camera_model import PIXELS_PER_MM, BandSpec, CameraSpec, Exposure, Pose

BLACK_LEVEL, WHITE_LEVEL = 4800.0, 52000.0
EXPOSURE_S = 1.3e-3
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""


class MicaSenseCamera(CameraSpec):
    """A camera that writes a TIFF per band, with MicaSense's tags."""

    maker = "MicaSense"

    def capture_name(self, number: int) -> str:
        """Shared part of the names of a capture's files; captures are counted from 1."""
        return f"IMG_{number:04d}"

    def file_name(self, band: BandSpec, number: int) -> str:
        """Name of a band's file."""
        return f"{self.capture_name(number)}_{band.rig_index + 1}.tif"

    def write_band(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write (height, width) pixels and their tags."""
        black = {} if band.sees == "heat" else {50714: short(round(BLACK_LEVEL))}
        write_tiff(
            path,
            pixels,
            self,
            band,
            exposure,
            self._xmp(band, exposure, _pixels_per_mm(pixels)),
            "SY01-0000001-AG",
            {305: text("agalign demo"), **black},
            {0x829A: rational(EXPOSURE_S * exposure.shutter), 0x8827: short(100), 0x9290: text("000000")},
        )

    def _xmp(self, band: BandSpec, exposure: Exposure, density: float) -> str:
        model, pose = band.lens(*exposure.size_px), exposure.pose
        k1, k2, p1, p2, k3 = band.distortion
        rig = ", ".join(f"{v + off:.6f}" for v, off in zip(band.rig_degrees, band.tags_off_deg, strict=True))
        light = "" if band.sees == "heat" else _light_xmp(band, exposure)
        return f"""<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:RigName>{self.model}</Camera:RigName>
   <Camera:BandName>{band.name}</Camera:BandName>
   <Camera:CentralWavelength>{band.wavelength_nm:g}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{band.bandwidth_nm:g}</Camera:WavelengthFWHM>
   <Camera:ModelType>perspective</Camera:ModelType>
   <Camera:PrincipalPoint>{model.cx_px / density:.8f},{model.cy_px / density:.8f}</Camera:PrincipalPoint>
   <Camera:PerspectiveFocalLength>{band.focal_length_mm}</Camera:PerspectiveFocalLength>
   <Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>
   <Camera:PerspectiveDistortion>
    <rdf:Seq>
     <rdf:li>{k1}</rdf:li><rdf:li>{k2}</rdf:li><rdf:li>{k3}</rdf:li><rdf:li>{p1}</rdf:li><rdf:li>{p2}</rdf:li>
    </rdf:Seq>
   </Camera:PerspectiveDistortion>
   <Camera:RigRelatives>{rig}</Camera:RigRelatives>
   <Camera:RigTranslations>{band.baseline_m[0]:.4f}, {band.baseline_m[1]:.4f}, 0</Camera:RigTranslations>
   <Camera:Yaw>{pose.yaw_deg:.4f}</Camera:Yaw>
   <Camera:Pitch>{pose.pitch_deg:.4f}</Camera:Pitch>
   <Camera:Roll>{pose.roll_deg:.4f}</Camera:Roll>
   <Camera:RigCameraIndex>{band.rig_index}</Camera:RigCameraIndex>
   <Camera:RigRelativesReferenceRigCameraIndex>{self.bands[self.reference].rig_index}</Camera:RigRelativesReferenceRigCameraIndex>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:FlightId>syntheticflight00001</MicaSense:FlightId>
   <MicaSense:CaptureId>synthetic{exposure.number:011d}</MicaSense:CaptureId>
   <MicaSense:PressureAlt>{pose.altitude_m:.3f}</MicaSense:PressureAlt>
  </rdf:Description>
{light} </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""


def _light_xmp(band: BandSpec, exposure: Exposure) -> str:
    """Vignetting, radiometric calibration and light sensor."""
    width, height = band.size_px(exposure.size_px)
    fall = -exposure.vignetting / ((width / 2) ** 2 + (height / 2) ** 2)
    gain = _IRRADIANCE / np.pi * EXPOSURE_S * 65536 / (WHITE_LEVEL - BLACK_LEVEL) / band.exposure
    return f"""  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:VignettingCenter>
    <rdf:Seq><rdf:li>{width / 2}</rdf:li><rdf:li>{height / 2}</rdf:li></rdf:Seq>
   </Camera:VignettingCenter>
   <Camera:VignettingPolynomial>
    <rdf:Seq>
     <rdf:li>0</rdf:li><rdf:li>{fall:.9e}</rdf:li><rdf:li>0</rdf:li>
     <rdf:li>0</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li>
    </rdf:Seq>
   </Camera:VignettingPolynomial>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:RadiometricCalibration>
    <rdf:Seq><rdf:li>{gain:.9e}</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li></rdf:Seq>
   </MicaSense:RadiometricCalibration>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:DLS="http://micasense.com/DLS/1.0/">
   <DLS:HorizontalIrradiance>{_IRRADIANCE * 100:.6f}</DLS:HorizontalIrradiance>
  </rdf:Description>
"""


def write_tiff(
    path: Path,
    pixels: NDArray[np.uint16],
    camera: CameraSpec,
    band: BandSpec,
    exposure: Exposure,
    xmp: str,
    serial: str,
    first: Directory,
    exif: Directory,
) -> None:
    """Write (height, width) pixels with the tags that all makers write; `first` and `exif` are a maker's additions to
    the first directory and to the Exif directory.
    """
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    moment, density = exposure.moment, rational(_pixels_per_mm(pixels))
    add_directories(
        path,
        {271: text(camera.maker), 272: text(camera.model), 306: text(moment), 700: byte_string(xmp.encode()), **first},
        {
            0x9003: text(moment),
            0x920A: rational(band.focal_length_mm),
            0xA20E: density,
            0xA20F: density,
            0xA210: short(4),
            0xA431: text(serial),
            **exif,
        },
        _place(exposure.pose),
    )


def _pixels_per_mm(pixels: NDArray[np.uint16]) -> float:
    return PIXELS_PER_MM * float(pixels.shape[1]) / 1280


def _place(pose: Pose) -> dict[int, Entry]:
    """The GPS directory."""
    return {
        1: text("N"),
        2: _degrees(52.0 + pose.north_m / 111_320),
        3: text("E"),
        4: _degrees(5.0 + pose.east_m / 68_500),
        5: byte_string(b"\0"),
        6: rational(pose.altitude_m),
    }


def _degrees(angle_deg: float) -> Entry:
    minutes = angle_deg % 1 * 60
    return rational(int(angle_deg), int(minutes), minutes % 1 * 60)


_SPECTRA = (
    ("Blue", 475, 20, 0.085, 0.042, 0.030),
    ("Green", 560, 20, 0.125, 0.105, 0.070),
    ("Red", 668, 10, 0.185, 0.055, 0.040),
    ("NIR", 840, 40, 0.265, 0.520, 0.430),
    ("Red edge", 717, 10, 0.225, 0.285, 0.220),
)
_LENSES = (
    ((0.31, -0.22, 0.12), (-0.03, -0.021), (-0.104, 0.150, -0.0003, 0.0006, -0.03), (11.2, -7.5)),
    ((0.0, 0.0, 0.0), (0.0, -0.021), (-0.101, 0.145, 0.0002, -0.0004, -0.02), (-6.3, 4.9)),
    ((-0.42, 0.35, -0.18), (0.03, -0.021), (-0.108, 0.158, -0.0001, 0.0003, -0.04), (3.7, 12.6)),
    ((0.55, -0.16, 0.21), (-0.03, 0.021), (-0.110, 0.152, -0.0003, 0.0005, -0.05), (13.5, 9.1)),
    ((-0.27, -0.31, -0.09), (0.03, 0.021), (-0.106, 0.160, 0.0004, -0.0002, -0.06), (-9.4, -5.8)),
)
BANDS = tuple(BandSpec(*_SPECTRA[index], index, *_LENSES[index]) for index in range(len(_SPECTRA)))
"""Fields of `BandSpec`: name to reflectances, and angles to offset of the principal point."""
REFERENCE = 1

REDEDGE = MicaSenseCamera("RedEdge-M", BANDS, REFERENCE)
