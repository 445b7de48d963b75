"""Every vendor's naming and tags, in every dialect of XMP, whole and damaged."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from agalign.cameras.consistency import pixel_scale
from agalign.cameras.discover import DiscoverOptions, discover
from agalign.cameras.dji import Dji
from agalign.cameras.dls import NAMESPACE as DLS
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.parrot import Sequoia
from agalign.cameras.pix4d import NAMESPACE
from agalign.cameras.sentera import Sentera
from agalign.cameras.tag_seeds import other_rig_seed, rig_seed, tag_seeds
from agalign.cameras.tiff_directory import Entry, add_directories, byte_string, rational, short, text
from agalign.config import SeedSettings
from agalign.pixels.raster import probe
from agalign.values import geometry, lens
from agalign.values.capture import Band, Capture

DJI, MICASENSE, SENTERA = "dji.com/drone-dji", "micasense.com/MicaSense", "sentera.com"
URIS = {
    "Camera": "http://pix4d.com/camera/1.0/",
    "MicaSense": "http://micasense.com/MicaSense/1.0/",
    "DLS": "http://micasense.com/DLS/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Sentera": "https://www.sentera.com/schemas/",
}
PREFIXES = {NAMESPACE: "Camera", MICASENSE: "MicaSense", DLS: "DLS", DJI: "drone-dji", SENTERA: "Sentera"}
SIZE = 160, 120

Values = Mapping[tuple[str, str], Sequence[str]]
Tagged = Mapping[int, Entry]
NONE: Tagged = MappingProxyType({})


class Vendor(NamedTuple):
    """A camera, and the names and XMP values of the files of one capture."""

    make: str
    model: str
    capture: str
    """The name of the capture."""
    file: str
    """The pattern of the names of its files."""
    tags: Callable[[int], Values]
    """XMP values of the band of this number."""
    bands: Mapping[str, tuple[str, float]]
    """{part of the file's name: (band, wavelength in nm)}."""
    orientation: int = 1


def tagged(namespace: str, **values: str) -> Values:
    """XMP values of one namespace; spaces separate the items of a value."""
    return {(namespace, name): tuple(items.split()) for name, items in values.items()}


def micasense(k: int) -> Values:
    lens = {"PrincipalPoint": f"{0.3 + 0.01 * k} 0.22", "PerspectiveDistortion": "-0.1 0.1 0 0 0"}
    lens |= {"PerspectiveFocalLength": "5.45", "PerspectiveFocalLengthUnits": "mm"}
    return {**tagged(MICASENSE, CaptureId="abc"), **tagged(NAMESPACE, RigRelatives=f"{0.1 * k} 0 0.05", **lens)}


def phantom(k: int) -> Values:
    return tagged(DJI, CaptureUUID="abc", RelativeOpticalCenterX=f"+{k}.5", RelativeOpticalCenterY=f"-{k}.25")


def mavic(k: int) -> Values:
    lens = {"CalibratedOpticalCenterX": "80", "CalibratedOpticalCenterY": "60"}
    lens |= {"DewarpData": "2022-09-08;170,170,1.5,-2.5,-0.1,0.05,0,0,0"}
    return tagged(DJI, CaptureUUID="abc", CalibratedHMatrix=f"1,0,{k}.5,0,1,-2,0,0,1", **lens)


def sequoia(k: int) -> Values:
    lens = {"FisheyeAffineMatrix": "207 0 0 207", "FisheyePolynomial": "0 1 0.0096 -0.1455", "ModelType": "fisheye"}
    lens |= {"PrincipalPoint": "0.3 0.22", "RigRelatives": f"-0.17 {0.1 * k} 0"}
    return tagged(NAMESPACE, CaptureUUID="abc", **lens)


def sentera(k: int) -> Values:
    matrix = f"1 0.001 {k} -0.001 1 5 0 0 1"
    return {**tagged(NAMESPACE, CaptureUUID="abc"), **tagged(SENTERA, AlignMatrix=matrix)}


REDEDGE_BANDS = {"1": ("Blue", 475), "2": ("Green", 560), "3": ("Red", 668), "4": ("NIR", 840), "5": ("Red edge", 717)}
PHANTOM_BANDS = {"1": ("Blue", 450), "2": ("Green", 560), "3": ("Red", 650), "4": ("RedEdge", 730), "5": ("NIR", 840)}
SENTERA_BANDS = {"0": ("Blue", 475), "1": ("Green", 550), "2": ("Red", 670), "3": ("RedEdge", 715), "4": ("NIR", 840)}
SEQUOIA_BANDS = {"GRE": ("Green", 550), "RED": ("Red", 660), "REG": ("Red edge", 735), "NIR": ("NIR", 790)}
MAVIC_BANDS = {"G": ("Green", 560), "R": ("Red", 650), "RE": ("RedEdge", 730), "NIR": ("NIR", 860)}
MAVIC, SEQUOIA = "DJI_20230607112233_0001", "IMG_180413_080658_0000"
VENDORS = {
    "RedEdge": Vendor("MicaSense", "RedEdge-M", "IMG_0007", "IMG_0007_{part}.tif", micasense, REDEDGE_BANDS),
    "Phantom 4": Vendor("DJI", "FC6360", "DJI_001", "DJI_001{part}.TIF", phantom, PHANTOM_BANDS),
    "Mavic 3": Vendor("DJI", "M3M", MAVIC, f"{MAVIC}_MS_{{part}}.TIF", mavic, MAVIC_BANDS),
    "Sequoia": Vendor("Parrot", "Sequoia", SEQUOIA, f"{SEQUOIA}_{{part}}.TIF", sequoia, SEQUOIA_BANDS, orientation=3),
    "6X": Vendor("Sentera", "6X", "IMG_00012", "{part}-{band}-{nm}-30/IMG_00012_{nm}_30.tif", sentera, SENTERA_BANDS),
}


def packet(values: Values, dialect: str) -> bytes:
    """An XMP packet with values as attributes, as elements of text, or as sequences."""
    attributes, elements = "", ""
    for (place, name), items in values.items():
        namespace = PREFIXES[place]
        if dialect == "attributes":
            attributes += f' {namespace}:{name}="{",".join(items)}"'
        elif dialect == "elements":
            elements += f"<{namespace}:{name}>{', '.join(items)}</{namespace}:{name}>\n"
        else:
            listed = "".join(f"<rdf:li>{item}</rdf:li>" for item in items)
            elements += f"<{namespace}:{name}><rdf:Bag>{listed}</rdf:Bag></{namespace}:{name}>\n"
    declared = " ".join(f'xmlns:{k}="{v}"' for k, v in URIS.items())
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {declared}{attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>'
        '<?xpacket end="w"?>'
    ).encode()


def write_file(path: Path, first: Tagged = NONE, exif: Tagged = NONE, shape: tuple[int, ...] = SIZE[::-1]) -> Path:
    """A TIFF file of zeros with tags; of several bands where the shape has three numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planar = "separate" if len(shape) == 3 else None
    pixels = np.zeros(shape, np.uint16)
    tifffile.imwrite(path, pixels, photometric="minisblack", planarconfig=planar, metadata=None)
    add_directories(path, first, dict(exif), {})
    return path


def write_capture(folder: Path, vendor: Vendor, dialect: str = "attributes", damage: str = "") -> None:
    for k, (part, (band, nm)) in enumerate(vendor.bands.items(), start=1):
        name = vendor.file.format(part=part, band=band, nm=nm)
        spectral = {(NAMESPACE, "BandName"): (band,), (NAMESPACE, "CentralWavelength"): (f"{nm}",)}
        values = {**spectral, **vendor.tags(k)}
        if damage == "empty":
            values = dict.fromkeys(values, ("",))
        elif damage == "no numbers":
            keep = "BandName", "CaptureId", "CaptureUUID"
            values = {k: v if k[1] in keep else ("-inf;nan",) for k, v in values.items()}
        xmp = packet(values, dialect)
        xmp = xmp[: len(xmp) // 2] if damage == "malformed" else xmp
        first = {271: text(vendor.make), 272: text(vendor.model), 274: short(vendor.orientation)}
        if damage != "missing":
            first[700] = byte_string(xmp)
        exif = {0xA20E: rational(266.67), 0xA20F: rational(266.67), 0xA210: short(4)}
        write_file(folder / name, first, exif)


def only_capture(folder: Path, options: DiscoverOptions | None = None) -> Capture:
    result = discover(folder, options)
    assert not result.problems
    (capture,) = result.captures
    return capture


@pytest.mark.parametrize("dialect", ["attributes", "elements", "sequences"])
@pytest.mark.parametrize("name", VENDORS)
def test_a_capture_is_grouped_named_and_seeded(tmp_path: Path, name: str, dialect: str) -> None:
    vendor = VENDORS[name]
    write_capture(tmp_path, vendor, dialect)
    capture = only_capture(tmp_path)
    assert capture.label == vendor.capture
    assert {b.name: b.wavelength_nm for b in capture.bands} == dict(vendor.bands.values())
    assert capture.reference.name == "Green"
    assert capture.capture_id == "abc"
    for band in capture.moving:
        seed = rig_seed(capture.reference, band)
        assert seed is not None
        # A rig's bands lie some pixels apart, not some images.
        assert 0.01 < geometry.corner_error_px(seed, geometry.identity(), *SIZE) < 30


@pytest.mark.parametrize("damage", ["missing", "empty", "malformed", "no numbers"])
@pytest.mark.parametrize("name", VENDORS)
def test_damaged_tags_leave_the_names_of_the_files(tmp_path: Path, name: str, damage: str) -> None:
    vendor = VENDORS[name]
    write_capture(tmp_path, vendor, damage=damage)
    scan = discover(tmp_path)
    (capture,) = scan.captures
    assert len(scan.problems) == (len(vendor.bands) if damage == "malformed" else 0)
    numbered = name == "RedEdge" and damage != "no numbers"  # its files have no names of bands
    named = {f"band_{part}" if numbered else band for part, (band, _) in vendor.bands.items()}
    assert {b.name for b in capture.bands} == named
    assert all(b.lens is None or np.isfinite(b.lens.matrix).all() for b in capture.bands)
    assert damage != "missing" or rig_seed(*capture.bands[:2]) is None


@pytest.mark.parametrize(("name", "shift_px"), [("Phantom 4", (3, -3)), ("Mavic 3", (-3, 0))])
def test_tags_of_the_common_plane_give_the_seed(tmp_path: Path, name: str, shift_px: tuple[float, float]) -> None:
    write_capture(tmp_path, VENDORS[name])
    bands = {b.name: b for b in only_capture(tmp_path).bands}
    np.testing.assert_allclose(rig_seed(bands["Green"], bands["NIR"]), geometry.translation(*shift_px), atol=1e-9)
    if name == "Mavic 3":
        result = bands["NIR"].lens
        assert (result.fx_px, result.cx_px, result.cy_px, result.distortion[0]) == (170, 81.5, 57.5, -0.1)


def test_sequoia_fisheye_is_the_vendors_formula(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["Sequoia"])
    (path,) = tmp_path.glob("*_RED.TIF")
    upright = replace(read_tags(path), orientation=1)
    (band,) = Sequoia().bands(path, upright, probe(path))
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.5, 0.5, (2, 200))
    theta = 2 / np.pi * np.arctan(np.hypot(x, y))
    rho = theta + 0.0096 * theta**2 - 0.1455 * theta**3
    expected = 207 * rho * np.stack([x, y]) / np.hypot(x, y) + [[0.3 * 266.67], [0.22 * 266.67]]
    pinhole_px = np.stack([x * band.lens.fx_px + band.lens.cx_px, y * band.lens.fy_px + band.lens.cy_px], axis=1)
    assert band.lens.fx_px == pytest.approx(2 * 207 / np.pi)
    np.testing.assert_allclose(lens.distort(band.lens, pinhole_px), expected.T, atol=0.01)
    np.testing.assert_allclose(lens.undistort(band.lens, expected.T), pinhole_px, atol=0.02)


def test_orientation_3_turns_lens_and_rig(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["Sequoia"])
    seeds = {}
    for orientation in (1, 3):
        bands: dict[str, Band] = {}
        for path in tmp_path.glob("*.TIF"):
            tags = replace(read_tags(path), orientation=orientation)
            (band,) = Sequoia().bands(path, tags, probe(path))
            bands[band.name] = band
        seeds[orientation] = rig_seed(bands["Green"], bands["NIR"])
    # The pixel p of the upright image is stored at size - 1 - p.
    turn = np.array([[-1.0, 0, SIZE[0] - 1], [0, -1, SIZE[1] - 1], [0, 0, 1]])
    assert geometry.corner_error_px(seeds[3], geometry.compose(turn, seeds[1], turn), *SIZE) < 1e-6
    assert geometry.corner_error_px(seeds[3], seeds[1], *SIZE) > 0.3


def test_mapir_files_are_grouped_by_the_name_after_the_serial(tmp_path: Path) -> None:
    for serial, nm in (("A1", 450), ("B2", 550), ("C3", 850)):
        name = f"capture_{serial}_0001_20260101_101010_123.tiff"
        write_file(tmp_path / name, {272: text(f"LATT-M3M-L41-F{nm}")})
    capture = only_capture(tmp_path)
    assert {b.name: b.wavelength_nm for b in capture.bands} == {"Blue": 450, "Green": 550, "NIR": 850}
    assert capture.name == "capture_0001_20260101_101010_123"


def photograph(path: Path, make: str, values: Values | None = None) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[271] = make
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(cv2.GaussianBlur(pixels, (0, 0), 2)).save(path, exif=exif, xmp=packet(values or {}, "attributes"))


def test_the_colour_photograph_is_aligned_on_request(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["Phantom 4"])
    values = {"CaptureUUID": "abc", "RelativeOpticalCenterX": "4", "RelativeOpticalCenterY": "6"}
    photograph(tmp_path / "DJI_0010.JPG", "DJI", {(DJI, k): (v,) for k, v in values.items()})
    assert len(only_capture(tmp_path).bands) == 5
    capture = only_capture(tmp_path, DiscoverOptions(with_rgb=True))
    assert [b.name for b in capture.bands[5:]] == ["RGB Red", "RGB Green", "RGB Blue"]
    assert capture.reference.name == "Green"
    seed = rig_seed(capture.reference, capture.bands[5])
    np.testing.assert_allclose(seed, geometry.translation(1.5, 8.25), atol=1e-12)


def test_double_4k_is_a_capture_of_two_photographs(tmp_path: Path) -> None:
    for folder in ("RGB", "NDRE"):
        photograph(tmp_path / folder / "IMG_00042.jpg", "Sentera")
    capture = only_capture(tmp_path)
    assert [b.name for b in capture.bands] == ["Red edge", "NIR", "RGB Red", "RGB Green", "RGB Blue"]
    assert [b.band_index for b in capture.bands] == [1, 3, 1, 2, 3]


def test_a_double_4k_lists_its_bands_and_calls_one_garbage(tmp_path: Path) -> None:
    stored = [Band("", tmp_path / "IMG_00042.jpg", index, 160, 120, "uint8") for index in (1, 2, 3)]
    for folder, names, wavelengths, expected in (
        ("nRGB", ("Red", "Green", "Blue"), ("650", "548", "446"), {"Red": 1, "Green": 2, "Blue": 3}),
        ("NDRE", ("RedEdge", "Garbage", "NIR"), ("720", "0", "840"), {"Red edge": 1, "NIR": 3}),
    ):
        path = tmp_path / folder / "IMG_00042.jpg"
        tags = Tags(make="Sentera", xmp={(NAMESPACE, "BandName"): names, (NAMESPACE, "CentralWavelength"): wavelengths})
        bands = Sentera().bands(path, tags, stored)
        assert {b.name: b.band_index for b in bands} == expected
        assert bands[0].wavelength_nm == float(wavelengths[0])
        assert Sentera().capture_folder(path) == tmp_path


def survey3(path: Path, camera: str, dtype: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, np.zeros((120, 160, 3), dtype), photometric="rgb", metadata=None)
    add_directories(path, {271: text("MAPIR"), 272: text(camera)}, {}, {})


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_three_bands_of_one_lens_are_no_capture(tmp_path: Path, dtype: str) -> None:
    survey3(tmp_path / "survey.tif", "Survey3W_RGN", dtype)
    result = discover(tmp_path)
    assert (result.captures, "one lens" in result.problems[0].text) == ((), True)
    assert "a second camera needs files of the same names in another folder" in result.problems[0].text


def test_two_cameras_of_one_lens_each_are_a_capture(tmp_path: Path) -> None:
    for filter_ in ("RGN", "OCN", "NGB"):
        survey3(tmp_path / filter_ / "2021_0827_193517_009.tif", f"Survey3N_{filter_}", "uint16")
    capture = only_capture(tmp_path)
    wavelengths = {(b.path.parent.name, b.band_index): b.wavelength_nm for b in capture.bands}
    assert [wavelengths["RGN", k] for k in (1, 2, 3)] == [660, 550, 850]
    assert [wavelengths["OCN", k] for k in (1, 2, 3)] == [615, 490, 808]
    assert [wavelengths["NGB", k] for k in (1, 2, 3)] == [850, 550, 475]
    assert len(capture.moving_lenses) == 2
    assert capture.label == "2021_0827_193517_009"


def test_dji_radiometry_is_the_guides_formula(tmp_path: Path) -> None:
    values = {"SensorGain": "2", "ExposureTime": "1000", "BlackLevel": "4096", "Irradiance": "5000"}
    values |= {"SensorGainAdjustment": "0.9", "VignettingData": "1e-4,0,0,0,0,0"}
    band = mavic_band(tmp_path, mavic_tags(**values))
    assert band.radiometry.gain == pytest.approx(0.9 / (2 * 1e-3))
    assert band.radiometry.by_sun.value == pytest.approx(1 / 5000)
    assert band.radiometry.by_sun.quantity == "relative reflectance"
    assert not band.radiometry.vignetting_divides


def test_the_vignetting_of_a_mavic_3_is_around_its_own_centre(tmp_path: Path) -> None:
    """Both tags of one real unit: CalibratedOpticalCenter is the middle of the image, by design."""
    values = {"SensorGain": "2", "ExposureTime": "1000", "BlackLevel": "3200", "VignettingData": "1e-4,0,0,0,0,0"}
    tags = mavic_tags(**values)
    of_pix4d = {"VignettingCenter": "1215.959106,946.467468", "VignettingPolynomial": "1e-4,0,0,0,0,0"}
    both = {(NAMESPACE, name): (value,) for name, value in of_pix4d.items()}
    band = mavic_band(tmp_path, replace(tags, xmp={**tags.xmp, **both}))
    assert band.radiometry.vignetting_centre_px == (1215.959106, 946.467468)
    assert mavic_band(tmp_path, tags).radiometry.vignetting_centre_px == (1296, 972)


def test_a_stack_with_a_vendors_make_is_a_stack(tmp_path: Path) -> None:
    for make in ("MicaSense", "DJI", "Parrot", "Sentera", "MAPIR"):
        write_file(tmp_path / f"{make}.tif", {271: text(make)}, shape=(5, 120, 160))
    result = discover(tmp_path)
    assert not result.problems
    assert [len(c.bands) for c in result.captures] == [5] * 5


@pytest.mark.parametrize("folder", ["NDVI 2024", "NDVI"])
def test_a_flat_folder_named_like_a_band(tmp_path: Path, folder: str) -> None:
    for name, nm in {"Blue": 475, "Green": 550, "NIR": 840}.items():
        xmp = packet({(NAMESPACE, "BandName"): (name,)}, "attributes")
        first = {271: text("Sentera"), 700: byte_string(xmp)}
        write_file(tmp_path / folder / f"IMG_0001_{nm}_30.tif", first)
    (capture,) = discover(tmp_path / folder).captures
    assert {b.name for b in capture.bands} == {"Blue", "Green", "NIR"}
    assert capture.label == "IMG_0001"


# ---- values of one real Mavic 3 Multispectral


RED = {"RelativeOpticalCenterX": "11.32", "RelativeOpticalCenterY": "3.06"}
NIR = {"RelativeOpticalCenterX": "0", "RelativeOpticalCenterY": "0"}


def mavic_tags(own: Mapping[str, str] = RED, **more: str) -> Tags:
    """A band's file of a Mavic 3, with the values of one real unit and no distortion."""
    xmp = {
        "CalibratedOpticalCenterX": "1296",
        "CalibratedOpticalCenterY": "972",
        "DewarpData": "2022-09-08;2170,2170,0,0,0,0,0,0,0",
        "DewarpHMatrix": "1.7162,0,415.7048,0,1.7162,309.8536,0,0,1",
    }
    return Tags(make="DJI", model="M3M", xmp={(DJI, k): (v,) for k, v in {**xmp, **own, **more}.items()})


def mavic_band(tmp_path: Path, tags: Tags) -> Band:
    path = write_file(tmp_path / f"{MAVIC}_MS_R.TIF", shape=(48, 64))
    (band,) = Dji().bands(path, tags, probe(path))
    return band


def test_a_mavic_shifts_by_its_optical_centres_and_its_calibration(tmp_path: Path) -> None:
    red, nir = (mavic_band(tmp_path, mavic_tags(own)) for own in (RED, NIR))
    by_centres = rig_seed(nir, red)
    np.testing.assert_allclose(by_centres, geometry.translation(11.32, 3.06), atol=1e-9)
    assert other_rig_seed(nir, red) is None
    calibrated = (RED, "1,0,-11,0,1,-3,0,0,1"), (NIR, "1,0,0,0,1,0,0,0,1")
    red, nir = (mavic_band(tmp_path, mavic_tags(own, CalibratedHMatrix=matrix)) for own, matrix in calibrated)
    np.testing.assert_allclose(rig_seed(nir, red), geometry.translation(11, 3), atol=1e-9)
    np.testing.assert_allclose(other_rig_seed(nir, red), by_centres, atol=1e-9)
    assert list(tag_seeds(nir, red, SeedSettings())) == ["rig", "centre", "identity"]


def test_the_mavic_s_colour_photograph_goes_through_the_designed_frame(tmp_path: Path) -> None:
    """The centre of the bands' frame, (1296, 972), maps to (2639.9, 1978.0) in the photograph."""
    colour = Tags(make="DJI", model="M3M", xmp={(DJI, "CaptureUUID"): ("abc",)})
    photo = tmp_path / "DJI_20230607112233_0001_D.JPG"
    cv2.imwrite(str(photo), np.zeros((48, 64, 3), np.uint8))
    nir = mavic_band(tmp_path, mavic_tags(NIR))
    rgb = Dji().bands(photo, colour, probe(photo))
    assert [b.to_rig for b in rgb] == [None] * 3
    placed = {b.name: b for b in Dji().with_shared_rig([nir, *rgb], [mavic_tags(), colour])}
    seed = rig_seed(nir, placed["RGB Red"])
    np.testing.assert_allclose(geometry.apply(seed, np.array([[1296.0, 972.0]])), [[2639.9, 1978.0]], atol=0.01)
    assert geometry.local_scale(seed, 2592, 1944)[-1] == pytest.approx(1.7162)
    # The Phantom's matrix of that name is none such.
    phantom = replace(mavic_tags(), model="FC6360")
    assert Dji().with_shared_rig([nir, *rgb], [phantom, colour])[1].to_rig is None


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_mavic_s_colour_photograph_may_be_reduced(tmp_path: Path, share: float) -> None:
    """Its size is not that of the bands: at half of it, the centre of its lens is not near the middle of theirs."""
    lens = {"CalibratedOpticalCenterX": "2640", "CalibratedOpticalCenterY": "1978"}
    lens |= {"DewarpData": "2022-09-08;3713,3713,0,0,0,0,0,0,0"}
    colour = Tags(make="DJI", model="M3M", xmp={(DJI, name): (value,) for name, value in lens.items()})
    photo = tmp_path / "DJI_20230607112233_0001_D.JPG"
    cv2.imwrite(str(photo), np.zeros((round(3956 * share), round(5280 * share), 3), np.uint8))
    for band in Dji().bands(photo, colour, probe(photo)):
        assert pixel_scale(colour, band, lambda: False) == ((share, share), "")


@pytest.mark.parametrize(("roll", "yaw"), [("0.00", "30"), ("+180.00", "-150")])
def test_a_mavic_s_gimbal_is_turned_either_way(roll: str, yaw: str) -> None:
    moving = {"FlightXSpeed": "8.66", "FlightYSpeed": "5", "RelativeAltitude": "20"}
    tags = mavic_tags(GimbalRollDegree=roll, GimbalYawDegree=yaw, GimbalPitchDegree="-90", **moving)
    assert Dji().motion(tags) == pytest.approx((0.0, 0.5), abs=1e-3)
    pose = Dji().pose(tags)
    assert (pose.heading_deg % 360, pose.pitch_deg, pose.height_m) == (pytest.approx(30), 0, 20)


def test_pixels_that_are_dewarped_have_no_distortion(tmp_path: Path) -> None:
    bent = "2022-09-08;2170,2170,0,0,-0.1,0.05,0,0,0"
    result = [mavic_band(tmp_path, mavic_tags(DewarpData=bent, DewarpFlag=flag)).lens for flag in "01"]
    assert [lens.is_distorting(one) for one in result] == [True, False]


@pytest.mark.parametrize(
    ("xmp", "of_tiff", "expected"),
    [
        ({"BlackLevel": "0"}, 0.0, 0),
        ({"BlackLevel": "4096"}, None, 4096),
        ({"BlackLevel": "4096"}, 3200.0, None),
        ({}, 0.0, 0),
        ({}, None, None),
    ],
)
def test_a_black_level_of_0_is_a_black_level(
    tmp_path: Path, xmp: dict[str, str], of_tiff: float | None, expected: float | None
) -> None:
    """A band has no radiometry if both tags are missing, or if they contradict each other."""
    tags = replace(mavic_tags(SensorGain="1", ExposureTime="2000", **xmp), black_level=of_tiff)
    radiometry = mavic_band(tmp_path, tags).radiometry
    assert (radiometry and radiometry.black_level) == expected
