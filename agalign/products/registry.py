"""Every product of a capture, in the order in which they are written."""

from agalign.products.aligned_files import BandFiles, Stack
from agalign.products.index_rasters import IndexRasters
from agalign.products.pan_sharpen import PanSharpened
from agalign.products.preview import BeforeAfterPicture, Preview
from agalign.products.product import Product
from agalign.products.quality_raster import ErrorMap, QualityRaster
from agalign.products.relief_map import ReliefMap
from agalign.products.stac import StacItem
from agalign.products.tie_points import TiePoints

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
    # Last: its assets are the files of the products before it.
    StacItem(),
)
