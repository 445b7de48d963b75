"""The provider of the algorithms, with the setting that names the executable."""

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsProcessingProvider

from .algorithms import AlignFlight, AlignOnto, InspectFolder, SpectralIndices

EXECUTABLE_SETTING = "AGALIGN_EXECUTABLE"


def executable_setting():
    """Return the path that the user has set under Settings, Options, Processing, Providers; empty by default."""
    return ProcessingConfig.getSetting(EXECUTABLE_SETTING) or ""


class AgalignProvider(QgsProcessingProvider):
    """The algorithms of agalign."""

    def id(self):
        """Return the identifier for `qgis_process` and models."""
        return "agalign"

    def name(self):
        """Return the name for the toolbox."""
        return "agalign"

    def longName(self):  # noqa: N802
        """Return the name for the settings."""
        return "agalign: multispectral drone images"

    def load(self):
        """Add the setting and the algorithms."""
        ProcessingConfig.addSetting(
            Setting(
                self.name(), EXECUTABLE_SETTING,
                "Executable of agalign, or its virtual environment (empty: search PATH)", "",
                valuetype=Setting.FILE,
            )
        )  # fmt: skip
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self):
        """Remove the setting."""
        ProcessingConfig.removeSetting(EXECUTABLE_SETTING)

    def loadAlgorithms(self):  # noqa: N802
        """Add every algorithm."""
        for algorithm in (AlignFlight, SpectralIndices, AlignOnto, InspectFolder):
            self.addAlgorithm(algorithm(executable_setting))
