"""What users are told to do: the causes of issues and of cautions, each with a remedy."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Remedy:
    """Cause of some issues or cautions, and a suggestion for the user."""

    cause: str
    advice: str


# ---- of bands that are missing or not accepted

TEXTURELESS = Remedy(
    "too little common structure: water, fog, blur or noise in one of the bands",
    "align all bands together: such bands are predicted if three captures of the flight have texture; otherwise give "
    "--model OUT/models/… of an earlier flight",
)
UNLIKE = Remedy(
    "the bands do not show the same scene",
    "look at the picture: did the scene move, is a band blurred or from another place? --seed match finds large "
    "offsets; --model OUT/models/… uses the rig of an earlier flight",
)
MOSAICS = Remedy(
    "the mosaics differ by more than a pixel of REFERENCE, or have too little common structure",
    "resample both mosaics to larger pixels, of the size that you need (gdalwarp -r average -tr SIZE SIZE); compare a "
    "band in which the field changed little (--band)",
)
"""For georeferenced rasters instead of remedies that concern cameras and flights."""
MISSING_BAND = Remedy("a band of this camera is missing", "copy the files from the card; apps may not list all of them")
OTHER_REFERENCE = Remedy(
    "the reference band differs from that of most captures of the flight: pixels are on its grid",
    "copy missing files from the card again, or give --reference with a band that all captures have",
)
BLANK = Remedy(
    "a blank band", "look at the file (covered lens, defective sensor, wrong exposure); --bands omits a band"
)
ASKED = Remedy("only the seed was requested", "omit --seed and --only-seed")
UNREADABLE_BAND = Remedy("a file cannot be read", "copy it from the card again; the other bands are aligned without it")
FEW_VALID = Remedy(
    "too few valid pixels: nodata, an alpha band or saturation masks the rest",
    "crop the file to its data (gdal_translate -projwin), and look at its nodata value and its alpha band",
)
OTHER_GEOMETRY = Remedy(
    "a band was exposed at another time, or parts of the scene moved",
    "look at the picture; --bands omits the band, --relief never aligns all bands without a parallax map",
)
UNCERTAIN = Remedy(
    "blur, noise, parallax, or a part of the image without common structure",
    "look at --error-map; give --model OUT/models/… of a flight that shows the whole image",
)
OTHER_CONTENT = Remedy(
    "a part of the image shows a different scene (an incomplete file, an object near the camera, waves)",
    "look at the picture; copy the file from the card again; --bands omits a band",
)
CONTRADICTS_RIG = Remedy(
    "the result contradicts the rig of the flight",
    "if a lens was replaced or moved, align without --model; otherwise look at the picture",
)
REPETITIVE = Remedy(
    "a repetitive scene (plant rows, solar panels)",
    "keep the metadata of the camera, without --ignore-metadata, or give --model OUT/models/… of an earlier flight",
)
PARALLAX = Remedy(
    "parallax (trees, buildings, terraces), or motion between the exposures",
    "fly higher or slower, do not use --relief never; --bands omits a band",
)

# ---- of captures and of bands that have pixels

NO_RESULT = Remedy("the run has no result of the capture", "the same command resumes the run")
BLURRED = Remedy(
    TEXTURELESS.cause,
    "look at the picture: a blurred or noisy band gives wrong indices at every edge, wherever it is; "
    "--accept-predicted 0 leaves predicted bands out of indices",
)
"""For a band that is predicted already: its position is known, its pixels are not verified."""
INACCURATE = Remedy(
    "a part of the image may be off by more than 1 px of the reference",
    "look at the error map (--error-map); --qa and then 'agalign indices --mask-qa' leave these pixels out",
)
MOVED = Remedy(
    "a part of the image shows something that moved between the exposures or is near the camera, and is displaced",
    "--qa and then 'agalign indices --mask-qa' leave these pixels out; --error-map shows by how much it is displaced",
)
_CONTRADICTING_LIGHT = (
    "calibration panel and light sensor contradict each other: one was in other light, or is wrong in a band"
)
_PANEL_ADVICE = {
    "sun": "if the panels had the light of the flight, align again with --radiometry panel (the panels alone); if not, "
    "--exclude their captures",
    "panel": "if the light sensor had the light of the flight, align again with --radiometry sun (the sensor alone)",
    "auto": "align again with --radiometry panel (the panels alone) or sun (the sensor alone), whichever had the light "
    "of the flight",
}
CONTRADICTING_LIGHT = {choice: Remedy(_CONTRADICTING_LIGHT, advice) for choice, advice in _PANEL_ADVICE.items()}
"""By the `--radiometry` of the run."""
WITHOUT_REFLECTANCE = Remedy(
    "radiance, not reflectance: the tags of the light sensor cannot be used",
    "compare the tags with those of the other captures, and correct them; --radiometry panel uses calibration panels, "
    "--radiometry camera writes radiance of all captures",
)
UNCORRECTED = Remedy(
    "radiance and reflectance lack a correction: the tags do not have its factor",
    "update the firmware of the camera, or give files with all its tags; a calibration panel corrects what is the same "
    "in the whole image",
)
CONTRADICTED = Remedy(
    "two values of what the reflectance depends on contradict each other",
    "look at the panels (panels.json and their pictures) and at the tags; --exclude leaves out the captures of a panel "
    "that was shaded, wet or soiled",
)
NOT_FLAT = Remedy(
    "the mean of the captures is darker or brighter in the corners: the vignetting is not corrected as it is",
    "compare the lens and its tags with those of the camera; use the middle of the images",
)
OLD_PANEL = Remedy(
    "the light may have changed since the nearest calibration panel",
    "record a panel before and after each flight, or use a light sensor (--radiometry sun)",
)
PANEL_WITHOUT_TIME = Remedy(
    "the clock of the calibration panel was not set: the only panel, or the next one by its number, is used",
    "make sure that the panel is of this flight; --exclude leaves its capture out",
)
OLD_MODEL = Remedy(
    "aligned with an earlier model of the flight: images, captures or options have changed since",
    "--overwrite aligns all captures with the model of the whole flight",
)
NOT_IN_INPUT = Remedy(
    "the input of the last run does not have this capture", "delete its files in the output folder if it is not needed"
)
SATURATED = Remedy(
    "saturated pixels", "--qa and then 'agalign indices --mask-qa' leave them out; expose the next flight for less time"
)
INCOMPLETE_FILE = Remedy(
    "a file is incomplete at its end: the rows that it lacks are nodata", "copy the file from the card again"
)
NO_REASON = Remedy("no reason was recorded", "run again with --overwrite")
APART = Remedy(
    "the band and the reference were exposed at different times, while the camera or the scene moved",
    "look at the times in the tags; --pattern assigns files to captures, --bands omits the band",
)
JUMP = Remedy(
    "a band is darker or brighter than in the capture before over the same ground: its tags are wrong, or the light "
    "changed and the reflectance does not follow it",
    "compare exposure time and gain in the tags of both; a light sensor (--radiometry sun) follows clouds",
)
