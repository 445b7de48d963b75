"""Cameras other than the demo's, with the layouts and tags of real units."""

from dataclasses import replace

from agalign.synthetic.cameras import BANDS, REFERENCE
from agalign.synthetic.rig import BandSpec
from agalign.synthetic.tags import MicaSenseCamera
from synthetic_flights.dji import DjiCamera
from synthetic_flights.sentera import SenteraCamera

MAVIC = DjiCamera("M3M", (
    BandSpec("Green", 560, 32, 0.125, 0.105, 0.070, 1, (0.0, 0.0, 0.0), (-0.012, -0.009),
             (-0.081, 0.095, 0.0002, -0.0003, -0.02), (-5.1, 3.4), 0.0),
    BandSpec("Red", 650, 32, 0.175, 0.060, 0.045, 2, (-0.21, 0.17, -0.11), (0.012, -0.009),
             (-0.084, 0.098, -0.0001, 0.0002, -0.02), (4.6, 8.2), 0.025),
    BandSpec("RedEdge", 730, 32, 0.230, 0.310, 0.240, 3, (-0.12, -0.24, 0.08), (-0.012, 0.009),
             (-0.079, 0.091, 0.0003, -0.0001, -0.03), (-7.7, -2.9), 0.050),
    BandSpec("NIR", 860, 52, 0.270, 0.510, 0.420, 4, (0.26, -0.09, 0.14), (0.012, 0.009),
             (-0.086, 0.101, -0.0002, 0.0003, -0.03), (9.3, 5.5), 0.075),
), 0)  # fmt: skip
"""Its bands are exposed one after another: at 8 m/s and 28 m up near infra-red moves by 62 px against green between
opposite headings.
"""


_MS_VIEW = 1.356
"""2170 px of focal length on 2592."""
_MS = replace(MAVIC.bands[0], distortion=(0.0, 0.0, 0.0, 0.0, 0.0), view=_MS_VIEW)
_TO_1280 = 1280 / 2592


def _centre(x: float, y: float) -> tuple[float, float]:
    """A RelativeOpticalCenter on 2592 x 1944 as an offset of the principal point."""
    return x * _TO_1280, y * _TO_1280


def _colours(template: BandSpec) -> tuple[BandSpec, ...]:
    """The three bands of a colour photograph."""
    shades = ("RGB Red", 620.0, 0.180, 0.070, 0.050), ("RGB Green", 545.0, 0.125, 0.100, 0.070), (
        "RGB Blue", 460.0, 0.085, 0.045, 0.032,
    )  # fmt: skip
    return tuple(
        replace(template, name=n, wavelength_nm=nm, soil=s, crop=c, tree=t, sees="colour") for n, nm, s, c, t in shades
    )


MAVIC_3M = DjiCamera("M3M", (
    replace(_MS, centre_offset_px=_centre(7.26, 16.83)),
    replace(_MS, name="Red", wavelength_nm=650, soil=0.175, crop=0.060, tree=0.045, rig_index=2,
            rig_degrees=(0.0, 0.0, 0.05), baseline_m=(0.012, -0.009), centre_offset_px=_centre(11.32, 3.06),
            delay_s=0.0128),
    replace(_MS, name="RedEdge", wavelength_nm=730, soil=0.230, crop=0.310, tree=0.240, rig_index=3,
            rig_degrees=(0.0, 0.0, -0.08), baseline_m=(-0.012, 0.009), centre_offset_px=_centre(1.15, 24.70),
            delay_s=0.0256),
    replace(_MS, name="NIR", wavelength_nm=860, bandwidth_nm=52, soil=0.270, crop=0.510, tree=0.420, rig_index=4,
            rig_degrees=(0.0, 0.0, 0.0), baseline_m=(0.012, 0.009), centre_offset_px=(0.0, 0.0), delay_s=0.0384),
    *_colours(replace(_MS, rig_index=0, rig_degrees=(0.0, 0.0, 0.03), baseline_m=(0.0, -0.03), delay_s=-0.01,
                      distortion=(-0.11, 0.012, 0.0002, -0.0001, -0.02), centre_offset_px=(0.1, 0.0),
                      size_ratio=(5280 / 2592, 3956 / 1944), view=_MS_VIEW * 5280 / 2592 / 1.7162)),
), 0, (2592, 1944), calibrated=False)  # fmt: skip
"""As one real unit is: no CalibratedHMatrix, bands without distortion, and a colour camera that sees 1.19 times as far
to each side; at 8 m/s and 28 m up near infra-red moves by 32 px against red between opposite headings.
"""

_ALTUM_VIEW = 1.0105
_ALTUM_BANDS = tuple(replace(b, view=_ALTUM_VIEW) for b in BANDS)
_LWIR = replace(
    BANDS[0], name="LWIR", wavelength_nm=11000, bandwidth_nm=6000, soil=0.46, crop=0.20, tree=0.14, rig_index=5,
    rig_degrees=(0.330743, -0.522099, 0.197540), baseline_m=(0.0, 0.03),
    distortion=(-0.38696, 0.47842, 0.00367, 0.00041, -0.48929), centre_offset_px=(-9.7, -20.5), sees="heat", view=1.117,
    tags_off_deg=(0.2, -0.15, 0.1),
)  # fmt: skip
ALTUM = MicaSenseCamera(
    "Altum", (*_ALTUM_BANDS, replace(_LWIR, size_ratio=(160 / 2064, 120 / 1544))), REFERENCE, (2064, 1544)
)
ALTUM_PT = MicaSenseCamera("Altum-PT", (
    *_ALTUM_BANDS,
    replace(BANDS[1], name="Panchro", wavelength_nm=634.5, bandwidth_nm=463, soil=0.170, crop=0.150, tree=0.110,
            rig_index=5, rig_degrees=(0.12, 0.21, -0.07), baseline_m=(0.0, 0.02), centre_offset_px=(4.2, -6.1),
            size_ratio=(4112 / 2064, 3008 / 1544), view=0.988),
    replace(_LWIR, rig_index=6, size_ratio=(320 / 2064, 256 / 1544)),
), REFERENCE, (2064, 1544))  # fmt: skip

_NO_LENS = (0.0, 0.0, 0.0, 0.0, 0.0)
SENTERA_6X = SenteraCamera("6X", tuple(
    replace(band, name=name, wavelength_nm=nm, bandwidth_nm=width, rig_index=k, distortion=_NO_LENS,
            rig_degrees=(0.1 * band.rig_degrees[0], 0.1 * band.rig_degrees[1], band.rig_degrees[2]))
    for k, (band, name, nm, width) in enumerate((
        (BANDS[0], "Blue", 475.0, 30.0), (BANDS[1], "Green", 550.0, 20.0), (BANDS[2], "Red", 670.0, 30.0),
        (BANDS[4], "RedEdge", 715.0, 10.0), (BANDS[3], "NIR", 840.0, 20.0),
    ))
), 1, (2048, 1536))  # fmt: skip
"""One folder per band; registered on board except for the parallax and small angles."""
