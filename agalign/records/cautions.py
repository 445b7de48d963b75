"""What to check before the results of a run are used: one list for report, tables, console and log, largest effect
first. Here are the cautions of one capture; `PairTotals` in `report.facts` collects those of a run.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agalign.errors import InputError, SidecarError
from agalign.flight.panel_readings import MAX_TIME_DIFFERENCE_S
from agalign.flight.rig_file import model_fingerprint
from agalign.records.excluded import PanelPart, read_excluded
from agalign.records.run_record import last_record
from agalign.records.sidecar import BandRadiometryPart, BandResult, Sidecar
from agalign.values.capture import MIN_APART_S, CaptureTime
from agalign.values.issues import MISSING_BAND, MOSAICS, OF_FILES, TEXTURELESS, UNEXPECTED_PX, UNREADABLE_BAND, Remedy
from agalign.values.radiometric_errors import PANEL_AND_SENSOR

MAX_PIXEL_ERROR_PX = 1.0
"""Beyond it, a spectral index mixes neighbouring plants."""
MIN_SHARE_OVER_1_PX = 0.01
"""Share of the pixels of a band that may be off by more; smaller shares are at its edges."""
_MIN_MOVED_SHARE = 0.001
"""Share of the pixels of a band in areas that moved: one object of 35 px in a RedEdge. In ten real flights without a
moving object, no band has any."""
_MIN_OFF_STD = 3.0
"""Distance from the prediction relative to its standard error: normal errors are larger in 1 % of the bands."""
_MAX_SATURATED_SHARE = 0.005
"""Sun glint and roofs saturate fewer pixels of most captures."""
_MAX_PANEL_AGE_S, _CHANGE_OF_LIGHT = 30 * 60.0, 0.1
"""Under a clear sky with the sun above 40 degrees, the irradiance changes by up to this share in this time."""
_UNVERIFIED_PIXELS = 0.5
"""Share of the values of a predicted band that count as wrong if its image shows too little: the values of blur and
noise are wrong at edges, those of water and fog are not."""

NO_RESULT = Remedy("the run has no result of the capture", "the same command resumes the run")
BLURRED = Remedy(
    TEXTURELESS.cause,
    "look at the picture: a blurred or noisy band gives wrong indices at every edge, wherever it is; --bands omits it",
)
"""For a band that is predicted already: its position is known, its pixels are not verified."""
_INACCURATE = Remedy(
    "a part of the image may be off by more than 1 px of the reference",
    "look at the error map (--error-map); --qa and then 'agalign indices --mask-qa' leave these pixels out",
)
_MOVED = Remedy(
    "a part of the image shows something that moved between the exposures or is near the camera, and is displaced",
    "--qa and then 'agalign indices --mask-qa' leave these pixels out; --error-map shows by how much it is displaced",
)
_CONTRADICTION = (
    "calibration panel and light sensor contradict each other: one was in other light, or is wrong in a band"
)
_PANEL_ADVICE = {
    "sun": "if the panels had the light of the flight, align again with --radiometry panel (the panels alone); if not, "
    "--exclude their captures",
    "panel": "if the light sensor had the light of the flight, align again with --radiometry sun (the sensor alone)",
    "auto": "align again with --radiometry panel (the panels alone) or sun (the sensor alone), whichever had the light "
    "of the flight",
}
"""By the `--radiometry` of the run."""
_UNCORRECTED = Remedy(
    "radiance and reflectance lack a correction: the tags do not have its factor",
    "update the firmware of the camera, or give files with all its tags; a calibration panel corrects what is the same "
    "in the whole image",
)
_CONTRADICTED = Remedy(
    "two values of what the reflectance depends on contradict each other",
    "look at the panels (panels.json and their pictures) and at the tags; --exclude leaves out the captures of a panel "
    "that was shaded, wet or soiled",
)
NOT_FLAT = Remedy(
    "the mean of the captures is darker or brighter in the corners: the vignetting is not corrected as it is",
    "compare the lens and its tags with those of the camera; use the middle of the images",
)
_ABOUT = "by about {:.0%}"
_MAX_REFLECTANCE_ERROR = 1.0
"""Of a usable reflectance: a factor of 2 changes every index."""
_OLD_PANEL = Remedy(
    "the light may have changed since the nearest calibration panel",
    "record a panel before and after each flight, or use a light sensor (--radiometry sun)",
)
_PANEL_WITHOUT_TIME = Remedy(
    "the clock of the calibration panel was not set: the only panel, or the next one by its number, is used",
    "make sure that the panel is of this flight; --exclude leaves its capture out",
)
_OLD_MODEL = Remedy(
    "aligned with an earlier model of the flight: images, captures or options have changed since",
    "--overwrite aligns all captures with the model of the whole flight",
)
_NOT_IN_INPUT = Remedy(
    "the input of the last run does not have this capture", "delete its files in the output folder if it is not needed"
)
_SATURATED = Remedy(
    "saturated pixels", "--qa and then 'agalign indices --mask-qa' leave them out; expose the next flight for less time"
)


_INCOMPLETE_FILE = Remedy(
    "a file is incomplete at its end: the rows that it lacks are nodata", "copy the file from the card again"
)


@dataclass(frozen=True)
class Caution:
    """A reason to check a band of a capture."""

    band: str
    status: str
    """That of the band; `check` for an accepted one, and for a missing one `missing`."""
    remedy: Remedy
    """Its cause is what to check."""
    reason: str
    """What was measured, in words."""
    lost: float
    """Share of the values of the band, 0 to 1, that are missing, displaced or wrong: a reflectance that is wrong by
    40 % counts as 0.4.
    """
    size: float = math.nan
    size_text: str = ""
    """How large it is, or a template of it, for the largest `size` of many bands; empty without a size."""
    is_unusable: bool = False
    """The values are too uncertain for any use: the run returns exit code 3."""


@dataclass(frozen=True)
class RunFacts:
    """What the cautions about a capture depend on, other than its sidecar."""

    panels: tuple[PanelPart, ...] = ()
    """Those that contradict the light sensor."""
    models: frozenset[str] = frozenset()
    """Fingerprints of the models in OUT/models."""
    not_in_input: frozenset[str] = frozenset()
    """Labels of the captures that the input of the last run does not have."""

    @classmethod
    def of(cls, out: Path) -> "RunFacts":
        """Read the facts of a run; files that cannot be read are left out."""
        panels: list[PanelPart] = []
        models, record = set(), last_record(out)
        with suppress(SidecarError):
            panels = read_excluded(out)[0]
        for path in (out / "models").glob("*.safetensors"):
            with suppress(InputError):
                models.add(model_fingerprint(path))
        gone = frozenset[str]() if record is None else frozenset(part.capture for part in record.not_in_input)
        return cls(tuple(p for p in panels if not p.fits_sensor), frozenset(models), gone)

    def cautions(self, sidecar: Sidecar, label: str = "") -> Iterator[Caution]:
        """Yield the cautions about a capture, which are in the sidecar or follow from these facts."""
        for band in sidecar.bands:
            if band.status != "reference":
                yield from _of_alignment(band, sidecar)
            if (band.saturated or 0.0) > _MAX_SATURATED_SHARE and band.saturated is not None:
                reason = f"{band.saturated:.1%} of the pixels are saturated"
                size_text = "up to {:.1%} of a band"
                yield Caution(band.band, "check", _SATURATED, reason, band.saturated, band.saturated, size_text)
            if band.missing_rows and band.size_px is not None:
                lost = band.missing_rows / band.size_px[1]
                rows = f"the last {band.missing_rows} rows of {Path(band.file).name}"
                reason = f"{rows} are empty, all of one value: copy it again"
                yield Caution(band.band, "check", _INCOMPLETE_FILE, reason, lost, lost, "up to {:.0%} of a band")
        for name in sidecar.missing_bands:
            remedy = UNREADABLE_BAND if name in sidecar.unreadable_bands else MISSING_BAND
            yield Caution(name, "missing", remedy, sidecar.unreadable_bands.get(name, remedy.cause), 1.0)
        yield from self._of_light(sidecar)
        of_capture = [_NOT_IN_INPUT] if label in self.not_in_input else []
        if sidecar.model and self.models and sidecar.model not in self.models:
            of_capture.append(_OLD_MODEL)
        for band in (b for b in sidecar.bands if b.status != "reference"):
            yield from (Caution(band.band, "check", remedy, remedy.cause, 0.0) for remedy in of_capture)

    def _of_light(self, sidecar: Sidecar) -> Iterator[Caution]:
        """The cautions about the reflectance of all bands."""
        output = sidecar.output
        if output is None:
            return
        for band_part in output.band_radiometry:
            yield from _of_factors(band_part)
        if output.light_from is None:
            return
        scales = self._sensor_scales(sidecar.captured_at)
        age_s = output.panel_age_s or 0.0
        choice = (sidecar.options or {}).get("write", {}).get("radiometry", "auto")
        remedy = Remedy(_CONTRADICTION, _PANEL_ADVICE.get(choice, _PANEL_ADVICE["auto"]))
        is_by_panel, is_by_sensor = (name in output.light_from for name in ("panel", "light sensor"))
        is_old = age_s > _MAX_PANEL_AGE_S and not is_by_sensor
        for band in sidecar.bands:
            if is_by_panel and output.panel_age_s is None:
                yield Caution(band.band, "check", _PANEL_WITHOUT_TIME, _PANEL_WITHOUT_TIME.cause, 0.0)
            if band.band in scales:
                scale = scales[band.band]
                error = max(scale, 1 / scale) - 1
                reason = f"the irradiance on the panel is {scale:.2f} times that of the light sensor"
                text = "reflectance is uncertain by up to {:.0%}"
                is_unusable = error > _MAX_REFLECTANCE_ERROR and is_by_sensor
                yield Caution(band.band, "check", remedy, reason, min(1.0, error), error, text, is_unusable)
            if is_old:
                lost = min(1.0, _CHANGE_OF_LIGHT * age_s / _MAX_PANEL_AGE_S)
                reason = f"the nearest panel is {age_s / 60:.0f} min away"
                yield Caution(band.band, "check", _OLD_PANEL, reason, lost, age_s / 60, "up to {:.0f} min")

    def _sensor_scales(self, captured_at: str) -> dict[str, float]:
        """Irradiance on contradicting panels divided by that of the sensor, by band; the largest difference counts."""
        time, scales = CaptureTime.of(captured_at), dict[str, float]()
        for panel in self.panels:
            panel_time = CaptureTime.of(panel.captured_at)
            # A panel without a time is of the flight.
            apart_s = abs((time.utc - panel_time.utc).total_seconds()) if time and panel_time else 0.0
            if apart_s > MAX_TIME_DIFFERENCE_S:
                continue
            for band in panel.bands:
                if band.sensor_scale:
                    scales[band.band] = max(scales.get(band.band, 1.0), band.sensor_scale, key=lambda s: abs(np.log(s)))
        return scales


def _of_factors(radiometry: BandRadiometryPart) -> Iterator[Caution]:
    """The cautions about factors of the calibration of a band that are missing or contradicted."""
    for error in radiometry.errors:
        share = error.std_percent / 100
        if error.state == "missing":
            reason = f"not corrected for the {error.name}, which its tags lack: off by about {share:.0%}"
            yield Caution(radiometry.band, "check", _UNCORRECTED, reason, min(1.0, share), share, _ABOUT)
        elif error.state == "contradicted" and error.name != PANEL_AND_SENSOR:
            reason = f"{error.name}: two values differ, so that the reflectance may be off by {share:.0%}"
            yield Caution(radiometry.band, "check", _CONTRADICTED, reason, min(1.0, share), share, _ABOUT)


def _of_alignment(band: BandResult, sidecar: Sidecar) -> Iterator[Caution]:
    """The cautions about the position of a band."""
    moved = band.moved_share or 0.0
    over_1_px = max(0.0, (band.share_over_1_px or 0.0) - moved)
    if moved > _MIN_MOVED_SHARE:
        reason = f"{moved:.1%} of it shows something that moved or is near"
        yield Caution(band.band, "check", _MOVED, reason, moved, moved, "up to {:.1%} of a band")
    if band.status != "aligned":
        lost, size, size_text = 1.0, math.nan, ""
        remedy = remedy_of(band, is_mosaic=sidecar.reference.georeferenced)
        if band.status == "predicted" and band.prediction is not None:
            if band.error is not None:
                size, size_text = band.error.std_px, f"standard error up to {band.error.in_words}"
            if band.is_usable(sidecar.accept_predicted_px):
                lost = max(over_1_px, _UNVERIFIED_PIXELS if remedy is BLURRED else 0.0)
        reason = band.reason or ""
        if remedy is _APART and band.exposed_after_s is not None:
            way = "after" if band.exposed_after_s > 0 else "before"
            reason = f"exposed {abs(band.exposed_after_s):.0f} s {way} the reference; {reason}"
        yield Caution(band.band, band.status, remedy, reason, lost, size, size_text)
    elif over_1_px > MIN_SHARE_OVER_1_PX:
        reason = f"{over_1_px:.0%} of the pixels may be off by more than {MAX_PIXEL_ERROR_PX:g} px of the reference"
        yield Caution(band.band, "check", _INACCURATE, reason, over_1_px, over_1_px, "up to {:.0%} of a band")
    prediction = band.prediction
    if prediction is None or prediction.off_px is None:
        return
    if prediction.off_px > max(MAX_PIXEL_ERROR_PX, _MIN_OFF_STD * prediction.std_px):
        status = "check" if band.status == "aligned" else band.status
        reason = (
            f"its own image is aligned {prediction.off_px:.1f} px of the band from the position that the rig predicts"
        )
        # Which of the two is right is unknown.
        text, lost = "up to {:.1f} px of the band", 0.5 if band.status == "aligned" else 0.0
        yield Caution(band.band, status, UNEXPECTED_PX.remedy, reason, lost, prediction.off_px, text)


_APART = Remedy(
    "the band and the reference were exposed at different times, while the camera or the scene moved",
    "look at the times in the tags; --pattern assigns files to captures, --bands omits the band",
)


def remedy_of(band: BandResult, *, is_mosaic: bool) -> Remedy:
    """Return the remedy of the first issue of a band that is not aligned, which is the one in `reason`."""
    if not band.issues:
        return Remedy("no reason was recorded", "run again with --overwrite")
    kind = band.issues[0].kind
    if is_mosaic and kind not in OF_FILES:
        return MOSAICS
    if _is_exposed_apart(band) and kind not in OF_FILES:
        return _APART
    return BLURRED if band.status == "predicted" and kind.remedy is TEXTURELESS else kind.remedy


def _is_exposed_apart(band: BandResult) -> bool:
    return abs(band.exposed_after_s or 0.0) >= MIN_APART_S
