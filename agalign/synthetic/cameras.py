"""The camera of the synthetic flight of `agalign demo`."""

from agalign.synthetic.rig import BandSpec
from agalign.synthetic.tags import MicaSenseCamera

BANDS = (
    BandSpec("Blue", 475, 20, 0.085, 0.042, 0.030, 0, (0.31, -0.22, 0.12), (-0.03, -0.021),
             (-0.104, 0.150, -0.0003, 0.0006, -0.03), (11.2, -7.5)),
    BandSpec("Green", 560, 20, 0.125, 0.105, 0.070, 1, (0.0, 0.0, 0.0), (0.0, -0.021),
             (-0.101, 0.145, 0.0002, -0.0004, -0.02), (-6.3, 4.9)),
    BandSpec("Red", 668, 10, 0.185, 0.055, 0.040, 2, (-0.42, 0.35, -0.18), (0.03, -0.021),
             (-0.108, 0.158, -0.0001, 0.0003, -0.04), (3.7, 12.6)),
    BandSpec("NIR", 840, 40, 0.265, 0.520, 0.430, 3, (0.55, -0.16, 0.21), (-0.03, 0.021),
             (-0.110, 0.152, -0.0003, 0.0005, -0.05), (13.5, 9.1)),
    BandSpec("Red edge", 717, 10, 0.225, 0.285, 0.220, 4, (-0.27, -0.31, -0.09), (0.03, 0.021),
             (-0.106, 0.160, 0.0004, -0.0002, -0.06), (-9.4, -5.8)),
)  # fmt: skip
REFERENCE = 1

REDEDGE = MicaSenseCamera("RedEdge-M", BANDS, REFERENCE)
