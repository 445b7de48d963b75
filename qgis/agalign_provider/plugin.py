"""The plugin: adds the provider to Processing and removes it."""

from qgis.core import QgsApplication

from .provider import AgalignProvider


class AgalignPlugin:
    """The plugin object, which QGIS loads and unloads."""

    def __init__(self):
        self.provider = None

    def initProcessing(self):  # noqa: N802
        """Add the provider; `qgis_process` calls only this method."""
        self.provider = AgalignProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self):  # noqa: N802
        """Add the provider in the desktop program."""
        self.initProcessing()

    def unload(self):
        """Remove the provider."""
        if self.provider is not None:
            QgsApplication.processingRegistry().removeProvider(self.provider)
            self.provider = None
