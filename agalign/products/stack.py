"""The stack: all bands of a capture in one file, on one grid."""

from agalign.cameras.tag_transfer import capture_tags
from agalign.config import WriteSettings
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import media_type, write_raster


class Stack(Product):
    """A raster of all bands in the capture's order; a band that failed is all nodata."""

    kind = "stack"
    suffix = ".tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only files of single bands are written."""
        return settings.layout != "bands"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.tif."""
        settings, path = context.write_settings, context.paths.file(self.suffix)
        tags = capture_tags(context.capture.reference, context.grid)
        nodata = write_raster(context.capture, context.layers, context.grid, path, settings, tags)
        asset = StacAsset("stack", media_type(settings), ("data",))
        return [WrittenFile(self.kind, path, asset, tuple(la.band.name for la in context.layers), nodata)]
