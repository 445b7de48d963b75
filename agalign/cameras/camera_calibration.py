"""The radiometric calibration of the files of one camera, compared: what some of them lack, and what differs."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from agalign.cameras.image_file import ImageFile, Problem, problem_of
from agalign.host.text import counted
from agalign.values.capture import Band
from agalign.values.radiometry import RadiometricError
from agalign.values.spectrum import band_key

_SAME = 0.01
"""Relative difference of factors of the calibration, which are constant for a band of a camera."""


def with_complete_calibrations(files: Sequence[ImageFile]) -> list[ImageFile]:
    """Return the files, those that lack a factor which other files of their camera have without what depends on it.

    Otherwise a band could be darker than the others by what is not corrected in it. A camera without the factor, such
    as one with early firmware, keeps its calibration, whose error has the factor as missing.
    """
    by_camera: dict[object, list[ImageFile]] = defaultdict(list)
    for file in files:
        by_camera[file.unit].append(file)
    has_all = {}
    for key, of_camera in by_camera.items():
        known = [b.radiometry for file in of_camera for b in file.bands if b.radiometry]
        of_sun = [radiometry.by_sun.errors for radiometry in known if radiometry.by_sun]
        has_all[key] = _known(radiometry.errors for radiometry in known), _known(of_sun), bool(of_sun)
    return [
        replace(file, bands=tuple(_without_incomplete(b, *has_all[file.unit]) for b in file.bands)) for file in files
    ]


def _missing(errors: Iterable[RadiometricError]) -> frozenset[str]:
    return frozenset(error.name for error in errors if error.state == "missing")


def _known(of_files: Iterable[Sequence[RadiometricError]]) -> frozenset[str]:
    """The factors that some of several calibrations lack and others have."""
    lacking = [_missing(errors) for errors in of_files]
    return frozenset[str]().union(*lacking) - frozenset.intersection(*lacking) if lacking else frozenset()


def _without_incomplete(band: Band, of_radiance: frozenset[str], of_sun: frozenset[str], has_sensor: bool) -> Band:
    """A band without a calibration, or its factor to reflectance, that lacks one of these factors, or with the reason
    why it has no factor if the camera `has_sensor` for the light.
    """
    radiometry = band.radiometry
    if radiometry is None:
        return band
    if has_sensor and radiometry.is_of_light and radiometry.by_sun is None and not band.implausible:
        return replace(band, implausible="its tags lack the irradiance, which other files of the camera have")
    if lacking := _missing(radiometry.errors) & of_radiance:
        why = f"its tags lack the {' and '.join(sorted(lacking))}, which other files of the camera have"
        return replace(band, radiometry=None, missing_calibration=f"no usable tags for radiance ({why})")
    if radiometry.by_sun is not None and (lacking := _missing(radiometry.by_sun.errors) & of_sun):
        why = f"the {' and '.join(sorted(lacking))} is not known, but is in other files of the camera"
        return replace(band, radiometry=replace(radiometry, by_sun=None), implausible=why)
    return band


def different_calibrations(files: Sequence[ImageFile]) -> Iterator[Problem]:
    """Yield a problem for each kind of factor that differs between files of one band of a camera, or a black level
    that differs between its bands: one of them has the tags of another camera.
    """
    factors: dict[tuple[object, str, str], list[tuple[float, ImageFile]]] = defaultdict(list)
    for file in (f for f in files if len(f.bands) == 1):
        for what, value in _constants(file.bands[0]):
            band = "" if what == "black level" else band_key(file.bands[0].name)
            factors[file.unit, what, band].append((value, file))
    for (_, what, _), found in factors.items():
        usual, count = Counter(value for value, _ in found).most_common(1)[0]
        others = [(value, f) for value, f in found if abs(value - usual) > _SAME * abs(usual)]
        if others:
            value, file = others[0]
            rest = f", and in {counted(len(others) - 1, 'other file')}" if len(others) > 1 else ""
            text = f"the {what} in its tags is {value:g}{rest}; {counted(count, 'file')} of the camera have {usual:g}"
            yield problem_of(file.path, f"{text}; correct the tags", is_harmless=True)


def _constants(band: Band) -> Iterator[tuple[str, float]]:
    """(name, value) of the factors of a calibration that are the same in all captures."""
    radiometry = band.radiometry
    if radiometry is None or not radiometry.is_of_light:
        return
    yield "black level", radiometry.black_level
    for name in ("calibration coefficient", "gain adjustment"):
        if name in radiometry.tags:
            yield name, radiometry.tags[name]
    if radiometry.vignetting:
        # One number for all coefficients: the correction at a third of the image.
        r = max(band.size_px) / 3
        yield "vignetting", 1.0 + sum(k * r**n for n, k in enumerate(radiometry.vignetting, start=1))
