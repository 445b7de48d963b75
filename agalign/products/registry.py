"""Every product of a capture, in the order in which they are written."""

from agalign.products.band_files import BandFiles
from agalign.products.error_map import ErrorMap
from agalign.products.index_product import IndexRasters
from agalign.products.pan_sharpen import PanSharpened
from agalign.products.picture import BeforeAfterPicture
from agalign.products.preview import Preview
from agalign.products.product import Product
from agalign.products.quality_raster import QualityRaster
from agalign.products.relief_map import ReliefMap
from agalign.products.stac import StacItem
from agalign.products.stack import Stack
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
