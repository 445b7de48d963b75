"""Run in the desktop program (`qgis --code`): align a flight, load the layers, and save a picture of the window.

AGALIGN_FLIGHT, AGALIGN_OUT and AGALIGN_PICTURE name the folder of the images, the output folder and the picture.
"""

import os
import sys

import processing
from qgis.core import QgsProject
from qgis.PyQt.QtCore import QTimer
from qgis.PyQt.QtWidgets import QApplication
from qgis.utils import iface

_SECONDS = 8


def save():
    """Save the window and end the program: 0 where the layers are there."""
    iface.mainWindow().grab().save(os.environ["AGALIGN_PICTURE"])
    names = [layer.name() for layer in QgsProject.instance().mapLayers().values()]
    print("layers:", sorted(names), flush=True)
    os._exit(0 if "Flight" in names and any(n.endswith("_ndvi") for n in names) else 1)


def start():
    """Align and load as the toolbox does."""
    try:
        processing.runAndLoadResults(
            "agalign:alignflight",
            {
                "INPUT": os.environ["AGALIGN_FLIGHT"],
                "OUTPUT": os.environ["AGALIGN_OUT"],
                "RADIOMETRY": 1,
                "INDICES": "ndvi",
                "GEOREFERENCE": True,
                "GROUND": 0,
                "QA": True,
                "LOAD": 3,
            },
        )
    except Exception as error:
        print(error, file=sys.stderr, flush=True)
        os._exit(1)
    iface.mainWindow().resize(1400, 900)
    QApplication.processEvents()
    flight = QgsProject.instance().mapLayersByName("Flight")
    iface.mapCanvas().setDestinationCrs(flight[0].crs())
    iface.mapCanvas().zoomToFullExtent()
    QTimer.singleShot(_SECONDS * 1000, save)


QTimer.singleShot(2000, start)
