"""Facts that are known twice: clock and sun, image size and camera, bits and saturation, raw numbers and tags, name and
band, number and time. Each comparison says what contradicts what; the more reliable source is used.

Contradictions within a file are its `doubts`, which `doubtful_files` reports; those between files are problems. Pixels
are compared with the tags by `pixels.radiometry.with_checked_pixels`.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise, product
from pathlib import Path
from statistics import median_low

from agalign.cameras.generic import Generic
from agalign.cameras.image_file import Doubt, ImageFile, Problem, problem_of
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import SAME_BAND_NM, raw_step, sizes_px
from agalign.cameras.pix4d import NAMESPACE, listed_names
from agalign.cameras.sun import Sun, sun_position
from agalign.host.text import counted, some_of
from agalign.values.capture import MIN_APART_S, Band, Capture, Position, distance_km, known_time_s
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size
from agalign.values.spectrum import band_key, contradicts, with_wavelength

_SAME_NM = 0.5
"""Between the wavelengths of two bands that are called equal."""
_MAX_SUN_ERROR = 0.02
"""Radians between the sun by the tags and by the clock: they agree within 0.001 on four cameras, and the sun moves by
this in five minutes.
"""
_MAX_POSITION_ERROR_KM = 1.0
"""Between two tags with the position of a file: receivers without corrections are within 10 m."""
_AROUND, _MAX_SPEED_KM_S = 2, 0.1
"""Captures before and after one, and the speed of a light aircraft."""
_GPS_ROLLOVER_H = 1024 * 7 * 24.0
"""Hours after which the week number of GPS repeats."""
_CLOCK_ERRORS_H = (*sorted((quarters / 4 for quarters in range(-96, 97)), key=abs), _GPS_ROLLOVER_H, -_GPS_ROLLOVER_H)
"""Hours by which a clock may be behind, as they are tried; time zones differ by quarters of an hour."""
_MAX_OFF_CENTRE = 0.1
"""Distance of the optical centre from the middle of the camera's image, relative to its longer side; cameras have up to
0.08.
"""


# ---- clock and sun


def clock_error(position: Position | None, captured_at: str, by_tags: Sun | None) -> str:
    """Return in words how wrong a clock is that contradicts the position of the sun in the tags; empty if it does not,
    or if one of them is unknown. `captured_at` is as in `Capture`.
    """
    time_s = known_time_s(captured_at)
    if position is None or time_s is None or by_tags is None:
        return ""

    def error(later_h: float) -> float:
        return by_tags.angle_to(sun_position(position, time_s + 3600 * later_h))

    later_h = next((h for h in _CLOCK_ERRORS_H if error(h) < _MAX_SUN_ERROR), None)
    if later_h == 0:
        return ""
    if later_h is None:
        return "is wrong by hours or months"
    way = "behind" if later_h > 0 else "ahead"
    if abs(later_h) == _GPS_ROLLOVER_H:
        return f"is about {abs(later_h):,.0f} hours {way} (1024 weeks, after which the week number of GPS repeats)"
    return f"is about {abs(later_h):g} hours {way}"


# ---- position


def with_position(tags: Tags, other: Position | None, by_tags: Sun | None) -> tuple[Tags, Doubt | None]:
    """Return the tags with the position that is known twice, and what is doubtful about it.

    `other` is the position by other tags than those of Exif, `by_tags` the position of the sun in the tags: it tells
    the hemispheres if the letters of a coordinate are missing.
    """
    advice = "--georeference and the map do not use the position: correct the tags"
    if tags.position is not None:
        if other is None or distance_km(tags.position, other) < _MAX_POSITION_ERROR_KM:
            return tags, None
        text = f"the positions in its Exif and XMP tags are {distance_km(tags.position, other):.0f} km apart"
        return replace(tags, position=None), Doubt(text, advice)
    if other is not None:
        return replace(tags, position=other), None
    if (at := tags.without_signs) is not None:
        is_known = by_tags is not None and known_time_s(tags.captured_at) is not None
        signs = product((1, -1), repeat=2) if is_known else ()
        places = [replace(at, latitude=at.latitude * a, longitude=at.longitude * b) for a, b in signs]
        fitting = [place for place in places if not clock_error(place, tags.captured_at, by_tags)]
        if len(fitting) == 1:
            text = f"its GPS tags lack N or S, or E or W: by the sun it is at {fitting[0].text}"
            return replace(tags, position=fitting[0]), Doubt(text, "the position is used: check it")
        return tags, Doubt("its GPS tags lack N or S, or E or W", advice)
    if tags.position_to_a_minute is not None:
        return tags, Doubt("the seconds of its GPS position are not numbers", advice)
    return tags, None


# ---- size of the image and of the camera


def pixel_scale(tags: Tags, band: Band, is_raw: Callable[[], bool]) -> tuple[PixelScale, str]:
    """Return the size of an image relative to that which its tags in pixels are for, and why these tags are not used:
    it is a part of that image; empty if they are.

    A program that resizes or crops images may leave the tags as they are. Both can keep the ratio of the sides;
    `is_raw` tells whether the pixels still have the steps of a sensor, which averaging removes.
    """
    centre_px = optical_centre_px(band)
    camera_px = _camera_size_px(tags, band.size_px, centre_px)
    if camera_px is None or camera_px == band.size_px:
        return SAME_PIXELS, ""
    scale = PixelScale.between(camera_px, band.size_px)
    is_of_one_ratio = abs(scale.x - scale.y) * max(band.size_px) < 2 * max(scale)  # sides of whole pixels
    if centre_px is None or not _is_near_middle(centre_px, camera_px):
        return scale if is_of_one_ratio and tags.camera_size_px else SAME_PIXELS, ""
    if is_of_one_ratio and not is_raw():
        return scale, ""
    width, height = camera_px
    return SAME_PIXELS, f"{lens_of_other_image(band)}, cropped or reduced from {width} x {height} px"


def optical_centre_px(band: Band) -> tuple[float, float] | None:
    """Return the optical centre of a band's image by its lens, else by its vignetting; None if both are unknown."""
    if band.lens is not None:
        return band.lens.cx_px, band.lens.cy_px
    if band.radiometry is not None and any(band.radiometry.vignetting):
        return band.radiometry.vignetting_centre_px
    return None


def lens_of_other_image(band: Band) -> str:
    """Return in words that the lens in the tags, or its vignetting, is not that of a band's image."""
    (width, height), (x, y) = band.size_px, optical_centre_px(band) or (math.nan, math.nan)
    focal = "" if band.lens is None else f"focal length {band.lens.fx_px:.0f} px, "
    at = f"{focal}optical centre {x:.0f}, {y:.0f} px"
    return f"the lens in the tags ({at}) is not that of an image of {width} x {height} px"


def vignetting_of_other_lens(band: Band) -> str:
    """Return in words that the centre of the vignetting is far from the optical centre of the lens; empty if it is not,
    or if one of them is unknown.
    """
    if band.lens is None or band.radiometry is None or not any(band.radiometry.vignetting):
        return ""
    (x, y), lens = band.radiometry.vignetting_centre_px, band.lens
    max_apart = 0.08  # of the longer side of the image; 0.03 in the files of eight cameras
    apart_px = math.hypot(x - lens.cx_px, y - lens.cy_px)
    is_apart = apart_px > max_apart * max(band.size_px)
    return f"the vignetting has its centre {apart_px:.0f} px from the optical centre of the lens" if is_apart else ""


def _camera_size_px(tags: Tags, size_px: Size, centre_px: tuple[float, float] | None) -> Size | None:
    """The size of the camera's image by EXIF, else by the model: that of the image, or with this centre."""
    if tags.camera_size_px is not None:
        return tags.camera_size_px
    known = sizes_px(tags.model)
    near = [size for size in known if centre_px is not None and _is_near_middle(centre_px, size)]
    return size_px if size_px in known else next(iter(near), None)


def _is_near_middle(centre_px: tuple[float, float], size_px: Size) -> bool:
    max_px = _MAX_OFF_CENTRE * max(size_px)
    return all(abs(c - side / 2) < max_px for c, side in zip(centre_px, size_px, strict=True))


# ---- bits and saturation


def full_scale(band: Band) -> float:
    """Return the divisor of pixel values in the radiometric models of the makers: 2 ** bits, 16 in most files."""
    largest = 65535.0 if band.saturation_value is None or band.dtype == "int16" else band.saturation_value
    return largest + 1.0


def raw_step_of(tags: Tags, band: Band) -> int:
    """Return the common divisor of the raw numbers in a file; 1 if it is unknown, or if the file has fewer bits."""
    return raw_step(tags.model) if full_scale(band) == 65536.0 and band.dtype == "uint16" else 1


# ---- raw numbers and tags


def min_raw_step(tags: Tags, band: Band) -> int:
    """Return the step from which the pixels of a file are raw numbers: 1 for one with fewer bits than its type, which
    only cameras write.
    """
    usual_step = 16  # of 12 bits in 16; averages of a few numbers have smaller steps
    if full_scale(band) < 1 << 16:
        return 1
    return max(raw_step_of(tags, band), usual_step)


def normalized(tags: Tags) -> str:
    """Return in words that the tags declare pixels that are not raw numbers; empty if they do not."""
    if tags.number(NAMESPACE, "IsNormalized") == 1:
        return "the tag IsNormalized says that the pixels are calibrated already"
    return ""


# ---- what several files say


def doubtful_files(files: Sequence[ImageFile]) -> Iterator[Problem]:
    """Yield a problem for each kind of doubt, which names the first file with it."""
    by_advice: dict[str, list[tuple[ImageFile, str]]] = defaultdict(list)
    for file in files:
        for doubt in file.doubts:
            by_advice[doubt.advice].append((file, doubt.text))
    for advice, found in by_advice.items():
        (file, text), *rest = found
        others = f", and so in {counted(len(rest), 'other file')}" if rest else ""
        yield problem_of(file.path, f"{text}{others}; {advice}", is_harmless=True)


def list_problems(files: Sequence[ImageFile]) -> Iterator[Problem]:
    """Yield a problem for each multiband file with tags that list another number of names or wavelengths."""
    for file in files:
        names, wavelengths = len(listed_names(file.tags)), len(file.tags.numbers(NAMESPACE, "CentralWavelength"))
        bands = len(file.bands)
        if file.is_whole_capture and isinstance(file.camera, Generic) and not {names, wavelengths} <= {0, bands}:
            counts = f"{counted(names, 'name')} and {counted(wavelengths, 'wavelength')} of bands"
            text = f"has {bands} bands, and its tags list {counts}; lists of other lengths are not used"
            yield problem_of(file.path, text, is_harmless=True)


def _position(file: ImageFile) -> str:
    """The evidence of a band's position in the rig, in words; empty if there is none."""
    index, end = file.tags.text(NAMESPACE, "RigCameraIndex"), file.name_end
    return f"RigCameraIndex {index}" if index else f"'{end}' at the end of the name" if end else ""


def contradictions(groups: Iterable[Sequence[ImageFile]]) -> Iterator[Problem]:
    """Yield a problem for each position in the rig of one camera that changes its tags, and for bands with a name or
    wavelength that others contradict. `groups` are the files of each capture.
    """
    tags: dict[tuple[object, str], dict[str, list[ImageFile]]] = defaultdict(lambda: defaultdict(list))
    doubtful: dict[str, list[Path]] = defaultdict(list)
    for group in groups:
        for file in (f for f in group if len(f.bands) == 1 and f.tags.text(NAMESPACE, "BandName")):
            if file.tags.unread is None and (position := _position(file)):
                label = with_wavelength(file.bands[0].name, file.bands[0].wavelength_nm)
                tags[file.unit, position][label].append(file)
        for text, path in _doubtful([b for file in group for b in file.bands if not b.is_from_photograph]):
            doubtful[text].append(path)
    for text, paths in doubtful.items():
        yield problem_of(paths[0], f"{text}, in {counted(len(paths), 'file')}; correct the tags")
    for (_, position), by_label in tags.items():
        bands = [files[0].bands[0] for files in by_label.values()]
        wavelengths = [b.wavelength_nm for b in bands if b.wavelength_nm is not None]
        is_one_name = len({band_key(b.name) for b in bands}) == 1
        if not is_one_name or max(wavelengths, default=0.0) - min(wavelengths, default=0.0) > SAME_BAND_NM:
            captures = {label: (f.camera.capture_name(f.path) for f in files) for label, files in by_label.items()}
            what = " and ".join(f"{label} in {some_of(dict.fromkeys(names))}" for label, names in captures.items())
            advice = "one of the names is wrong: compare the images and correct the tags"
            path = [*by_label.values()][-1][0].path
            yield problem_of(path, f"files with {position} of one camera are {what}; {advice}")


def files_of_one_band(groups: Iterable[Sequence[ImageFile]]) -> Iterator[Problem]:
    """Yield a problem for each band that captures have from two files, as of different naming: f_red.tif and
    red/f_red.tif. `groups` are the files of each capture; bands of one name and other wavelengths are two bands.
    """
    clashes: dict[str, list[tuple[Path, Path]]] = defaultdict(list)
    for group in groups:
        first: dict[str, ImageFile] = {}
        for file in (f for f in group if len(f.bands) == 1):
            other = first.setdefault(band_key(file.bands[0].name), file)
            nms = [b.wavelength_nm for b in (*other.bands, *file.bands) if b.wavelength_nm is not None]
            if other is not file and max(nms, default=0.0) - min(nms, default=0.0) <= SAME_BAND_NM:
                clashes[file.bands[0].name].append((other.path, file.path))
    for name, pairs in clashes.items():
        other_path, path = pairs[0]
        others = f", and so in {counted(len(pairs) - 1, 'other file')}" if len(pairs) > 1 else ""
        twin = other_path.name if other_path.name != path.name else other_path
        text = f"is band '{name}' of one capture as {twin} is{others}; both are aligned: move one of them elsewhere"
        yield problem_of(path, text)


def _doubtful(bands: Sequence[Band]) -> Iterator[tuple[str, Path]]:
    """Yield (what contradicts, file) of the bands of a capture."""
    known = sorted(((b, b.wavelength_nm) for b in bands if b.wavelength_nm is not None), key=lambda pair: pair[1])
    for band, nm in known:
        if contradicts(band.name, nm):
            yield f"the name '{band.name}' contradicts its wavelength of {nm:g} nm, so that no index uses it", band.path
    for (one, nm), (other, other_nm) in pairwise(known):
        if other_nm - nm < _SAME_NM and band_key(one.name) != band_key(other.name):
            yield f"the bands {one.name} and {other.name} of a capture have one wavelength, {nm:g} nm", other.path


def of_other_captures(groups: Sequence[Sequence[ImageFile]]) -> Iterator[Problem]:
    """Yield a problem for each file with the tags of a different capture: its position is far from that of the other
    files of its capture, or these share a serial number, and its own is in no other capture. `groups` are the files of
    each capture.
    """
    advice = "correct the tags"
    # The second half of a dual camera, or the camera of one band, has its own serial number in every capture.
    captures = Counter(serial for group in groups for serial in {f.tags.serial for f in group})
    for group in (g for g in groups if len(g) > 2):
        places = [(f, f.tags.position) for f in group if f.tags.position is not None]
        if places:
            latitude, longitude = (
                median_low(getattr(p, axis) for _, p in places) for axis in ("latitude", "longitude")
            )
            for file, place in places:
                if (km := distance_km(place, Position(latitude, longitude))) > _MAX_POSITION_ERROR_KM:
                    text = f"its position is {km:.0f} km from that of the other files of its capture; {advice}"
                    yield problem_of(file.path, text, is_harmless=True)
        serials = Counter(f.tags.serial for f in group if f.tags.serial)
        is_shared = len(serials) == 2 < serials.total()
        for file in (f for f in group if is_shared and serials[f.tags.serial] == 1 == captures[f.tags.serial]):
            text = f"its serial number {file.tags.serial} is not that of the other files; {advice}"
            yield problem_of(file.path, text, is_harmless=True)


def far_from_flight(captures: Iterable[Capture]) -> Iterator[Problem]:
    """Yield a problem for the first capture of each camera whose position is too far from those of the captures around
    it in time for any aircraft.
    """
    by_camera: dict[object, list[tuple[float, Position, Capture]]] = defaultdict(list)
    for capture in captures:
        time_s = known_time_s(capture.captured_at)
        if capture.position is not None and time_s is not None and capture.camera.unit:
            by_camera[capture.camera].append((time_s, capture.position, capture))
    for flight in by_camera.values():
        flight.sort(key=lambda one: one[0])
        found: list[tuple[Capture, float]] = []
        for k, (time_s, place, capture) in enumerate(flight):
            around = [*flight[max(0, k - _AROUND) : k], *flight[k + 1 : k + 1 + _AROUND]]
            far_km = [
                km
                for other_s, other, _ in around
                if (km := distance_km(place, other)) > _MAX_POSITION_ERROR_KM + _MAX_SPEED_KM_S * abs(other_s - time_s)
            ]
            if len(far_km) > len(around) / 2:
                found.append((capture, min(far_km)))
        if found:
            (capture, km), *rest = found
            others = f", and so are {counted(len(rest), 'other capture')}" if rest else ""
            path = capture.reference.path
            text = f"its position is {km:.0f} km from those of the captures around it{others}; correct the tags"
            yield problem_of(path, text, is_harmless=True)


# ---- number and time


def exposed_apart(groups: Sequence[Sequence[ImageFile]]) -> list[Problem]:
    """Return a problem for each band whose exposures are seconds apart from those of the other bands.

    The problem names the band by the end of its file names, and the neighbouring capture whose time it fits. `groups`
    are the files of each capture, which were grouped by their numbers.
    """
    apart: dict[str, list[tuple[ImageFile, float]]] = defaultdict(list)
    others: dict[str, list[float]] = defaultdict(list)
    for group in (g for g in groups if len(g) > 1 and not g[0].capture_id):
        times = {f.path: time_s for f in group if (time_s := known_time_s(f.tags.captured_at)) is not None}
        usual_s = median_low(times.values()) if times else 0.0
        for file in (f for f in group if f.path in times):
            later_s = times[file.path] - usual_s
            if abs(later_s) >= MIN_APART_S:
                apart[file.name_end].append((file, later_s))
            else:
                others[file.camera.capture_name(file.path)].append(times[file.path])
    return [_of_other_time(found, others) for found in apart.values()]


def _of_other_time(found: Sequence[tuple[ImageFile, float]], others: dict[str, list[float]]) -> Problem:
    (file, later_s), *rest = found
    when = timedelta(seconds=round(abs(later_s)))
    length = f"{abs(later_s):.0f} s" if abs(later_s) < 600 else str(when)
    text = f"was exposed {length} {'after' if later_s > 0 else 'before'} the other bands of its number"
    text += f", and so {counted(len(rest), 'other file')} of its band" if rest else ""
    for one, _ in found:
        own, time_s = one.camera.capture_name(one.path), known_time_s(one.tags.captured_at) or 0.0
        near = ((abs(other_s - time_s), name) for name, of in others.items() for other_s in of if name != own)
        off_s, fitting = min(near, default=(math.inf, ""))
        if off_s < MIN_APART_S:
            text += f"; by its time {one.path.name} belongs to {fitting}: the numbers of the band are shifted"
            break
    return problem_of(file.path, f"{text}; rename the files, or give --bands without the band")
