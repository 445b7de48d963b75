"""Faults in the tags that radiometry, time, position and identity use: is the result equal, named, refused or silent?

python benchmarks/tag_faults.py FOLDER...

Each FOLDER has one or more captures of a camera with a file per band. One tag at a time is missing, 0, not a number, a
text, a number with a decimal comma, in another unit (times 1,000) or another camera's (times 1.3), in one band or in
all of the last capture. The radiance or reflectance of two raw numbers, at the centre and in a corner, is compared with
that of the files as they are: within 2 % it is equal. A fault is named if a problem, a missing or contradicted part of
the expected error, the reason for the lack of a calibration, or a band that jumps between captures of the same ground
mentions something that the files as they are do not have.
"""

import re
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import print_head, print_row, run

from agalign.batch.capture_task import missing_radiometry
from agalign.batch.render import lost_reflectance
from agalign.cameras.discover import discover
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, Directory, Entry, add_directories, read_directories, text
from agalign.pixels.radiometry import calibrated, with_checked_pixels, with_radiometry
from agalign.pixels.raster import read_tile
from agalign.records.sidecar import BandRadiometryPart, OutputPart
from agalign.report.light_over_captures import LightOverCaptures
from agalign.values.capture import Band, Capture

XMP_TAGS = (
    *("RadiometricCalibration", "VignettingCenter", "VignettingPolynomial", "CentralWavelength", "BandName"),
    *("HorizontalIrradiance", "SpectralIrradiance", "DirectIrradiance", "ScatteredIrradiance", "Irradiance"),
    *("SolarElevation", "SolarAzimuth", "Yaw", "Pitch", "Roll", "IrradianceYaw", "IrradiancePitch", "IrradianceRoll"),
    *("SensorGain", "ExposureTime", "SensorGainAdjustment", "VignettingData", "BlackCurrent", "SunSensor"),
    *("CalibratedOpticalCenterX", "GpsLatitude", "GpsLongtitude", "DroneID", "CaptureId", "CaptureUUID", "FlightId"),
)
NAMED_ENTRIES = {
    "ExposureTime": (EXIF, 33434),
    "ISOSpeed": (EXIF, 34867),
    "ISOSpeedRatings": (EXIF, 34855),
    "DateTimeOriginal": (EXIF, 36867),
    "BodySerialNumber": (EXIF, 42033),
    "FocalPlaneXResolution": (EXIF, 41486),
    "GPSLatitude": (GPS, 2),
    "GPSLatitudeRef": (GPS, 1),
    "GPSLongitude": (GPS, 4),
    "GPSLongitudeRef": (GPS, 3),
    "GPSAltitude": (GPS, 6),
    "BlackLevel": (0, 50714),
    "Make": (0, 271),
    "Model": (0, 272),
}
"""(directory, number) of tags of TIFF and Exif."""
_NUMBER = rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?"


def _scaled(value: bytes, factor: float) -> bytes:
    return re.sub(_NUMBER, lambda m: b"%.10g" % (float(m[0]) * factor), value)


FAULTS: dict[str, Callable[[bytes], bytes | None]] = {
    "missing": lambda _: None,
    "0": lambda v: re.sub(_NUMBER, b"0", v),
    "nan": lambda v: re.sub(_NUMBER, b"nan", v),
    "text": lambda v: re.sub(_NUMBER, b"unknown", v),
    "comma": lambda v: re.sub(rb"(\d)\.(\d)", rb"\1,\2", v),
    "other unit": lambda v: _scaled(v, 1000.0),
    "other camera": lambda v: _scaled(v, 1.3) if re.search(rb"\d\.\d|^\d+$", v) else v[::-1],
}


class Outcome(NamedTuple):
    """What a user gets of a folder."""

    values: dict[str, np.ndarray]
    """(2,) values of two raw numbers by band; nan without a calibration."""
    facts: tuple[object, ...]
    """Number of captures, time, position, camera and flight of the first."""
    said: frozenset[str]
    """What is said about the files, without paths and numbers."""


def main(folders: list[Path]) -> None:
    print_head("camera", "fault", "tries", "equal", "named", "refused", "silent")
    silent = []
    with tempfile.TemporaryDirectory() as scratch:
        for folder in folders:
            control = outcome(folder)
            counts: dict[str, Counter[str]] = {}
            for name, what, where, result in results(folder, Path(scratch)):
                verdict = judged(result, control)
                counts.setdefault(what, Counter())[verdict] += 1
                silent += [f"{folder.name}: {name} {what} {where}"] if verdict == "silent" else []
            for what, of in counts.items():
                print_row(folder.name, what, of.total(), *(of[v] for v in ("equal", "named", "refused", "silent")))
    print("\nsilent:", *silent, sep="\n  ") if silent else print("\nsilent: none")


def results(folder: Path, scratch: Path) -> Iterator[tuple[str, str, str, Outcome]]:
    """Yield (tag, fault, where, outcome) of each fault that changes a file."""
    last = max(discover(folder).captures, key=lambda c: c.captured_at)
    files = sorted({band.path for band in last.bands})
    one = files[min(3, len(files) - 1)]
    for name in (*XMP_TAGS, *NAMED_ENTRIES):
        for what, fault in FAULTS.items():
            for where, damaged in (("in one band", [one]), ("in all", files)):
                target = scratch / "in"
                shutil.rmtree(target, ignore_errors=True)
                shutil.copytree(folder, target)
                is_changed = [put_fault(target / path.relative_to(folder), name, fault) for path in damaged]
                if any(is_changed):
                    yield name, what, where, outcome(target)


def put_fault(path: Path, name: str, fault: Callable[[bytes], bytes | None]) -> bool:
    """Change a tag of a file; return False if the file lacks it or it stays the same."""
    directories = read_directories(path)
    if name in NAMED_ENTRIES:
        of, number = NAMED_ENTRIES[name]
        entry = directories[of].get(number)
        changed = None if entry is None else entry_with(entry, fault)
        if entry is None or changed == entry:
            return False
        directories[of] = {k: v for k, v in directories[of].items() if k != number}
        if changed is not None:
            directories[of][number] = changed
    else:
        old = directories[0].get(XMP)
        new = None if old is None else packet_with(old.data, name.encode(), fault)
        if new is None or new == old.data:
            return False
        directories[0][XMP] = Entry(1, len(new), new)
    write(path, directories)
    return True


def packet_with(packet: bytes, name: bytes, fault: Callable[[bytes], bytes | None]) -> bytes:
    """A packet with a fault in the values of a name, as elements or attributes of any namespace but GPS."""

    def of_element(match: re.Match[bytes]) -> bytes:
        value = fault(re.sub(rb"\s+", b" ", match[2]) if b"<" not in match[2] else match[2])
        return b"" if value is None else match[1] + value + match[3]

    packet = re.sub(rb"(<[\w-]+:" + name + rb">)(.*?)(</[\w-]+:" + name + rb">)", of_element, packet, flags=re.DOTALL)
    return re.sub(rb"(\s[\w-]+:" + name + rb'=")([^"]*)(")', of_element, packet)


def entry_with(entry: Entry, fault: Callable[[bytes], bytes | None]) -> Entry | None:
    """An entry with a fault: texts as they are, numbers by their numerators, nan as 0/0."""
    if entry.type == 2:
        value = fault(entry.data.rstrip(b"\0"))
        return None if value is None else text(value.decode("latin-1"))
    if (sample := fault(b"1.5")) is None:
        return None
    if sample == b"unknown":
        return text("unknown")
    factor = {b"nan": 0.0, b"0": 0.0}.get(sample)
    if factor is None:
        factor = 1.0 if b"," in sample else float(sample) / 1.5
    layout = {3: "H", 4: "I", 5: "II", 10: "ii", 1: "B"}.get(entry.type)
    if layout is None or factor == 1.0:
        return entry
    values = np.array(list(struct.iter_unpack(f"<{layout}", entry.data)), dtype=np.float64)
    values[:, 0] = np.minimum(np.round(values[:, 0] * factor), 2**31 - 1 if len(layout) == 2 else 65535)
    if sample == b"nan" and len(layout) == 2:
        values[:, 1] = 0
    packed = b"".join(struct.pack(f"<{layout}", *map(int, row)) for row in values)
    return Entry(entry.type, entry.count, packed)


def write(path: Path, directories: dict[int, Directory]) -> None:
    """Write the directories of a file again, without those entries that were removed."""
    first = {k: v for k, v in directories[0].items() if k not in (EXIF, GPS)}
    add_directories(path, first, directories[EXIF], directories[GPS])
    for number in (n for n in (271, 272, 50714) if n not in first):
        remove_entry(path, number)


def remove_entry(path: Path, number: int) -> None:
    """Change the number of an entry of the first directory to a private one."""
    data = bytearray(path.read_bytes())
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    for k in range(count):
        if struct.unpack_from("<H", data, at + 2 + 12 * k)[0] == number:
            struct.pack_into("<H", data, at + 2 + 12 * k, 65000 + k)
    path.write_bytes(data)


def outcome(folder: Path) -> Outcome:
    """Return what a user gets of a folder with --radiometry auto."""
    try:
        scan = discover(folder)
    except Exception as error:  # a refusal of the whole folder
        return Outcome({}, (0,), frozenset({without_numbers(str(error))}))
    said = {without_numbers(p.text) for p in scan.problems}
    values: dict[str, np.ndarray] = {}
    light = LightOverCaptures()
    for capture in scan.captures:
        one = with_radiometry(capture, "auto", {})
        said |= {without_numbers(t) for t in (missing_radiometry(one, "auto"), lost_reflectance(one, "auto")) if t}
        try:
            one = replace(one, bands=tuple(with_checked_pixels(band, read_tile) for band in one.bands))
        except Exception as error:  # a refusal of the capture
            said.add(without_numbers(str(error)))
            one = replace(one, bands=tuple(replace(band, radiometry=None) for band in one.bands))
        for band in one.bands:
            values[band.path.relative_to(folder).as_posix()] = sample(band)
            errors = band.radiometry.errors if band.radiometry else ()
            said |= {f"{e.name}: {e.state}" for e in errors if e.state != "expected"}
        said |= {
            f"{c.band}: {c.remedy.cause}"
            for c in light.add(one.label, one.camera.name, one.captured_at, output_of(one))
        }
    return Outcome(values, (len(scan.captures), *identity(scan.captures)), frozenset(said))


def output_of(capture: Capture) -> OutputPart:
    """The part of a sidecar about the reflectance of a capture."""
    converted = {b.name: b.radiometry for b in capture.bands if b.radiometry is not None}
    parts = [
        BandRadiometryPart(
            band=name, quantity=r.quantity, source=r.source, std_percent=0, errors=[], cell_means=np.array(r.cell_means)
        )
        for name, r in converted.items()
        if r.cell_means
    ]
    crop = (0, 0, *capture.reference.size_px)
    return OutputPart(file=None, band_radiometry=parts, crop=crop, nodata=None)


def sample(band: Band) -> np.ndarray:
    """(2,) values of one raw number, in the middle and near a corner; nan without a calibration."""
    raw, (width, height) = np.full((1, 1), 20000), band.size_px
    if band.radiometry is None:
        return np.full(2, np.nan)
    return np.ravel([calibrated(raw, band.radiometry, x, y) for x, y in ((width // 2, height // 2), (8, 8))])


def identity(captures: tuple[Capture, ...]) -> tuple[object, ...]:
    if not captures:
        return ()
    first = captures[0]
    place = None if first.position is None else (round(first.position.latitude, 3), round(first.position.longitude, 3))
    wavelengths = tuple(sorted((b.path.name, b.wavelength_nm) for b in first.bands))
    return first.known_time[:19] or None, place, first.camera.model or None, wavelengths


def without_numbers(message: str) -> str:
    """A message without paths and numbers, which differ between folders."""
    return re.sub(r"/\S+|[\d.,]+", "", message)


def judged(result: Outcome, control: Outcome) -> str:
    """The verdict on a fault; a fact that is not known is not wrong."""
    is_complete = result.values.keys() == control.values.keys()
    is_known = is_complete and all(np.isfinite(v).all() for v in result.values.values())
    is_equal = is_known and all(np.allclose(v, control.values[k], rtol=0.02) for k, v in result.values.items())
    if is_equal and all(is_absent(own, of) for own, of in zip(result.facts, control.facts, strict=False)):
        return "equal"
    if result.said - control.said:
        return "named" if is_known else "refused"
    return "silent"


def is_absent(own: object, of_control: object) -> bool:
    """True for a fact that is equal or unknown, also where the facts are of several bands."""
    if isinstance(own, tuple) and isinstance(of_control, tuple) and len(own) == len(of_control):
        return all(is_absent(a, b) for a, b in zip(own, of_control, strict=True))
    return own is None or own == of_control


if __name__ == "__main__":
    run(main)
