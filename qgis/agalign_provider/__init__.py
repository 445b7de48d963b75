"""The QGIS plugin of agalign: a provider of Processing algorithms that run its command line."""


def classFactory(iface):  # noqa: ARG001, N802
    """Return the plugin; QGIS calls this."""
    from .plugin import AgalignPlugin

    return AgalignPlugin()
