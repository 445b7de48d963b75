from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from synthetic_flights.cameras import ALTUM
from synthetic_flights.troubles import make_two_headings

import agalign
from agalign.cameras.discover import discover
from agalign.capture.band_pair import _with_rig, read_pairs
from agalign.capture.by_rig import observed
from agalign.capture.full_resolution import is_worth_refining
from agalign.capture.reference import longest_for
from agalign.capture.seeding import find_seed
from agalign.config import SeedSettings
from agalign.errors import UnreadableFileError
from agalign.flight.model import FlightModel
from agalign.flight.rig import CaptureFactors, Rig
from agalign.pixels.raster import probe, read_tile
from agalign.synthetic.flight import score_against_truth
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Band, Capture
from agalign.values.geometry import PairScales
from agalign.values.image import Tile
from agalign.values.issues import UNREADABLE, Issue, sentence
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

from ..builders import joint_result, pair_of, two_views, whole
from ..conftest import textured_image, write_band

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_the_reference_is_computed_once_for_all_bands(flight: Path) -> None:
    pairs, left_out = read_pairs(discover(flight).captures[0], SeedSettings())
    assert not left_out
    assert len(pairs) == 4
    assert len({id(p.reference) for p in pairs}) == 1
    assert all(p.space == "undistorted" for p in pairs)


def mosaic(path: Path, change: Callable[[np.ndarray], None]) -> Capture:
    """A reference, and four bands of one lens that `change` modifies."""
    scene = 1000 + 300 * textured_image(160, 120, 0)
    planes = np.stack([scene + 10 * k for k in range(4)]).astype(np.uint16)
    change(planes)
    write_band(path / "reference.tif", scene.astype(np.uint16))
    write_band(path / "mosaic.tif", planes, nodata=0)
    moving = [replace(b, name=f"b{b.band_index}", one_lens=True) for b in probe(path / "mosaic.tif")]
    return Capture("mosaic", Path(), (*probe(path / "reference.tif"), *moving), 0)


@pytest.mark.parametrize(
    ("number", "value", "reason"),
    [
        (3, np.s_[:, :], "the moving band is constant or all invalid"),
        (0, np.s_[:, 2:], "only 1.25% of the moving band is valid"),
        (1, np.s_[1:, :], "only 0.83% of the moving band is valid"),
        (2, np.s_[:, 64:], ""),
    ],
)
@pytest.mark.parametrize("fill", [0, 65535])
def test_one_bad_band_of_a_lens_does_not_mask_the_others(
    tmp_path: Path, number: int, value: tuple[slice, slice], reason: str, fill: int
) -> None:
    def change(planes: np.ndarray) -> None:
        planes[(number, *value)] = fill

    (pair,), unusable = read_pairs(mosaic(tmp_path, change), SeedSettings(force="identity"))
    assert pair.moving.valid.mean() > 0.9
    assert pair.name == "b1"
    bad = f"b{number + 1}"
    assert (bad in unusable, bad in {b.name for b in pair.bands}) == (bool(reason), not reason)
    assert len(pair.bands) == (3 if reason else 4)
    if reason and fill == 0:
        assert sentence(unusable[bad]) == reason


def test_an_unreadable_band_of_a_lens_does_not_fail_the_others(tmp_path: Path) -> None:
    def read(band: Band, tile: Tile) -> tuple[np.ndarray, np.ndarray]:
        if band.name == "b3":
            raise UnreadableFileError(f"{band.path} is damaged")
        return read_tile(band, tile)

    (pair,), unusable = read_pairs(mosaic(tmp_path, lambda _: None), SeedSettings(force="identity"), read=read)
    assert [band.name for band in pair.bands] == ["b1", "b2", "b4"]
    assert {name: issue.kind for name, issue in unusable.items()} == {"b3": UNREADABLE}


def test_a_file_with_few_valid_pixels_says_how_few(tmp_path: Path) -> None:
    def change(planes: np.ndarray) -> None:
        planes[:, 2:] = 0

    (pair,), unusable = read_pairs(mosaic(tmp_path, change), SeedSettings(force="identity"))
    assert not unusable
    issue = find_seed(pair, SeedSettings(force="identity"))
    assert isinstance(issue, Issue)
    assert sentence(issue) == "only 1.66% of the moving band is valid"


def test_without_one_lens_neither_is_corrected(flight: Path) -> None:
    capture = discover(flight).captures[0]
    bands = [replace(b, lens=None) if b.name == "NIR" else b for b in capture.bands]
    pairs, _ = read_pairs(replace(capture, bands=tuple(bands)), SeedSettings())
    without = [(p.name, p.space) for p in pairs if p.fixed.lens is None]
    assert without == [("NIR", "pixel")]


@pytest.mark.parametrize(
    ("ratio", "longest"), [(1.0, 2700), (2.0, 2700), (0.5, 2700), (0.25, 640), (0.0775, 198), (0.01, 128), (0.0, 2700)]
)
def test_the_reference_is_worth_refining_for_a_coarse_band(ratio: float, longest: int) -> None:
    assert longest_for((1280, 960), np.diag([abs(ratio), ratio, 1.0])) == longest


@pytest.mark.full
@pytest.mark.slow
def test_a_thermal_band_is_aligned_to_a_fraction_of_its_own_pixel(tmp_path: Path) -> None:
    """160 x 120 px with a reference of 800 x 600 px, and an error of the tags of 0.3 degrees: 4 px of the reference. In
    one capture the band is noise and predicted by the rig.
    """
    thermal = replace(ALTUM.bands[-1], size_ratio=(0.2, 0.2), centre_offset_px=(-9.7, -20.5))
    camera = replace(ALTUM, bands=(ALTUM.bands[1], ALTUM.bands[3], thermal), reference=0)
    truth = make_two_headings(tmp_path, 5, (800, 600), camera=camera, line=3, lakes=False)
    (lost,) = tmp_path.rglob("IMG_0002_6.tif")
    with rasterio.open(lost, "r+") as file:
        file.write((29_000 + 50 * np.random.default_rng(0).normal(size=(1, 120, 160))).astype(np.uint16))
    reports = agalign.align_folder(tmp_path, tmp_path / "out")
    assert [r.error for r in reports] == [None] * 5  # an Altum has further bands, which are missing
    scores = score_against_truth(tmp_path / "out", truth)
    assert len(scores) == 5 * 2
    for score in scores:
        is_noise = (score.capture, score.band) == ("0000SET/000/IMG_0002", "LWIR")
        assert score.status == ("predicted" if is_noise else "aligned")
        assert score.median_px < (0.3 if score.band == "LWIR" else 0.1)
    capture = discover(tmp_path).captures[0]
    pairs, _ = read_pairs(capture, SeedSettings())
    plane = Alignment(PixelMapping(np.eye(3)), (800, 600), (), Seed("identity", np.eye(3), 0.0))
    assert [(p.name, p.is_coarse, is_worth_refining(p, plane)) for p in pairs] == [
        ("NIR", False, False),
        ("LWIR", True, False),
    ]
    assert 270 < pairs[1].fixed.size_px[0] < 310  # about two pixels per pixel of the thermal band
    assert pairs[1].reference_file_px == (800, 600)


@pytest.mark.parametrize(
    ("pixels", "of_fixed", "of_moving", "is_coarse", "expected"),
    [
        (1.0, 1.0, 1.0, False, False),
        (1.0, 0.5, 1.0, False, True),
        (1.0, 0.5, 1.0, True, False),
        (1.0, 1.0, 0.5, False, True),
        (5.0, 1.0, 0.25, False, False),
        (5.0, 1.0, 0.1, False, True),
        (0.2, 1.0, 0.5, False, True),
    ],
)
def test_files_are_worth_refining_if_their_images_lack_detail_of_the_result(
    pixels: float, of_fixed: float, of_moving: float, is_coarse: bool, expected: bool
) -> None:
    """`pixels` is the number of pixels of the moving file along one of the reference's."""
    scales = PairScales(PixelScale(of_fixed, of_fixed), PixelScale(of_moving, of_moving))
    pair = replace(pair_of(*two_views(np.eye(3), 200, 160), {}), scales=scales, is_coarse=is_coarse)
    matrix = scales.between_images(np.diag([pixels, pixels, 1.0]))
    seed = Seed("identity", matrix, 0.0)
    assert (
        is_worth_refining(pair, Alignment(pair.mapping(matrix), (200, 160), (), seed, joint_result(matrix))) == expected
    )


@pytest.mark.parametrize("pixels", [1.0, 0.1])
def test_a_rig_is_learned_from_errors_in_px_of_the_reference_s_file(flight: Path, pixels: float) -> None:
    """Whatever the size of the band's pixels; the image has half the size of the file. It is the RMS over the image,
    which is less than at the corners.
    """
    pairs, _ = read_pairs(discover(flight).captures[0], SeedSettings())
    pair = replace(pairs[0], scales=PairScales(PixelScale(0.5, 0.5), SAME_PIXELS))
    joint, seed = joint_result(std_px=0.2 / 2**0.5), Seed("rig", np.eye(3), 30.0)
    mapping = pair.mapping(np.diag([pixels, pixels, 1.0]))
    alignment = Alignment(mapping, pair.fixed.size_px, (), seed, joint)
    known = observed([pair], {pair.name: alignment}, discover(flight).captures[0])
    assert known.std_px[pair.name] == pytest.approx(0.82 * 0.4, rel=0.01)


def test_the_error_of_a_rig_is_converted_to_px_of_the_fixed_image() -> None:
    captures = (CaptureFactors(None, None, None, (0.0,) * 5),) * 3
    mean, baselines = {"LWIR": np.diag([0.1, 0.1, 1.0])}, {"LWIR": (1.0, 0.0)}
    rig = Rig((800, 600), mean, baselines, {"LWIR": 0.0}, {}, (), captures, {"LWIR": 5.0})
    image = whole(np.zeros((300, 400), np.float32))
    pair = replace(pair_of(image, image), name="LWIR", scales=PairScales(PixelScale(0.5, 0.5), SAME_PIXELS))
    assert _with_rig(pair, rig).seed_std_px["model"] == pytest.approx(5.0 * 0.5)


def test_a_mapping_that_agrees_with_tags_and_not_with_the_more_certain_rig_is_not_expected() -> None:
    """In a repetitive scene, the next row may be within the error of the tags."""
    image, tags, of_rig = whole(np.zeros((300, 400), np.float32)), geometry.translation(10.0, 0.0), np.eye(3)
    pair = pair_of(image, image, {"model": of_rig, "rig": tags}, rig=5.0, model=1.0)
    assert pair.is_expected(geometry.translation(2.0, 0.0))
    assert not pair.is_expected(geometry.translation(14.0, 0.0))
    assert pair_of(image, image, {"rig": tags}, rig=5.0).is_expected(geometry.translation(14.0, 0.0))


def test_a_band_without_the_lens_of_the_others_has_no_rig(flight: Path) -> None:
    """Mapping, error and lens of the rig are those between undistorted pixels."""
    capture = discover(flight).captures[0]
    bands = [replace(b, lens=None) if b.name == "NIR" else b for b in capture.bands]
    names = [b.name for b in capture.moving]
    mean, values = dict.fromkeys(names, np.eye(3)), dict.fromkeys(names, 0.3)
    factors = (CaptureFactors(None, None, None, (0.0,) * 5),) * 3
    rig = Rig(capture.reference.size_px, mean, dict.fromkeys(names, (1.0, 0.0)), values, {}, (), factors, values)
    pairs, _ = read_pairs(
        replace(capture, bands=tuple(bands)), SeedSettings(), FlightModel(None, None, (), {}, "", rig)
    )
    assert {p.name for p in pairs if not p.has_rig} == {"NIR"}


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_the_tolerance_of_a_candidate_is_in_px_of_the_fixed_image_at_any_scale(scale: float) -> None:
    """A candidate with a standard error of 4 px accepts mappings within 12 px of the fixed image."""
    fixed, moving = (whole(np.zeros(shape, np.float32)) for shape in ((300, 400), (30, 40)))
    candidate = geometry.compose(np.diag([scale, scale, 1.0]), geometry.translation(7.0, -5.0))
    pair = pair_of(fixed, moving, {"rig": candidate}, rig=4.0)
    for offset_px, is_expected in ((8.0, True), (11.5, True), (12.5, False), (20.0, False)):
        mapping = geometry.compose(candidate, geometry.translation(0.6 * offset_px, 0.8 * offset_px))
        assert pair.is_expected(mapping) is is_expected
        assert pair.is_expected(candidate, (0.6 * offset_px, 0.8 * offset_px)) is is_expected
