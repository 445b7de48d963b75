"""Every product of a capture, in the order in which they are written."""

from agalign.exports.tie_points import TiePoints
from agalign.rasters.aligned_files import BandFiles, Stack
from agalign.rasters.alignment_maps import ErrorMap, QualityRaster, ReliefMap
from agalign.rasters.pan_sharpen import PanSharpened
from agalign.rasters.preview import BeforeAfterPicture, Preview
from agalign.rasters.product import Product
from agalign.spectral_indices.rasters import IndexRasters

PRODUCTS: tuple[Product, ...] = (
    BandFiles(),
    Stack(),
    PanSharpened(),
    ReliefMap(),
    ErrorMap(),
    QualityRaster(),
    TiePoints(),
    IndexRasters(),
    BeforeAfterPicture(),
    Preview(),
)
