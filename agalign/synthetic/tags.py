"""The files of a synthetic flight: names, pixels and tags as the makers of the cameras write them."""

from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign.cameras.tiff_directory import Entry, add_directories, byte_string, rational, short, text
from agalign.synthetic.rig import FOCAL_LENGTH_MM, PIXELS_PER_MM, REFERENCE, BandSpec, CameraSpec, Pose, to_plane
from agalign.values import geometry

BLACK_LEVEL, WHITE_LEVEL = 4800.0, 52000.0
_EXPOSURE_S = 1.3e-3
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""
_MAVIC_NAMES = {"Green": "G", "Red": "R", "RedEdge": "RE", "NIR": "NIR"}


def capture_name(camera: CameraSpec, number: int) -> str:
    """What the files of a capture have in common, counted from 1."""
    return f"IMG_{number:04d}" if camera.maker == "MicaSense" else f"DJI_{20260621100000 + number}_{number:04d}"


def file_name(camera: CameraSpec, band: BandSpec, number: int) -> str:
    """Of a band of a capture, counted from 1."""
    if camera.maker == "MicaSense":
        return f"{capture_name(camera, number)}_{band.rig_index + 1}.tif"
    return f"{capture_name(camera, number)}_MS_{_MAVIC_NAMES[band.name]}.TIF"


def write_band(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int,
    vignetting: float,
) -> None:  # fmt: skip
    """Write (height, width) pixels with the tags of a camera; `vignetting` is the share of light that corners lack."""
    if camera.maker == "MicaSense":
        _micasense(path, pixels, band, pose, number, vignetting)
    else:
        _dji(path, pixels, camera, band, pose, number)


def _micasense(
    path: Path, pixels: NDArray[np.uint16], band: BandSpec, pose: Pose, number: int, vignetting: float
) -> None:
    size_px = pixels.shape[1], pixels.shape[0]
    density = PIXELS_PER_MM * size_px[0] / 1280
    model = band.lens(*size_px)
    moment = _moment(number)
    xmp = _MICASENSE.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm,
        cx=model.cx_px / density, cy=model.cy_px / density, focal=FOCAL_LENGTH_MM,
        k1=band.distortion[0], k2=band.distortion[1], k3=band.distortion[4],
        p1=band.distortion[2], p2=band.distortion[3],
        rig=", ".join(f"{v:.6f}" for v in band.rig_degrees),
        place=f"{band.baseline_m[0]:.4f}, {band.baseline_m[1]:.4f}, 0", index=band.rig_index, reference=REFERENCE,
        capture=f"synthetic{number:011d}", altitude=pose.altitude_m,
        middle_x=size_px[0] / 2, middle_y=size_px[1] / 2,
        fall=-vignetting / ((size_px[0] / 2) ** 2 + (size_px[1] / 2) ** 2),
        gain=_IRRADIANCE / np.pi * _EXPOSURE_S * 65536 / (WHITE_LEVEL - BLACK_LEVEL) / band.exposure,
        irradiance=_IRRADIANCE * 100,
    ).encode()  # fmt: skip
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    first = {
        271: text("MicaSense"), 272: text("RedEdge-M"), 305: text("agalign demo"), 306: text(moment),
        700: byte_string(xmp), 50714: short(round(BLACK_LEVEL)),
    }  # fmt: skip
    exif = {
        0x829A: rational(_EXPOSURE_S), 0x8827: short(100), 0x9003: text(moment), 0x920A: rational(FOCAL_LENGTH_MM),
        0x9290: text("000000"), 0xA20E: rational(density), 0xA20F: rational(density), 0xA210: short(4),
        0xA431: text("SY01-0000001-AG"),
    }  # fmt: skip
    add_directories(path, first, exif, _place(pose))


def _dji(path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int) -> None:
    height, width = pixels.shape
    model, density = band.lens(width, height), PIXELS_PER_MM * width / 1280
    centre = (width - 1) / 2, (height - 1) / 2
    k1, k2, p1, p2, k3 = band.distortion
    plane = geometry.normalised(to_plane(camera.bands[camera.reference], band, (width, height)))
    east, south = pose.velocity_m_s
    xmp = _DJI.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm, index=band.rig_index,
        x=centre[0], y=centre[1], plane=",".join(f"{v:.9g}" for v in plane.ravel()),
        dewarp=f"2026-01-01;{model.fx_px},{model.fy_px},{model.cx_px - centre[0]},{model.cy_px - centre[1]},"
        f"{k1},{k2},{p1},{p2},{k3}",
        focal=model.fx_px, altitude=pose.altitude_m, yaw=pose.yaw_deg, pitch=pose.pitch_deg - 90, roll=pose.roll_deg,
        north_m_s=-south, east_m_s=east, uuid=f"synthetic{number:023d}",
    ).encode()  # fmt: skip
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    moment = _moment(number)
    first = {271: text("DJI"), 272: text("M3M"), 306: text(moment), 700: byte_string(xmp)}
    exif = {
        0x9003: text(moment), 0x920A: rational(FOCAL_LENGTH_MM), 0xA20E: rational(density), 0xA20F: rational(density),
        0xA210: short(4), 0xA431: text("SYNTHETIC0000001"),
    }  # fmt: skip
    add_directories(path, first, exif, _place(pose))


def _moment(number: int) -> str:
    return f"2026:06:21 10:{number // 60:02d}:{number % 60:02d}"


def _place(pose: Pose) -> dict[int, Entry]:
    """The GPS directory."""
    return {
        1: text("N"), 2: _degrees(52.0 + pose.north_m / 111_320), 3: text("E"),
        4: _degrees(5.0 + pose.east_m / 68_500), 5: byte_string(b"\0"), 6: rational(pose.altitude_m),
    }  # fmt: skip


def _degrees(angle_deg: float) -> Entry:
    minutes = angle_deg % 1 * 60
    return rational(int(angle_deg), int(minutes), minutes % 1 * 60)


_MICASENSE = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:Camera="http://pix4d.com/camera/1.0">
   <Camera:RigName>RedEdge-M</Camera:RigName>
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
   <Camera:VignettingCenter>
    <rdf:Seq><rdf:li>{middle_x}</rdf:li><rdf:li>{middle_y}</rdf:li></rdf:Seq>
   </Camera:VignettingCenter>
   <Camera:VignettingPolynomial>
    <rdf:Seq>
     <rdf:li>0</rdf:li><rdf:li>{fall:.9e}</rdf:li><rdf:li>0</rdf:li>
     <rdf:li>0</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li>
    </rdf:Seq>
   </Camera:VignettingPolynomial>
   <Camera:RigRelatives>{rig}</Camera:RigRelatives>
   <Camera:RigTranslations>{place}</Camera:RigTranslations>
   <Camera:RigCameraIndex>{index}</Camera:RigCameraIndex>
   <Camera:RigRelativesReferenceRigCameraIndex>{reference}</Camera:RigRelativesReferenceRigCameraIndex>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:MicaSense="http://micasense.com/MicaSense/1.0/">
   <MicaSense:FlightId>syntheticflight00001</MicaSense:FlightId>
   <MicaSense:CaptureId>{capture}</MicaSense:CaptureId>
   <MicaSense:PressureAlt>{altitude:.3f}</MicaSense:PressureAlt>
   <MicaSense:RadiometricCalibration>
    <rdf:Seq><rdf:li>{gain:.9e}</rdf:li><rdf:li>0</rdf:li><rdf:li>0</rdf:li></rdf:Seq>
   </MicaSense:RadiometricCalibration>
  </rdf:Description>
  <rdf:Description rdf:about="Pix4D Camera Information" xmlns:DLS="http://micasense.com/DLS/1.0/">
   <DLS:HorizontalIrradiance>{irradiance:.6f}</DLS:HorizontalIrradiance>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""

_DJI = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
   xmlns:Camera="http://pix4d.com/camera/1.0"
   drone-dji:CaptureUUID="{uuid}" drone-dji:RelativeAltitude="{altitude:+.2f}" drone-dji:GimbalYawDegree="{yaw:+.2f}"
   drone-dji:GimbalPitchDegree="{pitch:+.2f}" drone-dji:GimbalRollDegree="{roll:+.2f}"
   drone-dji:FlightXSpeed="{north_m_s:+.1f}" drone-dji:FlightYSpeed="{east_m_s:+.1f}" drone-dji:FlightZSpeed="+0.0"
   drone-dji:SensorIndex="{index}" drone-dji:CalibratedFocalLength="{focal:.6f}"
   drone-dji:CalibratedOpticalCenterX="{x:.6f}" drone-dji:CalibratedOpticalCenterY="{y:.6f}"
   drone-dji:CalibratedHMatrix="{plane}" drone-dji:DewarpData="{dewarp}">
   <Camera:BandName>{name}</Camera:BandName>
   <Camera:CentralWavelength>{wavelength:g}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{fwhm:g}</Camera:WavelengthFWHM>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""
