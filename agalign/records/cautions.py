"""What to check before the results of a run are used: one list for report, tables, console and log, largest effect
first. Here are the cautions of one capture; `PairTotals` in `report.pair_totals` collects those of a run.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agalign.errors import InputError
from agalign.flight.panel_readings import MAX_LIGHT_APART_S
from agalign.flight.rig_file import model_fingerprint
from agalign.host.files import MODELS_FOLDER
from agalign.records.panels_and_sky import PanelPart, last_panels_and_sky
from agalign.records.run_record import last_record
from agalign.records.sidecar import BandRadiometryPart, BandResult, Sidecar
from agalign.values import remedies
from agalign.values.capture import MIN_APART_S, CaptureTime
from agalign.values.issues import OF_FILES
from agalign.values.mapping_error import MAX_PIXEL_ERROR_PX
from agalign.values.radiometric_errors import PANEL_AND_SENSOR, change_of_light
from agalign.values.remedies import Remedy

MIN_SHARE_OVER_1_PX = 0.01
"""Share of the pixels of a band that may be off by more; smaller shares are at its edges."""
_MIN_MOVED_SHARE = 0.001
"""Share of the pixels of a band in areas that moved: one object of 35 px in a RedEdge. In ten real flights without a
moving object, no band has any."""
_MIN_OFF_STD = 3.0
"""Distance from the prediction relative to its standard error: normal errors are larger in 1 % of the bands."""
_MAX_SATURATED_SHARE = 0.005
"""Sun glint and roofs saturate fewer pixels of most captures."""
_MAX_PANEL_AGE_S = 30 * 60.0
"""The irradiance changes by up to 10 % in this time (`change_of_light`)."""
_UNVERIFIED_PIXELS = 0.5
"""Share of the values of a predicted band that count as wrong if its image shows too little: the values of blur and
noise are wrong at edges, those of water and fog are not."""

_MAX_REFLECTANCE_ERROR = 1.0
"""Of a usable reflectance: a factor of 2 changes every index."""


@dataclass(frozen=True, slots=True)
class Caution:
    """A reason to check a band of a capture."""

    band: str
    """Empty for the whole capture."""
    remedy: Remedy
    """Its cause is what to check."""
    reason: str
    """What was measured, in words."""
    lost: float
    """Values that are missing, displaced or wrong, in units of those of one band of one capture: a reflectance that is
    wrong by 40 % counts as 0.4, a capture as the number of its bands.
    """
    size: float = -math.inf
    size_text: str = ""
    """How large it is, in words; of many bands, that of the largest `size` is shown. Empty without a size."""
    status: str = "check"
    """That of the band; `check` for an accepted one, and for a missing one `missing`."""
    is_unusable: bool = False
    """The values are too uncertain for any use, or radiance instead of reflectance: the run returns exit code 3."""
    capture: str = ""
    """Label of the capture."""
    captures: int = 1
    """Number of captures that it is about, of which `capture` is one."""


def models_in(out: Path) -> dict[Path, str]:
    """Return the fingerprint of each model in OUT/models; files that cannot be read are left out."""
    fingerprints = {}
    for path in (out / MODELS_FOLDER).glob("*.safetensors"):
        with suppress(InputError):
            fingerprints[path] = model_fingerprint(path)
    return fingerprints


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
        models, record, (panels, _) = models_in(out), last_record(out), last_panels_and_sky(out)
        gone = frozenset[str]() if record is None else frozenset(part.capture for part in record.not_in_input)
        return cls(tuple(p for p in panels if not p.fits_sensor), frozenset(models.values()), gone)

    def cautions(self, sidecar: Sidecar, label: str = "") -> Iterator[Caution]:
        """Yield the cautions about a capture, which are in the sidecar or follow from these facts."""
        for band in sidecar.bands:
            if band.status != "reference":
                yield from _of_alignment(band, sidecar)
            if (band.saturated or 0.0) > _MAX_SATURATED_SHARE and band.saturated is not None:
                share, reason = band.saturated, f"{band.saturated:.1%} of the pixels are saturated"
                yield Caution(band.band, remedies.SATURATED, reason, share, share, f"up to {share:.1%} of a band")
            if band.missing_rows and band.size_px is not None:
                lost = band.missing_rows / band.size_px[1]
                rows = f"the last {band.missing_rows} rows of {Path(band.file).name}"
                reason = f"{rows} are empty, all of one value: copy it again"
                yield Caution(band.band, remedies.INCOMPLETE_FILE, reason, lost, lost, f"up to {lost:.0%} of a band")
        for name in sidecar.missing_bands:
            remedy = remedies.UNREADABLE_BAND if name in sidecar.unreadable_bands else remedies.MISSING_BAND
            reason = sidecar.unreadable_bands.get(name, remedy.cause)
            yield Caution(name, remedy, reason, 1.0, status="missing")
        yield from self._of_light(sidecar)
        of_capture = [remedies.NOT_IN_INPUT] if label in self.not_in_input else []
        if sidecar.model and self.models and sidecar.model not in self.models:
            of_capture.append(remedies.OLD_MODEL)
        for band in sidecar.moving:
            yield from (Caution(band.band, remedy, remedy.cause, 0.0) for remedy in of_capture)

    def _of_light(self, sidecar: Sidecar) -> Iterator[Caution]:
        """The cautions about the reflectance of all bands."""
        output = sidecar.output
        if output is None:
            return
        for band_part in output.band_radiometry:
            yield from _of_factors(band_part)
            if output.without_reflectance and band_part.quantity != "temperature":
                reason = f"not written as reflectance: {output.without_reflectance}"
                yield Caution(band_part.band, remedies.WITHOUT_REFLECTANCE, reason, 1.0, is_unusable=True)
        scales = self._sensor_scales(sidecar)
        age_s = output.panel_age_s or 0.0
        choice = sidecar.write_options.get("radiometry", "auto")
        remedy = remedies.CONTRADICTING_LIGHT.get(choice, remedies.CONTRADICTING_LIGHT["auto"])
        for band, source in output.light_sources.items():
            is_by_sensor = "light sensor" in source
            if "panel" in source and output.panel_age_s is None:
                yield Caution(band, remedies.PANEL_WITHOUT_TIME, remedies.PANEL_WITHOUT_TIME.cause, 0.0)
            if (scale := scales.get(band)) is not None:
                error = max(scale, 1 / scale) - 1
                reason = f"the irradiance on the panel is {scale:.2f} times that of the light sensor"
                text = f"reflectance is uncertain by up to {error:.0%}"
                is_unusable = error > _MAX_REFLECTANCE_ERROR and is_by_sensor
                yield Caution(band, remedy, reason, min(1.0, error), error, text, is_unusable=is_unusable)
            if age_s > _MAX_PANEL_AGE_S and not is_by_sensor:
                lost = min(1.0, change_of_light(age_s))
                reason = f"the nearest panel is {age_s / 60:.0f} min away"
                yield Caution(band, remedies.OLD_PANEL, reason, lost, age_s, f"up to {age_s / 60:.0f} min")

    def _sensor_scales(self, sidecar: Sidecar) -> dict[str, float]:
        """Irradiance on contradicting panels of the camera divided by that of the sensor, by band; the largest
        difference counts.
        """
        time, scales = CaptureTime.of(sidecar.captured_at), dict[str, float]()
        for panel in (panel for panel in self.panels if panel.camera == sidecar.camera):
            panel_time = CaptureTime.of(panel.captured_at)
            # A panel without a time is of the flight.
            apart_s = abs((time.utc - panel_time.utc).total_seconds()) if time and panel_time else 0.0
            if apart_s > MAX_LIGHT_APART_S:
                continue
            for band in panel.bands:
                if band.sensor_scale:
                    scales[band.band] = max(scales.get(band.band, 1.0), band.sensor_scale, key=lambda s: abs(np.log(s)))
        return scales


def _of_factors(radiometry: BandRadiometryPart) -> Iterator[Caution]:
    """The cautions about factors of the calibration of a band that are missing or contradicted."""
    for error in radiometry.errors:
        share = error.std_percent / 100
        lost, text = min(1.0, share), f"by about {share:.0%}"
        if error.state == "missing":
            reason = f"not corrected for the {error.name}, which its tags lack: off by about {share:.0%}"
            yield Caution(radiometry.band, remedies.UNCORRECTED, reason, lost, share, text)
        elif error.state == "contradicted" and error.name != PANEL_AND_SENSOR:
            reason = f"{error.name}: two values differ, so that the reflectance may be off by {share:.0%}"
            yield Caution(radiometry.band, remedies.CONTRADICTED, reason, lost, share, text)


def _of_alignment(band: BandResult, sidecar: Sidecar) -> Iterator[Caution]:
    """The cautions about the position of a band."""
    moved = band.moved_share or 0.0
    over_1_px = max(0.0, (band.share_over_1_px or 0.0) - moved)
    if moved > _MIN_MOVED_SHARE:
        reason = f"{moved:.1%} of it shows something that moved or is near"
        yield Caution(band.band, remedies.MOVED, reason, moved, moved, f"up to {moved:.1%} of a band")
    if band.status != "aligned":
        lost, size, size_text = 1.0, -math.inf, ""
        remedy = remedy_of(band, is_mosaic=sidecar.reference.georeferenced)
        if band.status == "predicted" and band.prediction is not None:
            if band.error is not None:
                size, size_text = band.error.std_px, f"expected error up to {band.error.in_words}"
            if band.is_usable(sidecar.accept_predicted_px):
                lost = max(over_1_px, _UNVERIFIED_PIXELS if remedy is remedies.BLURRED else 0.0)
        reason = band.reason or ""
        if remedy is remedies.APART and band.exposed_after_s is not None:
            way = "after" if band.exposed_after_s > 0 else "before"
            reason = f"exposed {abs(band.exposed_after_s):.0f} s {way} the reference; {reason}"
        yield Caution(band.band, remedy, reason, lost, size, size_text, band.status)
    elif over_1_px > MIN_SHARE_OVER_1_PX:
        reason = f"{over_1_px:.0%} of the pixels may be off by more than {MAX_PIXEL_ERROR_PX:g} px of the reference"
        yield Caution(band.band, remedies.INACCURATE, reason, over_1_px, over_1_px, f"up to {over_1_px:.0%} of a band")
    prediction = band.prediction
    if prediction is None or prediction.off_px is None:
        return
    if prediction.off_px > max(MAX_PIXEL_ERROR_PX, _MIN_OFF_STD * prediction.std_px):
        status = "check" if band.status == "aligned" else band.status
        reason = (
            f"its own image is aligned {prediction.off_px:.1f} px of the band from the position that the rig predicts"
        )
        # Which of the two is right is unknown.
        text, lost = f"up to {prediction.off_px:.1f} px of the band", 0.5 if band.status == "aligned" else 0.0
        yield Caution(band.band, remedies.CONTRADICTS_RIG, reason, lost, prediction.off_px, text, status)


def remedy_of(band: BandResult, *, is_mosaic: bool) -> Remedy:
    """Return the remedy of the first issue of a band that is not aligned, which is the one in `reason`."""
    if not band.issues:
        return remedies.NO_REASON
    kind = band.issues[0].kind
    if is_mosaic and kind not in OF_FILES:
        return remedies.MOSAICS
    if abs(band.exposed_after_s or 0.0) >= MIN_APART_S and kind not in OF_FILES:
        return remedies.APART
    return remedies.BLURRED if band.status == "predicted" and kind.remedy is remedies.TEXTURELESS else kind.remedy
