"""Processing algorithms: each runs one command of agalign and loads its outputs."""

import json
import shlex
from pathlib import Path

from qgis.core import (
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputHtml,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterString,
)

from .command import EXIT_PARTIAL, Command, CommandError, find_executable, sidecars_below
from .layers import styling

_RADIOMETRY = ("off", "auto", "camera", "sun", "panel")
_RADIOMETRY_TEXTS = (
    "Raw numbers", "Best that the tags allow", "Radiance by the camera's calibration",
    "Reflectance by the light sensor", "Reflectance by a calibration panel",
)  # fmt: skip
_FINISHED = {"capture", "panel", "sky"}


class AgalignAlgorithm(QgsProcessingAlgorithm):
    """Base of the algorithms: runs a command, reports its progress, and loads layers."""

    ID = TITLE = HELP = ""

    def __init__(self, executable_setting):
        super().__init__()
        self._executable_setting = executable_setting

    def createInstance(self):  # noqa: N802
        """Return a new instance; QGIS uses one per run."""
        return type(self)(self._executable_setting)

    def name(self):
        """Return the identifier for `qgis_process` and models."""
        return self.ID

    def displayName(self):  # noqa: N802
        """Return the name for the toolbox."""
        return self.TITLE

    def shortHelpString(self):  # noqa: N802
        """Return the help text next to the parameters."""
        return self.HELP

    def run_command(self, arguments, feedback, expected=0):
        """Run agalign, report its `--log-json` events, and return the command.

        Raises QgsProcessingException if it fails or is cancelled.
        """
        done, total = 0, expected

        def on_event(event):
            nonlocal done, total
            kind = event["event"]
            if kind == "found":
                total = event["captures"] * event.get("indices", 1)
                feedback.pushInfo("{} captures".format(event["captures"]))
            elif kind == "problem":
                feedback.pushWarning(event.get("message", ""))
            elif kind == "text":
                feedback.pushInfo(event["message"])
            elif kind == "learned":
                feedback.pushInfo("{}: learned in {} s".format(event["camera"], event["seconds"]))
            elif kind in _FINISHED or kind == "index":
                done += 1
                feedback.pushInfo(_line(event))
            if total:
                feedback.setProgress(min(100.0, 100.0 * done / total))

        try:
            command = Command([find_executable(self._executable_setting()), *arguments], feedback.isCanceled, on_event)
            feedback.pushCommandInfo(" ".join(map(shlex.quote, command.arguments)))
            code = command.run()
        except CommandError as error:
            raise QgsProcessingException(str(error)) from None
        if code is None:
            raise QgsProcessingException("Cancelled; run again to process the remaining captures.")
        if code == EXIT_PARTIAL:
            feedback.pushWarning("Some captures are not aligned; the report contains the reasons.")
        return command

    def load(self, path, name, context):
        """Load a raster or vector file into the project when the algorithm has ended."""
        if context.project() is None:
            return
        details = QgsProcessingContext.LayerDetails(name, context.project(), "")
        details.setPostProcessor(styling())
        details.forceName = True
        context.addLayerToLoadOnCompletion(str(path), details)


class AlignFlight(AgalignAlgorithm):
    """`agalign align`."""

    ID, TITLE = "alignflight", "Align multispectral flight"
    HELP = (
        "Finds every capture of a multispectral drone camera below a folder, co-registers its bands, verifies each "
        "alignment, and writes one stack per capture with a report. Captures that an earlier run finished are kept.\n"
        "Single captures appear on the map only with an approximate georeference. It needs position, altitude, yaw and "
        "focal length in the tags, and the height above the ground from the tags, a calibration panel, or the "
        "elevation of the ground."
    )

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802
        """Declare the parameters and outputs."""
        add = self.addParameter
        add(QgsProcessingParameterFile("INPUT", "Folder of the flight", QgsProcessingParameterFile.Folder))
        add(QgsProcessingParameterEnum("RADIOMETRY", "Values", _RADIOMETRY_TEXTS, defaultValue=0))
        add(QgsProcessingParameterString("INDICES", "Spectral indices, such as ndvi,ndre", "", optional=True))
        add(QgsProcessingParameterBoolean("GEOREFERENCE", "Georeference approximately", False))
        number = QgsProcessingParameterNumber.Double
        add(QgsProcessingParameterNumber("GROUND", "Elevation of the ground (m)", number, None, optional=True))
        add(QgsProcessingParameterBoolean("QA", "Write quality rasters", False))
        add(QgsProcessingParameterString("OPTIONS", "More options of the command line", "", optional=True))
        number = QgsProcessingParameterNumber.Integer
        add(QgsProcessingParameterNumber("LOAD", "Load at most this number of captures", number, 5, minValue=0))
        add(QgsProcessingParameterFolderDestination("OUTPUT", "Folder for the aligned captures"))
        self.addOutput(QgsProcessingOutputHtml("REPORT", "Report"))
        self.addOutput(QgsProcessingOutputFile("FLIGHT", "Map of the flight"))
        self.addOutput(QgsProcessingOutputNumber("CAPTURES", "Captures that are aligned completely"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802
        """Run the command and load its outputs."""
        out = Path(self.parameterAsString(parameters, "OUTPUT", context)).absolute()
        arguments = ["align", self.parameterAsString(parameters, "INPUT", context), "-o", out, "--log-json"]
        arguments += ["--radiometry", _RADIOMETRY[self.parameterAsEnum(parameters, "RADIOMETRY", context)]]
        indices = self.parameterAsString(parameters, "INDICES", context).strip()
        arguments += ["--index", indices] if indices else []
        arguments += ["--georeference"] if self.parameterAsBool(parameters, "GEOREFERENCE", context) else []
        if parameters.get("GROUND") is not None:
            arguments += ["--ground-elevation", repr(self.parameterAsDouble(parameters, "GROUND", context))]
        arguments += ["--qa"] if self.parameterAsBool(parameters, "QA", context) else []
        arguments += shlex.split(self.parameterAsString(parameters, "OPTIONS", context))
        self.run_command(arguments, feedback)
        results = {"OUTPUT": str(out), "CAPTURES": 0}
        flight, report = out / "flight.geojson", out / "index.html"
        if report.is_file():
            feedback.pushInfo(f"Report: {report.as_uri()}")
            results["REPORT"] = str(report)
        captures = sidecars_below(out)
        results["CAPTURES"] = sum(sidecar["status"] == "ok" for _, sidecar in captures)
        if flight.is_file():
            results["FLIGHT"] = str(flight)
            self.load(flight, "Flight", context)
        max_loaded = self.parameterAsInt(parameters, "LOAD", context)
        for path, sidecar in captures[:max_loaded]:
            self._load_capture(path, sidecar, context)
        if len(captures) > max_loaded:
            feedback.pushInfo(f"{max_loaded} of {len(captures)} captures are loaded")
        return results

    def _load_capture(self, path, sidecar, context):
        products = [(p["kind"], path.parent / p["file"]) for p in sidecar.get("products", [])]
        for kind, file in products:
            if kind == "stack":
                self.load(file, sidecar["capture"], context)
        for kind, file in products:
            if kind == "index" and file.suffix == ".tif":
                self.load(file, file.stem, context)


class SpectralIndices(AgalignAlgorithm):
    """`agalign indices`."""

    ID, TITLE = "indices", "Indices of an aligned flight"
    HELP = (
        "Spectral indices of every capture that 'Align multispectral flight' has aligned: NDVI, NDRE, GNDVI, NDWI, "
        "SAVI, EVI, or a formula of the bands B, G, R, RE and N. Values are comparable between captures only where the "
        "flight was aligned as reflectance."
    )

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802
        """Declare the parameters and outputs."""
        add = self.addParameter
        add(QgsProcessingParameterFile("INPUT", "Folder of the aligned captures", QgsProcessingParameterFile.Folder))
        add(QgsProcessingParameterString("INDICES", "Indices, separated by commas", "ndvi", optional=True))
        add(QgsProcessingParameterString("FORMULA", "Formula, such as mine=(N-RE)/(N+RE)", "", optional=True))
        add(QgsProcessingParameterBoolean("MASK_QA", "Leave out pixels with quality flags", False))
        number = QgsProcessingParameterNumber.Integer
        add(QgsProcessingParameterNumber("LOAD", "Load at most this number of rasters", number, 5, minValue=0))
        self.addOutput(QgsProcessingOutputFile("TABLE", "Statistics (indices.csv)"))
        self.addOutput(QgsProcessingOutputNumber("RASTERS", "Rasters written"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802
        """Run the command and load the rasters."""
        folder = Path(self.parameterAsString(parameters, "INPUT", context)).absolute()
        indices = self.parameterAsString(parameters, "INDICES", context).strip()
        formula = self.parameterAsString(parameters, "FORMULA", context).strip()
        arguments = ["indices", folder, "--log-json", "--json"]
        arguments += ["--index", indices] if indices else []
        arguments += ["--formula", formula] if formula else []
        arguments += ["--mask-qa"] if self.parameterAsBool(parameters, "MASK_QA", context) else []
        command = self.run_command(arguments, feedback)
        written = [r for r in json.loads(command.output)["indices"] if r["path"]]
        for report in written[: self.parameterAsInt(parameters, "LOAD", context)]:
            self.load(report["path"], Path(report["path"]).stem, context)
        return {"TABLE": str(folder / "indices.csv"), "RASTERS": len(written)}


class AlignOnto(AgalignAlgorithm):
    """`agalign onto`."""

    ID, TITLE = "onto", "Align rasters onto a reference"
    HELP = (
        "Aligns georeferenced rasters of other dates or sensors onto the pixel grid of a reference. Grids, resolutions "
        "and coordinate reference systems may differ."
    )

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802
        """Declare the parameters and outputs."""
        add = self.addParameter
        add(QgsProcessingParameterRasterLayer("REFERENCE", "Reference"))
        add(QgsProcessingParameterMultipleLayers("MOVING", "Rasters to align", QgsProcessing.TypeRaster))
        add(QgsProcessingParameterString("OPTIONS", "More options of the command line", "", optional=True))
        add(QgsProcessingParameterFolderDestination("OUTPUT", "Folder for the aligned rasters"))
        self.addOutput(QgsProcessingOutputHtml("REPORT", "Report"))
        self.addOutput(QgsProcessingOutputNumber("RASTERS", "Rasters that are aligned"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802
        """Run the command and load the rasters."""
        reference = self.parameterAsRasterLayer(parameters, "REFERENCE", context)
        moving = self.parameterAsLayerList(parameters, "MOVING", context)
        if reference is None or not moving:
            raise QgsProcessingException("Choose a reference and at least one raster to align.")
        out = Path(self.parameterAsString(parameters, "OUTPUT", context)).absolute()
        arguments = ["onto", file_of(reference), *(file_of(layer) for layer in moving), "-o", out, "--log-json"]
        arguments += shlex.split(self.parameterAsString(parameters, "OPTIONS", context))
        self.run_command(arguments, feedback)
        results, aligned = {"OUTPUT": str(out)}, 0
        report = out / "index.html"
        if report.is_file():
            feedback.pushInfo(f"Report: {report.as_uri()}")
            results["REPORT"] = str(report)
        for path, sidecar in sidecars_below(out):
            aligned += sidecar["status"] == "ok"
            if sidecar.get("output") and sidecar["output"]["file"]:
                self.load(path.parent / sidecar["output"]["file"], sidecar["capture"], context)
        return dict(results, RASTERS=aligned)


class InspectFolder(AgalignAlgorithm):
    """`agalign info`."""

    ID, TITLE = "inspect", "Inspect folder"
    HELP = "Shows what a folder contains: cameras, captures, bands, radiometry, and what is missing."

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802
        """Declare the parameters and outputs."""
        self.addParameter(QgsProcessingParameterFile("INPUT", "Folder", QgsProcessingParameterFile.Folder))
        self.addOutput(QgsProcessingOutputNumber("CAPTURES", "Captures"))
        self.addOutput(QgsProcessingOutputString("JSON", "Details"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802
        """Run the command and print the cameras."""
        folder = self.parameterAsString(parameters, "INPUT", context)
        command = self.run_command(["info", folder, "--json"], feedback)
        contents = json.loads(command.output)
        for camera in contents.get("cameras", []):
            width, height = camera["size_px"]
            feedback.pushInfo(
                "{camera} ({serial}): {captures} captures, {width} x {height} px, bands {names}".format(
                    names=", ".join(camera["bands"]), width=width, height=height,
                    **{k: camera[k] for k in ("camera", "serial", "captures")},
                )
            )  # fmt: skip
        return {"CAPTURES": len(contents["captures"]), "JSON": command.output}


def file_of(layer):
    """Return the path of a raster layer's file, without the options of GDAL after a '|'."""
    return layer.source().split("|")[0]


def _line(event):
    if event["event"] == "index":
        return "{}: {} median {}".format(event["capture"], event["index"], event.get("median"))
    if event["event"] != "capture":
        return "{}: {}".format(event["capture"], event["event"])
    counts = "" if "pairs" not in event else ", {} of {} aligned".format(event["aligned"], event["pairs"])
    return "{}: {}{}".format(event["capture"], event.get("status", event["state"]), counts)
