"""Every product of a capture, in the order in which they are written."""

from agalign.products.exports.tie_points import TiePoints
from agalign.products.indices.rasters import IndexRasters
from agalign.products.product import Product
from agalign.products.rasters.aligned_files import BandFiles, Stack
from agalign.products.rasters.alignment_maps import ErrorMap, QualityRaster, ReliefMap
from agalign.products.rasters.pan_sharpen import PanSharpened
from agalign.products.report.preview import BeforeAfterPicture, Preview

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
