"""A synthetic camera that writes Sentera's files: a folder per band, registered on board."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agalign.cameras.tiff_directory import rational
from agalign.synthetic.rig import BandSpec, CameraSpec, Exposure, to_plane
from agalign.synthetic.tags import EXPOSURE_S, write_tiff
from agalign.values import geometry


class SenteraCamera(CameraSpec):
    """A 6X."""

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
        xmp = _SENTERA.format(
            name=band.name, wavelength=band.wavelength_nm, fwhm=band.bandwidth_nm,
            capture=f"synthetic{exposure.number:011d}",
            matrix="".join(f"<rdf:li>{v:.9g}</rdf:li>" for v in plane.ravel()),
        )  # fmt: skip
        write_tiff(path, pixels, self, band, exposure, xmp, "SY6X0001", {}, {0x829A: rational(EXPOSURE_S)})


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
