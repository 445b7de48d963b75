"""Selection of the captures of a run: which are aligned, with their radiometry, and which show a panel or the sky."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module

from agalign.batch.capture_task import missing_lens, missing_radiometry
from agalign.batch.products import PRODUCTS
from agalign.batch.workers import failure_text
from agalign.config import RunOptions, WriteSettings
from agalign.errors import AgalignError, ConfigurationError
from agalign.flight import footprint, panel_readings
from agalign.flight.panel_readings import PanelReading
from agalign.flight.sky import SkyCapture, sky_captures
from agalign.host.process_pool import ProcessPool, R, WorkerDiedError, open_pool
from agalign.host.processes import usable_cores
from agalign.pixels.radiometry import with_radiometry
from agalign.rasters.product import Product
from agalign.values.band_names import no_such_band
from agalign.values.capture import Capture
from agalign.values.spectrum import band_key


@dataclass(frozen=True)
class Selection:
    """What a run does with the captures of its input."""

    sky: Sequence[SkyCapture]
    panels: Sequence[PanelReading]
    """A scene that contains a panel is in `captures` too."""
    captures: Sequence[Capture]
    """Those to align."""
    abandoned: Mapping[str, str]
    """Why the search for sky and panels was abandoned, by label; these captures are in no other list."""


def select_captures(found: Sequence[Capture], write: WriteSettings, options: RunOptions) -> Selection:
    """Return what a run does with each of the captures that were found.

    Raises ConfigurationError if no capture has what the settings ask for: the radiometry, the metadata for a
    georeference, or the bands for a product.
    """
    _check_albedos(found, write)
    start, timeout_s = partial(import_module, __name__), options.timeout_s  # tasks do not wait for the imports
    readers = nullcontext() if timeout_s is None else open_pool(min(panel_readings.READERS, usable_cores()), 1, start)
    with readers as pool:
        result = _selected(found, write, options, _Examination(pool, timeout_s))
    captures = result.captures
    without_lens = [missing_lens(capture, write) for capture in captures]
    if captures and all(without_lens):
        raise ConfigurationError(f"{captures[0].reference.path}: {without_lens[0]}")
    missing = [missing_radiometry(capture, write.radiometry) for capture in captures]
    if captures and all(missing):
        raise ConfigurationError(f"--radiometry {write.radiometry}: {missing[0]}")
    if write.georeference and captures and all(c.reference.georeference is None for c in captures):
        raise ConfigurationError(f"--georeference: no capture has {footprint.missing_for_footprint(captures[0])}")
    for product in (one for one in PRODUCTS if one.is_enabled(write)):
        _check_product(product, captures)
    return result


def _selected(
    found: Sequence[Capture], write: WriteSettings, options: RunOptions, examine: "_Examination"
) -> Selection:
    """Return the captures by what they show, those to align with their radiometry and georeference."""
    albedos = {band_key(name): value for name, value in write.panel_albedo}
    sky: list[SkyCapture] = []
    panels: list[PanelReading] = []
    captures = list(found)
    if not options.align_panels:
        sky, captures = sky_captures(captures, examine)
        captures = list(panel_readings.with_panels(captures, without_code=bool(albedos), examine=examine))
        readings = [examine(panel_readings.read_panel, c, albedos) for c in captures if c.panel is not None]
        panels = panel_readings.compared([reading for reading in readings if reading is not None])
        captures = [c for c in captures if not c.is_of_a_panel and c.label not in examine.abandoned]
    captures = [_calibrated(capture, panels, write) for capture in captures]
    if write.georeference:
        crs = footprint.utm_of_flights(captures)
        captures = [footprint.with_approximate_georeference(c, crs[c.label]) if c.label in crs else c for c in captures]
    return Selection(sky, panels, captures, examine.abandoned)


def _check_albedos(found: Sequence[Capture], write: WriteSettings) -> None:
    """Raise NoSuchBandError for a band of --panel-albedo that no capture has."""
    known = {band_key(band.name): band.name for capture in found for band in capture.bands}
    for name, _ in write.panel_albedo if found else ():
        if name and band_key(name) not in known:
            raise no_such_band(found[0].reference.path, name, known.values(), by="--panel-albedo")


def _calibrated(capture: Capture, panels: Sequence[PanelReading], settings: WriteSettings) -> Capture:
    """Return the capture with its radiometry, and its height above the ground if the elevation of the ground or a panel
    determines it.
    """
    capture = with_radiometry(capture, settings.radiometry, panel_readings.reflectance_factors(capture, panels))
    if settings.radiometry == "panel":
        capture = replace(capture, without_panel=panel_readings.missing_panel(capture, panels))
    if settings.ground_elevation_m is not None:
        capture = footprint.above_elevation(capture, settings.ground_elevation_m)
    return panel_readings.with_height(capture, panels)


def _check_product(product: Product, captures: Sequence[Capture]) -> None:
    """Raise ConfigurationError if no capture has what a product needs."""
    problems = []
    for capture in captures:
        try:
            product.check(capture)
            return
        except AgalignError as error:
            problems.append(str(error))
    if problems:
        raise ConfigurationError(problems[0])


@dataclass(frozen=True)
class _Examination:
    """Calls functions that read the images of captures, as `flight.panel_readings.Examine`: with a time limit, in the
    processes of a pool.
    """

    pool: ProcessPool | None
    timeout_s: float | None
    abandoned: dict[str, str] = field(default_factory=dict)
    """Why a capture was abandoned, by label."""

    def __call__(self, function: Callable[..., R], capture: Capture, /, *arguments: object) -> R | None:
        if self.pool is None:
            return function(capture, *arguments)
        try:
            return self.pool.submit(function, capture, *arguments, timeout_s=self.timeout_s).result()
        except (TimeoutError, WorkerDiedError, MemoryError) as error:
            self.abandoned[capture.label] = failure_text(error, self.timeout_s)
            return None
