"""Facts that are known twice: which source is used, and what is said about the other."""

import math
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL.ExifTags import Base

from agalign.cameras.consistency import clock_error
from agalign.cameras.discover import DiscoverOptions, FolderScan, discover
from agalign.cameras.model_tables import filter_channels, sizes_px
from agalign.cameras.sun import Sun, sun_position
from agalign.cameras.tag_transfer import band_tags
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, Entry, add_directories, byte_string, read_directories, text
from agalign.cameras.xmp import Packet
from agalign.errors import InputError
from agalign.pixels.radiometry import with_checked_pixels
from agalign.pixels.raster import read_tile
from agalign.rasters import aligned_files
from agalign.values.capture import Capture, CaptureTime, Position
from agalign.values.image import OutputGrid

from ..conftest import write_band
from .test_vendors import DJI, MAVIC, VENDORS, Vendor, packet, survey3, write_capture, write_file

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

FLIGHT_FOLDER = Path("0000SET", "000")


def rewritten(
    source: Path,
    target: Path,
    pixels: Callable[[np.ndarray], np.ndarray] = lambda x: x,
    xmp: tuple[bytes, bytes] = (b"", b""),
    exif: Mapping[int, Entry] | None = None,
    first: Mapping[int, Entry] | None = None,
    **profile: object,
) -> None:
    """Write a file again with other pixels or tags; the other tags are copied."""
    tags = read_directories(source)
    kept = {tag: entry for tag, entry in tags[0].items() if tag in (271, 272, 306, 700, 0xC61A)}
    described = re.sub(xmp[0], xmp[1], kept[XMP].data)
    write_band(target, pixels(tifffile.imread(source)), **profile)
    add_directories(
        target, kept | {XMP: byte_string(described)} | dict(first or {}), tags[EXIF] | dict(exif or {}), tags[GPS]
    )


def one_capture(flight: Path, folder: Path, **changes: object) -> FolderScan:
    """Find the first capture of a flight, whose files are written again with changes."""
    for path in sorted((flight / FLIGHT_FOLDER).glob("IMG_0001_*.tif")):
        rewritten(path, folder / path.name, **changes)
    return discover(folder)


def only(scan: FolderScan) -> Capture:
    (capture,) = scan.captures
    return capture


# ---- clock and sun

MONTREAL, MANILA = Position(45.5, -73.6), Position(14.6, 121.0)


@pytest.mark.parametrize(
    ("place", "moment", "by_clock_h", "said"),
    [
        (MONTREAL, "2021-06-23T16:25:00", -4.0, "is about 4 hours behind"),
        (MONTREAL, "2021-06-23T16:25:00", 12.0, "is about 12 hours ahead"),
        (MANILA, "2022-02-03T02:10:00", 8.0, "is about 8 hours ahead"),
        (Position(27.7, 85.3), "2023-04-11T06:00:00", 5.75, "is about 5.75 hours ahead"),
        (MONTREAL, "2021-06-23T16:25:00", -1024 * 168, "(1024 weeks, after which the week number of GPS repeats)"),
        (MONTREAL, "2021-06-23T16:25:00", -200 * 24, "is wrong by hours or months"),
        (MONTREAL, "2021-06-23T16:25:00", 0.0, ""),
        (MONTREAL, "2021-06-23T16:25:00", 0.03, ""),
    ],
)
def test_the_sun_in_the_tags_tells_how_wrong_the_clock_is(
    place: Position, moment: str, by_clock_h: float, said: str
) -> None:
    true = datetime.fromisoformat(moment + "+00:00")
    sun = Sun(*sun_position(place, true.timestamp()))
    error = clock_error(place, (true + timedelta(hours=by_clock_h)).isoformat(), sun)
    assert said in error if said else error == ""


def test_without_position_sun_or_clock_no_clock_is_wrong() -> None:
    noon = "2021-06-23T16:25:00"
    assert clock_error(None, noon, Sun(0.1, 1.0)) == clock_error(MONTREAL, noon, None) == ""
    assert clock_error(MONTREAL, "1970-01-01T00:01:21", Sun(0.1, 1.0)) == ""


@pytest.mark.parametrize("later_h", [-4, 12, 5])
def test_the_irradiance_stays_as_measured_where_the_clock_is_wrong(flight: Path, tmp_path: Path, later_h: int) -> None:
    """The horizontal irradiance agrees with its components at the true time only."""
    original = only(discover(flight / FLIGHT_FOLDER, DiscoverOptions(include=("IMG_0001*",))))
    time = CaptureTime.of(original.captured_at)
    elevation, azimuth = sun_position(original.position, time.utc.timestamp())
    values = {
        "HorizontalIrradiance": 100 * math.sin(elevation) + 20,
        "DirectIrradiance": 100,
        "ScatteredIrradiance": 20,
    }
    values |= {"SolarElevation": elevation, "SolarAzimuth": azimuth}
    tags = "".join(f"<DLS:{name}>{value}</DLS:{name}>" for name, value in values.items())
    xmp = b"<DLS:HorizontalIrradiance>.*</DLS:HorizontalIrradiance>", tags.encode()
    wrong = (time.utc + timedelta(hours=later_h)).strftime("%Y:%m:%d %H:%M:%S")
    right = one_capture(flight, tmp_path / "right", xmp=xmp)
    shifted = one_capture(flight, tmp_path / "wrong", xmp=xmp, exif={0x9003: text(wrong)}, first={306: text(wrong)})
    irradiance = [[b.radiometry.irradiance for b in only(scan).bands] for scan in (right, shifted)]
    assert irradiance[0] == pytest.approx(irradiance[1])
    assert irradiance[0][0] == pytest.approx(values["HorizontalIrradiance"] / 100, rel=1e-3)
    assert not right.problems
    (problem,) = shifted.problems
    way = "behind" if later_h < 0 else "ahead"
    assert f"its clock is about {abs(later_h)} hours {way}, by the position of the sun" in problem.text
    assert (problem.is_harmless, "and so in 4 other files" in problem.text) == (True, True)


# ---- bits and saturation


@pytest.mark.parametrize(("bits", "shift"), [(12, 4), (10, 6), (14, 2)])
def test_a_file_with_fewer_bits_has_the_same_radiance(flight: Path, tmp_path: Path, bits: int, shift: int) -> None:
    full = only(one_capture(flight, tmp_path / "full"))
    black = Entry(3, 1, (4800 >> shift).to_bytes(2, "little"))
    few = only(one_capture(flight, tmp_path / "few", pixels=lambda x: x >> shift, first={0xC61A: black}, nbits=bits))
    for one, other in zip(full.bands, few.bands, strict=True):
        assert other.saturation_value == 2**bits - 1
        assert other.radiometry.full_scale == 2**bits
        signal = [
            (v - r.black_level) / r.full_scale for v, r in ((48000, one.radiometry), (48000 >> shift, other.radiometry))
        ]
        assert signal[1] == pytest.approx(signal[0], rel=1e-3)


def test_a_phantom_of_12_bits_has_its_own_full_scale(tmp_path: Path) -> None:
    radiance = {"SensorGain": "2", "ExposureTime": "1000", "BlackLevel": "256", "Irradiance": "5000"}
    values = {(DJI, name): (value,) for name, value in radiance.items()}
    for part in ("1", "2"):
        path = tmp_path / f"DJI_001{part}.TIF"
        write_band(path, np.full((60, 80), 1000, np.uint16), nbits=12)
        xmp = packet({(DJI, "CaptureUUID"): ("a",), **values}, "attributes")
        add_directories(path, {271: text("DJI"), 272: text("FC6360"), XMP: byte_string(xmp)}, {}, {})
    assert [b.radiometry.full_scale for b in only(discover(tmp_path)).bands] == [4096.0, 4096.0]


# ---- size of the image and of the camera


def cropped(share: float, corner: tuple[float, float]) -> Callable[[np.ndarray], np.ndarray]:
    def crop(pixels: np.ndarray) -> np.ndarray:
        height, width = (round(share * n) for n in pixels.shape)
        top, left = (round(c * (n - m)) for c, n, m in zip(corner, pixels.shape, (height, width), strict=True))
        return pixels[top : top + height, left : left + width]

    return crop


SIZE_TAGS = {0xA002: Entry(3, 1, (480).to_bytes(2, "little")), 0xA003: Entry(3, 1, (360).to_bytes(2, "little"))}


@pytest.mark.parametrize(
    ("share", "corner"), [(0.8, (0.5, 0.5)), (0.5, (0.5, 0.5)), (0.9, (0.0, 1.0)), (0.7, (1.0, 0.2))]
)
def test_a_part_under_the_tags_of_the_whole_has_no_lens(
    flight: Path, tmp_path: Path, share: float, corner: tuple[float, float]
) -> None:
    """Averaging removes the steps of 16 in the raw numbers, which tell a part from a reduced image."""
    scan = one_capture(flight, tmp_path, pixels=cropped(share, corner), exif=SIZE_TAGS)
    (problem,) = scan.problems
    size = f"{round(share * 480)} x {round(share * 360)} px, cropped or reduced from 480 x 360 px"
    assert f"is not that of an image of {size}, and so in 4 other files" in problem.text
    assert all(b.lens is None and b.to_rig is None and b.radiometry is None for b in only(scan).bands)
    assert "not that of an image" in only(scan).bands[0].missing_calibration


def test_tags_of_the_whole_are_not_written_for_a_part(flight: Path, tmp_path: Path) -> None:
    capture = only(one_capture(flight, tmp_path, pixels=cropped(0.8, (0.5, 0.5)), exif=SIZE_TAGS))
    band = next(b for b in capture.bands if b is not capture.reference)
    assert aligned_files._correction(band) is None
    grid = OutputGrid(0, 0, *capture.reference.size_px)
    first, exif, _ = band_tags(band, capture.reference, grid, None)
    names = {name for _, name in Packet.parse(first[XMP].data).values()}
    assert "BandName" in names
    of_lens = {"PrincipalPoint", "PerspectiveFocalLength", "PerspectiveDistortion"}
    assert not names & (of_lens | {"VignettingCenter", "VignettingPolynomial", "RadiometricCalibration"})
    assert not exif.keys() & {Base.FocalPlaneXResolution, Base.FocalPlaneYResolution, Base.FocalLengthIn35mmFilm}
    assert Base.FocalLength in exif


def test_a_part_of_a_side_is_told_by_the_size_of_the_model(flight: Path, tmp_path: Path) -> None:
    """The synthetic RedEdge-M has the lens of 480 x 360 px; with that of 1280 x 960 px it is a part."""
    source = flight / FLIGHT_FOLDER / "IMG_0001_2.tif"
    whole = np.kron(tifffile.imread(source), np.ones((3, 3), np.uint16))[:960, :1280]
    tags = read_directories(source)
    density = {
        tag: Entry(5, 1, (100_000 * 1280 // 480).to_bytes(4, "little") + (375).to_bytes(4, "little"))
        for tag in (0xA20E, 0xA20F)
    }
    for k, size in ((1, np.s_[160:, 200:]), (2, np.s_[:, :])):
        path = tmp_path / f"IMG_0001_{k}.tif"
        write_band(path, whole[size])
        first = {tag: entry for tag, entry in tags[0].items() if tag in (271, 272, 306, 700, 0xC61A)}
        add_directories(path, first, tags[EXIF] | density, tags[GPS])
    scan = discover(tmp_path)
    texts = [p.text for p in scan.problems if "not that of an image" in p.text]
    assert sizes_px("RedEdge-M") == ((1280, 960),)
    assert len(texts) == 1


def phantom_tags(**more: str) -> bytes:
    values = {"CalibratedOpticalCenterX": "800", "CalibratedOpticalCenterY": "650", "VignettingData": "1e-5,0,0,0,0,0"}
    values |= {
        "SensorGain": "2",
        "ExposureTime": "1000",
        "BlackLevel": "4096",
        "Irradiance": "5000",
        "CaptureUUID": "a",
    }
    return packet({(DJI, name): (value,) for name, value in (values | more).items()}, "attributes")


@pytest.mark.parametrize(("shape", "is_part"), [((1300, 1600), False), ((1040, 1280), True), ((780, 960), True)])
def test_a_centred_part_of_a_phantom_has_no_vignetting(tmp_path: Path, shape: tuple[int, int], is_part: bool) -> None:
    pixels = 64 * np.random.default_rng(0).integers(70, 1000, shape).astype(np.uint16)
    for part in ("1", "2"):
        path = tmp_path / f"DJI_001{part}.TIF"
        write_band(path, pixels)
        add_directories(path, {271: text("DJI"), 272: text("FC6360"), XMP: byte_string(phantom_tags())}, {}, {})
    scan = discover(tmp_path)
    assert [b.radiometry is None for b in only(scan).bands] == [is_part, is_part]
    assert len(scan.problems) == is_part


# ---- raw numbers and tags


def reflectance(scale: int, floor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pixels: (np.clip(pixels / 65536 * 0.5 + floor, 0, 1) * scale).astype(np.uint16)


@pytest.mark.parametrize(("scale", "floor"), [(32768, 0.15), (10000, 0.0), (65535, 0.1)])
def test_calibrated_images_under_the_tags_of_raw_ones_are_refused(
    flight: Path, tmp_path: Path, scale: int, floor: float
) -> None:
    capture = only(one_capture(flight, tmp_path, pixels=reflectance(scale, floor)))
    for band in capture.bands:
        with pytest.raises(
            InputError, match="of its pixels are not multiples of 16, as raw numbers of this camera are"
        ):
            with_checked_pixels(band, read_tile)


def test_raw_images_and_retouched_pixels_are_accepted(flight: Path, tmp_path: Path) -> None:
    def retouched(pixels: np.ndarray) -> np.ndarray:
        result = pixels.copy()
        result[::40, ::40] += 7
        return result

    for folder, pixels in (("raw", lambda x: x), ("retouched", retouched)):
        for band in only(one_capture(flight, tmp_path / folder, pixels=pixels)).bands:
            with_checked_pixels(band, read_tile)


def test_dark_pixels_far_above_a_black_level_of_zero_are_refused(flight: Path, tmp_path: Path) -> None:
    black = {0xC61A: Entry(3, 1, b"\0\0")}
    capture = only(one_capture(flight, tmp_path, first=black))
    band = replace(capture.bands[0], radiometry=replace(capture.bands[0].radiometry, raw_step=1))
    lifted = lambda *arguments: (read_tile(*arguments)[0] // 2 + np.uint16(20000), read_tile(*arguments)[1])  # noqa: E731
    with pytest.raises(InputError, match="far above its black level of 0"):
        with_checked_pixels(band, lifted)


@pytest.mark.parametrize(("value", "is_used"), [("0", True), ("1", False)])
def test_pixels_that_the_tags_call_normalized_are_not_calibrated(tmp_path: Path, value: str, is_used: bool) -> None:
    for part in ("1", "2"):
        path = tmp_path / f"DJI_001{part}.TIF"
        write_band(path, np.full((1300, 1600), 6400, np.uint16))
        xmp = phantom_tags().replace(b"<rdf:Description ", f'<rdf:Description Camera:IsNormalized="{value}" '.encode())
        add_directories(path, {271: text("DJI"), 272: text("FC6360"), XMP: byte_string(xmp)}, {}, {})
    scan = discover(tmp_path)
    assert [b.radiometry is not None for b in only(scan).bands] == [is_used, is_used]
    assert [("IsNormalized" in p.text, p.is_harmless) for p in scan.problems] == ([] if is_used else [(True, True)])


# ---- name and band


@pytest.mark.parametrize(
    ("camera", "names"), [("Survey3W_RGN", ["Red", "Green", "NIR"]), ("Survey3N_OCN", ["Orange", "Cyan", "NIR"])]
)
@pytest.mark.parametrize("pattern", [None, "{capture}_{band}.tif"])
def test_the_filter_names_the_channels_with_a_pattern_too(
    tmp_path: Path, camera: str, names: list[str], pattern: str | None
) -> None:
    survey3(tmp_path / "RGN" / "2021_0827_193517_009.tif", camera, "uint16")
    write_file(tmp_path / "RGN" / "2021_0827_193517_green.tif")
    scan = discover(tmp_path, DiscoverOptions(pattern=pattern))
    named = {b.name for c in scan.captures for b in c.bands} | {p.text for p in scan.problems}
    if pattern is not None:
        assert set(names) <= named
    assert [name for name, _ in filter_channels(camera).values()] == names
    assert filter_channels("RedEdge-M_RGN") == {}


WAYPOINT = {
    "Mavic 3": ("_point1", f"{MAVIC}_point1"),
    "Phantom 4": ("_field-7", "DJI_001_field-7"),
    "RedEdge": ("_north", "IMG_0007_north"),
    "Sequoia": ("_plot2", "IMG_180413_080658_0000_plot2"),
}


@pytest.mark.parametrize("name", WAYPOINT)
@pytest.mark.parametrize("damage", ["", "missing"])
def test_names_may_go_on_after_those_of_the_camera(tmp_path: Path, name: str, damage: str) -> None:
    added, capture_name = WAYPOINT[name]
    vendor: Vendor = VENDORS[name]
    stem, _, suffix = vendor.file.rpartition(".")
    write_capture(tmp_path, vendor._replace(file=f"{stem}{added}.{suffix}"), damage=damage)
    (capture,) = discover(tmp_path).captures
    assert capture.label == capture_name
    assert len(capture.bands) == len(vendor.bands)
    if damage != "missing" or name != "RedEdge":
        assert {b.name for b in capture.bands} == {band for band, _ in vendor.bands.values()}


def test_a_truncated_band_of_a_longer_name_is_unreadable_not_missing(tmp_path: Path) -> None:
    for number in ("0001", "0002"):
        vendor = VENDORS["Mavic 3"]._replace(file=f"DJI_20260108152711_{number}_MS_{{part}}_point1.TIF")
        own = vendor._replace(tags=lambda k, number=number: {(DJI, "CaptureUUID"): (number,)})
        write_capture(tmp_path, own)
    path = tmp_path / "DJI_20260108152711_0002_MS_NIR_point1.TIF"
    path.write_bytes(path.read_bytes()[:100])
    capture = discover(tmp_path).captures[1]
    assert capture.missing_bands == ("NIR",)
    assert path.name in capture.unreadable_bands["NIR"].what


# ---- number and time


def shifted_numbers(flight: Path, folder: Path, part: str, by_s: int = 20) -> FolderScan:
    """Four captures, `by_s` apart, without ids; the numbers of a band's files are too high by one."""
    start = datetime(2026, 6, 21, 10)
    for n in range(4):
        for path in sorted((flight / FLIGHT_FOLDER).glob("IMG_0001_*.tif")):
            k = path.stem[-1]
            time = text((start + timedelta(seconds=by_s * (n - (k == part)))).strftime("%Y:%m:%d %H:%M:%S"))
            without_id = b"MicaSense:CaptureId", b"MicaSense:CaptureXx"
            rewritten(path, folder / f"IMG_{n:04d}_{k}.tif", xmp=without_id, exif={0x9003: time}, first={306: time})
    return discover(folder)


@pytest.mark.parametrize(("part", "by_s"), [("4", 20), ("1", 3), ("5", 900)])
def test_numbers_that_are_shifted_in_a_band_are_named(flight: Path, tmp_path: Path, part: str, by_s: int) -> None:
    (problem,) = shifted_numbers(flight, tmp_path, part, by_s).problems
    length = {20: "20 s", 3: "3 s", 900: "0:15:00"}[by_s]
    assert problem.path.name.endswith(f"_{part}.tif")
    assert (
        f"was exposed {length} before the other bands of its number, and so 3 other files of its band" in problem.text
    )
    assert f"by its time IMG_0001_{part}.tif belongs to IMG_0000: the numbers of the band are shifted" in problem.text
    assert not problem.is_harmless


def test_a_fraction_of_a_second_between_bands_is_no_problem(flight: Path, tmp_path: Path) -> None:
    assert not shifted_numbers(flight, tmp_path, "4", by_s=1).problems


# ---- names of copies


@pytest.fixture
def images(flight: Path, tmp_path: Path) -> Path:
    return shutil.copytree(flight / FLIGHT_FOLDER, tmp_path / "in")


SUFFIXES = [
    "-DESKTOP-4F2K",
    ".sync-conflict-20210827-193457-ABCDEFG",
    " (conflicted copy 2021-08-27 193457)",
    "~backup",
]
SUFFIXES += ["-Kopie", " [Konflikt]", "@eaStream", "_old"]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("is_partial", [False, True])
def test_a_copy_by_a_program_is_no_band(images: Path, suffix: str, is_partial: bool) -> None:
    original = images / "IMG_0001_2.tif"
    copy = original.with_name(f"IMG_0001_2{suffix}.tif")
    copy.write_bytes(_with_zeros(original) if is_partial else original.read_bytes())
    scan = discover(images)
    assert [len(c.bands) for c in scan.captures] == [5, 5]
    assert all(b.path != copy for c in scan.captures for b in c.bands)
    (problem,) = scan.problems
    assert (problem.path, "copy of IMG_0001_2.tif" in problem.text) == (copy, True)
    assert not any(c.missing_bands for c in scan.captures)


def _with_zeros(path: Path) -> bytes:
    """The file with zeros among its pixels."""
    data = bytearray(path.read_bytes())
    data[50_000:150_000] = bytes(100_000)
    return bytes(data)


@pytest.mark.parametrize("suffix", ["-LAPTOP", ".sync-conflict-20240101-1", "-field office"])
def test_a_copy_without_tags_is_no_band_either(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    for name in ("f_green", "f_nir", "f_red", f"f_red{suffix}"):
        write_band(tmp_path / f"{name}.tif", rng.integers(1, 4000, (64, 80), dtype=np.uint16))
    scan = discover(tmp_path)
    assert [b.name for b in only(scan).bands] == ["green", "nir", "red"]
    assert "copy of f_red.tif" in scan.problems[0].text


def test_a_name_with_a_band_after_that_of_another_file_is_a_band(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in (
        "f_1",
        "f_1-1",
        "f_1-2",
        "plot",
        "plot-nir",
        "plot-red",
        "IMG_1-R",
        "IMG_1-NIR",
        "f_red",
        "f_red-edge",
    ):
        write_band(tmp_path / f"{name}.tif", rng.integers(1, 4000, (64, 80), dtype=np.uint16))
    assert not [p.text for p in discover(tmp_path).problems if "copy of" in p.text]
