"""The files of a synthetic flight: names, pixels and tags as the makers of the cameras write them."""

from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from agalign.cameras.tiff_directory import Directory, Entry, add_directories, byte_string, rational, short, text
from agalign.synthetic.rig import PIXELS_PER_MM, BandSpec, CameraSpec, Pose, to_plane
from agalign.values import geometry

BLACK_LEVEL, WHITE_LEVEL = 4800.0, 52000.0
_EXPOSURE_S = 1.3e-3
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""
_MAVIC_NAMES = {"Green": "G", "Red": "R", "RedEdge": "RE", "NIR": "NIR"}
_TO_COLOUR = 1.7162, (1296.0, 972.0), (2639.9, 1978.0), (2592, 5280)
"""Of one real Mavic 3M: scale, and what of the designed bands' frame lies where in the colour photograph, of widths."""


def capture_name(camera: CameraSpec, number: int) -> str:
    """What the files of a capture have in common, counted from 1."""
    if camera.maker == "DJI":
        return f"DJI_{20260621100000 + number}_{number:04d}"
    return f"IMG_{number:05d}" if camera.maker == "Sentera" else f"IMG_{number:04d}"


def file_name(camera: CameraSpec, band: BandSpec, number: int) -> str:
    """Of a band of a capture, counted from 1; with its folder where bands have folders of their own."""
    name = capture_name(camera, number)
    if camera.maker == "DJI":
        return f"{name}_D.JPG" if band.sees == "colour" else f"{name}_MS_{_MAVIC_NAMES[band.name]}.TIF"
    if camera.maker == "Sentera":
        spectrum = f"{band.wavelength_nm:.0f}", f"{band.bandwidth_nm:.0f}"
        return f"{'-'.join((str(band.rig_index), band.name, *spectrum))}/{'_'.join((name, *spectrum))}.tif"
    return f"{name}_{band.rig_index + 1}.tif"


def write_band(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int,
    vignetting: float, size_px: tuple[int, int], shutter: float = 1.0,
) -> None:  # fmt: skip
    """Write (height, width) pixels with the tags of a camera, whose reference is of `size_px`.

    `vignetting` is the share of light that corners lack, `shutter` how long it was exposed beside the usual. A colour
    photograph is written band after band.
    """
    if band.sees == "colour":
        _colour(path, pixels, camera, band, pose, number)
    elif camera.maker == "MicaSense":
        _micasense(path, pixels, camera, band, pose, number, vignetting, size_px, shutter)
    elif camera.maker == "DJI":
        _dji(path, pixels, camera, band, pose, number, size_px)
    else:
        _sentera(path, pixels, camera, band, pose, number, size_px)


def _write(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int, xmp: str,
    serial: str, first: Directory, exif: Directory,
) -> None:  # fmt: skip
    """The tags that all makers write, and some of their own."""
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    moment, density = _moment(number), rational(_pixels_per_mm(pixels))
    add_directories(
        path,
        {
            271: text(camera.maker), 272: text(camera.model), 306: text(moment), 700: byte_string(xmp.encode()),
            **first,
        },
        {
            0x9003: text(moment), 0x920A: rational(band.focal_length_mm), 0xA20E: density, 0xA20F: density,
            0xA210: short(4), 0xA431: text(serial), **exif,
        },
        _place(pose),
    )  # fmt: skip


def _pixels_per_mm(pixels: NDArray[np.uint16]) -> float:
    return PIXELS_PER_MM * float(pixels.shape[1]) / 1280


def _micasense(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int,
    vignetting: float, size_px: tuple[int, int], shutter: float,
) -> None:  # fmt: skip
    width, height = band.size_px(size_px)
    density, model = _pixels_per_mm(pixels), band.lens(*size_px)
    of_light = _MICASENSE_LIGHT.format(
        middle_x=width / 2, middle_y=height / 2, fall=-vignetting / ((width / 2) ** 2 + (height / 2) ** 2),
        gain=_IRRADIANCE / np.pi * _EXPOSURE_S * 65536 / (WHITE_LEVEL - BLACK_LEVEL) / band.exposure,
        irradiance=_IRRADIANCE * 100,
    )  # fmt: skip
    xmp = _MICASENSE.format(
        model=camera.model, name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm,
        cx=model.cx_px / density, cy=model.cy_px / density, focal=band.focal_length_mm,
        k1=band.distortion[0], k2=band.distortion[1], k3=band.distortion[4],
        p1=band.distortion[2], p2=band.distortion[3],
        rig=", ".join(f"{v + off:.6f}" for v, off in zip(band.rig_degrees, band.tags_off_deg, strict=True)),
        place=f"{band.baseline_m[0]:.4f}, {band.baseline_m[1]:.4f}, 0", index=band.rig_index,
        reference=camera.bands[camera.reference].rig_index, capture=f"synthetic{number:011d}",
        altitude=pose.altitude_m, yaw=pose.yaw_deg, pitch=pose.pitch_deg, roll=pose.roll_deg,
        of_light="" if band.sees == "heat" else of_light,
    )  # fmt: skip
    black = {} if band.sees == "heat" else {50714: short(round(BLACK_LEVEL))}
    _write(
        path, pixels, camera, band, pose, number, xmp, "SY01-0000001-AG", {305: text("agalign demo"), **black},
        {0x829A: rational(_EXPOSURE_S * shutter), 0x8827: short(100), 0x9290: text("000000")},
    )  # fmt: skip


def _dji(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int,
    size_px: tuple[int, int],
) -> None:  # fmt: skip
    xmp = _DJI.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm, index=band.rig_index,
        of_bands=_dji_plane(camera, band, size_px), **_dji_facts(band, pose, number, size_px),
    )  # fmt: skip
    _write(path, pixels, camera, band, pose, number, xmp, "SYNTHETIC0000001", {}, {})


def _dji_plane(camera: CameraSpec, band: BandSpec, size_px: tuple[int, int]) -> str:
    """Where a band's pixels lie in what all share, as far as the unit's tags tell, and that in the photograph."""
    if camera.calibrated:
        plane = geometry.normalised(to_plane(camera.bands[camera.reference], band, size_px))
        return f'drone-dji:CalibratedHMatrix="{_numbers(plane)}"'
    x, y = (v * size_px[0] / 1280 for v in band.centre_offset_px)
    scale, here, there, widths = _TO_COLOUR
    own, colour = (
        np.diag([w / full, w / full, 1.0])
        for w, full in zip((size_px[0], size_px[0] * widths[1] / widths[0]), widths, strict=True)
    )
    designed = geometry.translation(*there) @ np.diag([scale, scale, 1.0]) @ geometry.translation(-here[0], -here[1])
    to_colour = _numbers(geometry.normalised(colour @ designed @ np.linalg.inv(own)))
    return (
        f'drone-dji:RelativeOpticalCenterX="{x:.5f}" drone-dji:RelativeOpticalCenterY="{y:.5f}" '
        f'drone-dji:DewarpHMatrix="{to_colour}"'
    )


def _dji_facts(band: BandSpec, pose: Pose, number: int, size_px: tuple[int, int]) -> dict[str, object]:
    """What bands and photograph have in common."""
    width, height = band.size_px(size_px)
    model, centre = band.lens(*size_px), ((width - 1) / 2, (height - 1) / 2)
    k1, k2, p1, p2, k3 = band.distortion
    offset = (model.cx_px - centre[0], model.cy_px - centre[1])
    east, south = pose.velocity_m_s
    return {
        "x": centre[0], "y": centre[1], "focal": model.fx_px, "altitude": pose.altitude_m, "yaw": pose.yaw_deg,
        "pitch": pose.pitch_deg - 90, "roll": pose.roll_deg, "north_m_s": -south, "east_m_s": east,
        "uuid": f"synthetic{number:023d}",
        "dewarp": f"2026-01-01;{model.fx_px},{model.fy_px},{offset[0]},{offset[1]},{k1},{k2},{p1},{p2},{k3}",
    }  # fmt: skip


def _numbers(matrix: NDArray[np.float64]) -> str:
    return ",".join(f"{v:.9g}" for v in matrix.ravel())


def _colour(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int
) -> None:
    """One plane of a photograph: the others are as they were, or dark where there is no file yet."""
    planes = [b.name for b in camera.bands if b.sees == "colour"]
    kept = path.with_suffix(".npy")
    before = np.load(kept) if kept.is_file() else np.zeros((*pixels.shape, len(planes)), np.uint8)
    share = np.clip((pixels.astype(np.float32) - BLACK_LEVEL) / (WHITE_LEVEL - BLACK_LEVEL), 0, 1)
    before[..., planes.index(band.name)] = np.rint(255 * share ** (1 / 2.2))
    if planes.index(band.name) < len(planes) - 1:
        np.save(kept, before)
        return
    kept.unlink(missing_ok=True)
    size_px = round(pixels.shape[1] / band.size_ratio[0]), round(pixels.shape[0] / band.size_ratio[1])
    xmp = _DJI_COLOUR.format(**_dji_facts(band, pose, number, size_px))
    moment = _moment(number)
    exif = Image.Exif()
    exif.update({271: camera.maker, 272: camera.model, 306: moment})
    exif.get_ifd(0x8769).update({0x9003: moment, 0x920A: band.focal_length_mm, 0xA431: "SYNTHETIC0000001"})
    Image.fromarray(before).save(path, quality=95, subsampling=0, exif=exif, xmp=xmp.encode())


def _sentera(
    path: Path, pixels: NDArray[np.uint16], camera: CameraSpec, band: BandSpec, pose: Pose, number: int,
    size_px: tuple[int, int],
) -> None:  # fmt: skip
    plane = geometry.normalised(to_plane(camera.bands[camera.reference], band, size_px))
    xmp = _SENTERA.format(
        name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm, capture=f"synthetic{number:011d}",
        matrix="".join(f"<rdf:li>{v:.9g}</rdf:li>" for v in plane.ravel()),
    )  # fmt: skip
    _write(path, pixels, camera, band, pose, number, xmp, "SY6X0001", {}, {0x829A: rational(_EXPOSURE_S)})


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

_SENTERA = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0"
   xmlns:Sentera="https://www.sentera.com/schemas/">
   <Camera:BandName>{name}</Camera:BandName>
   <Camera:CentralWavelength>{wavelength:g}</Camera:CentralWavelength>
   <Camera:WavelengthFWHM>{fwhm:g}</Camera:WavelengthFWHM>
   <Camera:FlightUUID>syntheticflight00001</Camera:FlightUUID>
   <Camera:CaptureUUID>{capture}</Camera:CaptureUUID>
   <Sentera:AlignMatrix><rdf:Seq>{matrix}</rdf:Seq></Sentera:AlignMatrix>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
"""
