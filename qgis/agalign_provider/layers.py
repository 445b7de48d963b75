"""Styles of the loaded layers: natural or false colour for stacks, a colour ramp for indices, and outlines by
status for footprints.
"""

import json

from osgeo import gdal
from qgis.core import (
    QgsCategorizedSymbolRenderer,
    QgsColorRampShader,
    QgsContrastEnhancement,
    QgsFillSymbol,
    QgsMultiBandColorRenderer,
    QgsProcessingLayerPostProcessorInterface,
    QgsRasterLayer,
    QgsRasterMinMaxOrigin,
    QgsRendererCategory,
    QgsSingleBandPseudoColorRenderer,
    QgsStyle,
    QgsWkbTypes,
)

_RAMP = "RdYlGn"
_STATUS_COLOURS = {
    "ok": "#1a9850", "degraded": "#fd8d3c", "failed": "#d73027", "panel": "#3182bd", "sky": "#9ecae1",
}  # fmt: skip
_FALSE_COLOUR = ("NIR", "Red", "Green")


class StyleLayer(QgsProcessingLayerPostProcessorInterface):
    """Styles a loaded layer in the main thread."""

    def postProcessLayer(self, layer, context, feedback):  # noqa: ARG002, N802
        """Style one layer; QGIS calls this."""
        if isinstance(layer, QgsRasterLayer):
            style_raster(layer)
        elif layer.fields().indexOf("status") >= 0 and layer.geometryType() == QgsWkbTypes.PolygonGeometry:
            style_footprints(layer)


_processors = []


def styling():
    """Return a new post-processor for one layer. The Processing context deletes it, so layers must not share one;
    the list `_processors` keeps Python from deleting it earlier.
    """
    _processors.append(StyleLayer())
    return _processors[-1]


def style_raster(layer):
    """Style an index raster by a colour ramp over the span of its statistics, and a stack by three of its bands."""
    path = layer.source()
    span = index_span(path)
    if span is not None:
        _style_index(layer, *span)
    elif layer.bandCount() > 2:
        _style_stack(layer, colour_bands(path))
    layer.triggerRepaint()


def style_footprints(layer):
    """Outline footprints in a colour for each status, without filling the rasters under them."""
    categories = []
    for status, colour in _STATUS_COLOURS.items():
        outline = {"style": "no", "outline_color": colour, "outline_width": "0.6"}
        categories.append(QgsRendererCategory(status, QgsFillSymbol.createSimple(outline), status))
    layer.setRenderer(QgsCategorizedSymbolRenderer("status", categories))
    layer.triggerRepaint()


def index_span(path):
    """Return (low, high) of the values that the picture of an index shows; None for other rasters."""
    dataset = gdal.Open(path)
    text = None if dataset is None else dataset.GetMetadataItem("INDEX_STATISTICS")
    try:
        statistics = json.loads(text)
        return float(statistics["low"]), float(statistics["high"])
    except (TypeError, ValueError, KeyError):
        return None


def colour_bands(path):
    """Return the band numbers for red, green and blue: natural colour if the file has them, else false colour with
    near infrared as red, else the first three.
    """
    dataset = gdal.Open(path)
    bands = [dataset.GetRasterBand(i + 1) for i in range(dataset.RasterCount)]
    by_colour = {band.GetColorInterpretation(): i for i, band in enumerate(bands, start=1)}
    natural = [by_colour.get(c) for c in (gdal.GCI_RedBand, gdal.GCI_GreenBand, gdal.GCI_BlueBand)]
    if all(natural):
        return tuple(natural)
    by_name = {band.GetDescription().lower(): i for i, band in enumerate(bands, start=1)}
    false = [by_name.get(name.lower()) for name in _FALSE_COLOUR]
    return tuple(false) if all(false) else (1, 2, 3)


def _style_stack(layer, bands):
    layer.setRenderer(QgsMultiBandColorRenderer(layer.dataProvider(), *bands))
    limits = QgsRasterMinMaxOrigin()
    limits.setLimits(QgsRasterMinMaxOrigin.CumulativeCut)
    layer.setContrastEnhancement(QgsContrastEnhancement.StretchToMinimumMaximum, QgsRasterMinMaxOrigin.CumulativeCut)
    layer.renderer().setMinMaxOrigin(limits)


def _style_index(layer, low, high):
    renderer = QgsSingleBandPseudoColorRenderer(layer.dataProvider(), 1)
    renderer.setClassificationMin(low)
    renderer.setClassificationMax(high)
    ramp = QgsStyle.defaultStyle().colorRamp(_RAMP)
    renderer.createShader(ramp, QgsColorRampShader.Interpolated, QgsColorRampShader.Continuous)
    layer.setRenderer(renderer)
