"""The camera of the synthetic flight of `agalign demo`: its bands, and its files with MicaSense's names and tags."""

from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign.cameras.tiff_directory import Directory, Entry, add_directories, byte_string, rational, short, text
from agalign.synthetic.rig import PIXELS_PER_MM, BandSpec, CameraSpec, Exposure, Pose

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
        width, height = band.size_px(exposure.size_px)
        model, pose = band.lens(*exposure.size_px), exposure.pose
        of_light = _MICASENSE_LIGHT.format(
            middle_x=width / 2,
            middle_y=height / 2,
            fall=-exposure.vignetting / ((width / 2) ** 2 + (height / 2) ** 2),
            gain=_IRRADIANCE / np.pi * EXPOSURE_S * 65536 / (WHITE_LEVEL - BLACK_LEVEL) / band.exposure,
            irradiance=_IRRADIANCE * 100,
        )
        return _MICASENSE.format(
            model=self.model,
            name=band.name,
            wavelength=band.wavelength_nm,
            fwhm=band.bandwidth_nm,
            cx=model.cx_px / density,
            cy=model.cy_px / density,
            focal=band.focal_length_mm,
            k1=band.distortion[0],
            k2=band.distortion[1],
            k3=band.distortion[4],
            p1=band.distortion[2],
            p2=band.distortion[3],
            rig=", ".join(f"{v + off:.6f}" for v, off in zip(band.rig_degrees, band.tags_off_deg, strict=True)),
            place=f"{band.baseline_m[0]:.4f}, {band.baseline_m[1]:.4f}, 0",
            index=band.rig_index,
            reference=self.bands[self.reference].rig_index,
            capture=f"synthetic{exposure.number:011d}",
            altitude=pose.altitude_m,
            yaw=pose.yaw_deg,
            pitch=pose.pitch_deg,
            roll=pose.roll_deg,
            of_light="" if band.sees == "heat" else of_light,
        )


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
        {
            271: text(camera.maker),
            272: text(camera.model),
            306: text(moment),
            700: byte_string(xmp.encode()),
            **first,
        },
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


_MICASENSE = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:RigName>{model}</Camera:RigName>
   <Camera:BandName>{name}</Camera:BandName>
   <Camera:CentralWavelength>{wavelength:g}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{fwhm:g}</Camera:WavelengthFWHM>
   <Camera:ModelType>perspective</Camera:ModelType>
   <Camera:PrincipalPoint>{cx:.8f},{cy:.8f}</Camera:PrincipalPoint>
   <Camera:PerspectiveFocalLength>{focal}</Camera:PerspectiveFocalLength>
   <Camera:PerspectiveFocalLengthUnits>mm</Camera:PerspectiveFocalLengthUnits>
   <Camera:PerspectiveDistortion>
    <rdf:Seq>
     <rdf:li>{k1}</rdf:li><rdf:li>{k2}</rdf:li><rdf:li>{k3}</rdf:li><rdf:li>{p1}</rdf:li><rdf:li>{p2}</rdf:li>
    </rdf:Seq>
   </Camera:PerspectiveDistortion>
   <Camera:RigRelatives>{rig}</Camera:RigRelatives>
   <Camera:RigTranslations>{place}</Camera:RigTranslations>
   <Camera:Yaw>{yaw:.4f}</Camera:Yaw>
   <Camera:Pitch>{pitch:.4f}</Camera:Pitch>
   <Camera:Roll>{roll:.4f}</Camera:Roll>
   <Camera:RigCameraIndex>{index}</Camera:RigCameraIndex>
   <Camera:RigRelativesReferenceRigCameraIndex>{reference}</Camera:RigRelativesReferenceRigCameraIndex>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:FlightId>syntheticflight00001</MicaSense:FlightId>
   <MicaSense:CaptureId>{capture}</MicaSense:CaptureId>
   <MicaSense:PressureAlt>{altitude:.3f}</MicaSense:PressureAlt>
  </rdf:Description>
{of_light} </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""

_MICASENSE_LIGHT = """  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:VignettingCenter>
    <rdf:Seq><rdf:li>{middle_x}</rdf:li><rdf:li>{middle_y}</rdf:li></rdf:Seq>
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
   <DLS:HorizontalIrradiance>{irradiance:.6f}</DLS:HorizontalIrradiance>
  </rdf:Description>
"""


BANDS = (
    BandSpec(
        "Blue",
        475,
        20,
        0.085,
        0.042,
        0.030,
        0,
        (0.31, -0.22, 0.12),
        (-0.03, -0.021),
        (-0.104, 0.150, -0.0003, 0.0006, -0.03),
        (11.2, -7.5),
    ),
    BandSpec(
        "Green",
        560,
        20,
        0.125,
        0.105,
        0.070,
        1,
        (0.0, 0.0, 0.0),
        (0.0, -0.021),
        (-0.101, 0.145, 0.0002, -0.0004, -0.02),
        (-6.3, 4.9),
    ),
    BandSpec(
        "Red",
        668,
        10,
        0.185,
        0.055,
        0.040,
        2,
        (-0.42, 0.35, -0.18),
        (0.03, -0.021),
        (-0.108, 0.158, -0.0001, 0.0003, -0.04),
        (3.7, 12.6),
    ),
    BandSpec(
        "NIR",
        840,
        40,
        0.265,
        0.520,
        0.430,
        3,
        (0.55, -0.16, 0.21),
        (-0.03, 0.021),
        (-0.110, 0.152, -0.0003, 0.0005, -0.05),
        (13.5, 9.1),
    ),
    BandSpec(
        "Red edge",
        717,
        10,
        0.225,
        0.285,
        0.220,
        4,
        (-0.27, -0.31, -0.09),
        (0.03, 0.021),
        (-0.106, 0.160, 0.0004, -0.0002, -0.06),
        (-9.4, -5.8),
    ),
)
REFERENCE = 1

REDEDGE = MicaSenseCamera("RedEdge-M", BANDS, REFERENCE)
