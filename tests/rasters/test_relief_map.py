"""What is written of a capture with a relief: the rasters, the sidecar and the dataset, from the true geometry."""

import runpy
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from scipy.ndimage import gaussian_filter
from synthetic_flights.depth import CLOSE_RANGE, Truth, write_capture
from synthetic_flights.relief import make_scene

import agalign
from agalign.batch import capture_task as batch
from agalign.cameras import pix4d
from agalign.cameras.metadata import Tags
from agalign.cameras.tag_seeds import rig_seed
from agalign.rasters.alignment_maps import relief_layers
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import find_sidecars, read_checked, read_sidecar, write_sidecar
from agalign.synthetic import cameras
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture
from agalign.values.fields import equal
from agalign.values.geometry import PairScales
from agalign.values.image import OutputGrid, Tile
from agalign.values.issues import RETRIEVAL, Issue
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale

from ..builders import residual_of
from ..conftest import read_json
from ..docs.blocks import ROOT
from ..run_outputs import aligned

SIZE = 240, 180
PIXELS = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).astype(float)


def alignments_of(capture: Capture, truth: Truth) -> dict[str, Alignment]:
    """The true homography of the plane at the median range, and the true parallax above it."""
    reference = capture.reference
    matrix = reference.lens.matrix
    places = {b.name: np.array([*b.baseline_m, 0.0]) for b in CLOSE_RANGE.bands}
    unit = max(np.linalg.norm((matrix @ p)[:2]) for p in places.values())
    plane_m = float(np.median(truth.range_m))
    z = unit * (1 / truth.range_m - 1 / plane_m)
    relief = Relief(z.astype(np.float32), np.full(z.shape, 0.8, np.float32)).on_pixels(reference.size_px)
    result = {}
    for band in capture.moving:
        moved = -(matrix @ places[band.name])[:2]
        plane = geometry.compose(rig_seed(reference, band), geometry.translation(*(moved / plane_m)))
        x, y = (moved / unit).tolist()
        parallax = Parallax(relief, (x, y), truth.bands[band.name].hidden)
        residual = residual_of(np.array([[50.0, 50.0]]), np.array([[0.1, 0.0]]))
        mapping = PixelMapping(plane, reference.lens, band.lens, parallax=parallax)
        result[band.name] = aligned(mapping, reference.size_px, residual=residual)
    return result


def scene_in(folder: Path, size_px: tuple[int, int]) -> tuple[Capture, Truth]:
    """A capture of boxes that is written to a folder, and its truth."""
    truth = write_capture(folder, make_scene("boxes", 8, width_px=size_px[0]), size_px=size_px)
    (capture,) = agalign.discover(folder).captures
    return capture, truth


class Run:
    """A capture, its true alignments, and what is written with any settings."""

    def __init__(self, folder: Path) -> None:
        self.capture, self.truth = scene_in(folder / "in", SIZE)
        self.alignments = alignments_of(self.capture, self.truth)

    @property
    def relief(self) -> Relief:
        return self.alignments["NIR"].mapping.parallax.relief

    def write(self, out: Path, alignments: dict[str, Alignment] | None = None, **settings: object) -> Path:
        """Return the sidecar, by default of the true alignments of the capture."""
        chosen = agalign.Settings(write=agalign.WriteSettings.model_validate({"crop": "none", **settings}))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(batch, "align_capture_bands", lambda *_: alignments or self.alignments)
            outcome = batch.process_capture(batch.Task(self.capture, out, chosen))
        assert outcome.failed_products == ()
        assert read_checked(outcome.path).without_tables().model_dump_json() == outcome.result.model_dump_json()
        return outcome.path

    def with_relief(self, parallax_px: np.ndarray) -> dict[str, Alignment]:
        """The alignments with another relief, and its occlusions."""
        relief = Relief(parallax_px.astype(np.float32), np.ones(SIZE[::-1], np.float32)).on_pixels(SIZE)
        result = {}
        for name, alignment in self.alignments.items():
            baseline = alignment.mapping.parallax.baseline
            parallax = Parallax(relief, baseline).with_occlusions()
            result[name] = replace(alignment, mapping=alignment.mapping.with_parallax(parallax))
        return result

    def on_hill(self) -> dict[str, Alignment]:
        """The alignments with a hill without occlusions: steps of a relief are not reproduced on a grid with other
        pixels.
        """
        hill = 8 * np.exp(-((PIXELS - np.array(SIZE) / 2) ** 2).sum(axis=-1) / 2 / 40**2)
        return self.with_relief(hill)


def box() -> np.ndarray:
    """A parallax that occludes a strip next to it in every band."""
    parallax_px = np.zeros(SIZE[::-1])
    parallax_px[60:120, 80:160] = 12
    return parallax_px


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("relief"))


@pytest.fixture(scope="module")
def written(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sidecar of a run with all layers."""
    return run.write(tmp_path_factory.mktemp("out"), relief_map=True)


def layers_of(sidecar: Path) -> dict[str, np.ndarray]:
    with rasterio.open(sidecar.with_suffix(".relief.tif")) as source:
        assert np.isnan(source.nodata)
        assert set(source.dtypes) == {"float32"}
        return dict(zip(source.descriptions, source.read(), strict=True))


def test_the_raster_of_the_relief(run: Run, written: Path) -> None:
    units = {"parallax": "px", "confidence": "1", "range": "m"}
    path, layers, dataset = written.with_suffix(".relief.tif"), layers_of(written), agalign.open_capture(written)
    with rasterio.open(path) as source:
        assert dict(zip(source.descriptions, source.units, strict=True)) == units
    np.testing.assert_allclose(layers["parallax"], run.relief.parallax_px, atol=0.0051)
    np.testing.assert_allclose(layers["confidence"], 0.8, atol=1e-6)
    error = np.abs(layers["range"] / run.truth.range_m - 1)
    assert np.median(error) < 0.003
    assert error.max() < 0.02
    assert set(dataset.data_vars) == {b.name for b in run.capture.bands} | set(layers)
    for name, unit in units.items():
        np.testing.assert_array_equal(dataset[name].values, layers[name])
        assert (dataset[name].attrs["units"], dataset[name].attrs["long_name"]) == (unit, name)
    assert set(agalign.open_flight(written.parent).data_vars) == set(dataset.data_vars)
    (product,) = (p for p in read_sidecar(written).products if p.kind == "relief")
    assert (product.file, product.bytes) == (path.name, path.stat().st_size)


def test_the_range_is_calculated_on_request(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes most of the time; the preview states its limits."""
    sizes = list[tuple[int, ...]]()

    def range_m(_capture: Capture, _alignments: object, _points: object, parallax_px: np.ndarray) -> np.ndarray:
        sizes.append(parallax_px.shape)
        return np.full(parallax_px.shape, 7.0, np.float32)

    monkeypatch.setattr("agalign.rasters.alignment_maps._range_m", range_m)
    assert set(layers_of(run.write(tmp_path))) == {"parallax"}
    assert sizes == [SIZE[::-1]]


def test_without_places_of_lenses_there_is_no_range(run: Run) -> None:
    unknown = replace(run.capture, bands=tuple(replace(b, lens_offset=None) for b in run.capture.bands))
    layers = relief_layers(unknown, run.alignments, run.relief, OutputGrid(0, 0, *SIZE))
    assert np.isnan(layers["range"]).all()
    assert np.isfinite(layers["parallax"]).all()


def test_without_a_relief_nothing_is_written(run: Run, tmp_path: Path) -> None:
    flat = {n: replace(a, mapping=a.mapping.without_parallax) for n, a in run.alignments.items()}
    sidecar = run.write(tmp_path, flat, relief_map=True)
    assert not [*tmp_path.rglob("*.relief.tif"), *tmp_path.rglob("*.parallax.tif")]
    assert all(b.relief is None for b in read_sidecar(sidecar).bands)
    assert "parallax" not in agalign.open_capture(sidecar)


# ---- the sidecar


def documented_reader() -> Callable[..., np.ndarray]:
    """`mapped` in examples/map_pixels.py."""
    reader: Callable[..., np.ndarray] = runpy.run_path(str(ROOT / "examples" / "map_pixels.py"))["mapped"]
    return reader


def band_in(path: Path, name: str) -> dict[str, Any]:
    (part,) = (b for b in read_json(path)["bands"] if b["band"] == name)
    return part


def test_a_reader_is_accurate_over_the_range_of_the_scene(tmp_path: Path) -> None:
    """Along a tilted plane, and through lenses, the mapping is not linear in the parallax."""
    z = np.linspace(-30, 80, FILE_PX[0] * FILE_PX[1], dtype=np.float32).reshape(FILE_PX[::-1])
    parallax = Parallax(Relief(z, np.ones_like(z)), (0.8, -0.6))
    alignment = aligned(PixelMapping(H, *LENSES, parallax=parallax), FILE_PX)
    path = write_alone(alignment, tmp_path)
    pixels = geometry.lattice(*FILE_PX, 30, 20).round()
    z_px = parallax.relief(pixels)
    assert np.ptp(z_px) > 105
    band = band_in(path, "nir")
    assert np.abs(documented_reader()(band, pixels, z_px) - alignment.map(pixels)).max() < 0.02
    without = band["relief"] | {"curvature": np.zeros_like(band["relief"]["slope"]).tolist()}
    assert np.abs(documented_reader()(band | {"relief": without}, pixels, z_px) - alignment.map(pixels)).max() > 0.05


def test_a_reader_can_rebuild_the_mapping(run: Run, written: Path) -> None:
    """With the written parallax."""
    z = layers_of(written)["parallax"]
    for name, alignment in run.alignments.items():
        band, expected = band_in(written, name), agalign.read_alignment(written, name).map(PIXELS)
        assert np.abs(documented_reader()(band, PIXELS, z) - expected).max() < 0.02
        assert np.abs(alignment.map(PIXELS) - expected).max() < 0.02
        assert band["relief"]["file"] == written.with_suffix(".relief.tif").name
        assert band["relief"]["baseline"] == pytest.approx(alignment.mapping.parallax.baseline)
        assert band["relief"]["occluded"] == pytest.approx(alignment.mapping.parallax.hidden.mean(), abs=1e-4)
    assert band_in(written, run.capture.reference.name)["relief"] is None


# ---- occluded pixels


def test_occluded_pixels_are_filled_on_request(run: Run, tmp_path: Path) -> None:
    """Behind a box of 12 px of parallax."""
    behind_box = run.with_relief(box())
    plain_stack = run.write(tmp_path / "plain", behind_box).with_suffix(".tif")
    sidecar = run.write(tmp_path / "filled", behind_box, fill_occluded=True)
    assert set(layers_of(sidecar)) == {"parallax"}, "the mapping of the sidecar needs it, without a request too"
    with rasterio.open(plain_stack) as plain, rasterio.open(sidecar.with_suffix(".tif")) as filled:
        assert plain.read_masks(plain.descriptions.index("Green") + 1).all(), "the reference"
        for index, band in enumerate(plain.descriptions, start=1):
            before, after, known = plain.read(index), filled.read(index), plain.read_masks(index) > 0
            np.testing.assert_array_equal(after[known], before[known])
            if band in behind_box:
                mapping, low, high = behind_box[band].mapping, before[known].min(), before[known].max()
                at, occluded = mapping(PIXELS), mapping.hidden(Tile(0, 0, *SIZE))
                inside = ((at > 0) & (at < np.subtract(SIZE, 1))).all(axis=-1)
                hidden, beyond = occluded & inside, ((at < -1) | (at > SIZE)).any(axis=-1) & ~occluded
                assert hidden.sum() > 400
                assert beyond.any()
                assert not known[hidden].any()
                assert known[inside & ~occluded].mean() > 0.98
                assert (filled.read_masks(index) > 0)[hidden].all()
                assert ((after[hidden] >= low) & (after[hidden] <= high)).all()
                # Pixels beyond the band's image stay without a value.
                assert not filled.read_masks(index)[beyond].any()


# ---- the places of lenses in tags


@pytest.mark.parametrize(
    ("numbers", "unit_m"),
    [(("0.03,-0.021,0", "0,0,0"), 1.0), (("-15,10.5,0.2", "0.2,0.1,0"), 1e-3), (("0,0,0",), 1.0), (("1,2",), 1.0)],
)
def test_the_bands_of_a_camera_have_one_unit(numbers: Sequence[str], unit_m: float) -> None:
    """A lens at 0.2 mm is not at 0.2 m."""
    offsets = [pix4d.lens_offset(Tags(xmp={(pix4d.NAMESPACE, "RigTranslations"): (text,)})) for text in numbers]
    bands = [Band("", Path(), 1, 1, 1, "uint8", lens_offset=offset) for offset in offsets]
    assert pix4d.rig_unit_m(bands) == unit_m
    assert offsets[0] == (None if numbers == ("1,2",) else tuple(map(float, numbers[0].split(",")[:2])))


FILE_PX = 1280, 960
H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [1e-5, -2e-5, 1.0]])
LENSES = tuple(cameras.BANDS[k].lens(*FILE_PX) for k in (1, 3))
FIELD = DisplacementField(48.0, np.random.default_rng(0).normal(0, 1, (21, 28, 2)))
REDUCED = PairScales(PixelScale(0.5, 0.5), PixelScale(0.25, 0.25))
POINTS = geometry.lattice(*FILE_PX, 97, 83)


def rebuilt(alignment: Alignment, folder: Path) -> Alignment:
    """From a written sidecar."""
    return agalign.read_alignment(write_alone(alignment, folder), "nir")


def write_alone(alignment: Alignment, folder: Path) -> Path:
    """The sidecar of a capture of two bands; no other file."""
    bands = tuple(Band(name, Path(f"{name}.tif"), 1, *FILE_PX, "uint16") for name in ("green", "nir"))
    sidecar = Sidecar.estimated(Capture("c", Path(), bands, 0), {"nir": alignment}, agalign.Settings())
    write_sidecar(folder / "c.json", sidecar)
    return folder / "c.json"


def test_lenses_and_field_are_rebuilt(tmp_path: Path) -> None:
    alignment = aligned(PixelMapping(H, *LENSES, field=FIELD), FILE_PX)
    result = rebuilt(alignment, tmp_path)
    assert np.abs(result.map(POINTS) - alignment.map(POINTS)).max() < 0.02
    assert (result.geometry, result.space, result.size_px) == ("field", "undistorted", FILE_PX)


def test_a_field_of_reduced_images_is_rebuilt(tmp_path: Path) -> None:
    """Its nodes are not at pixels of the file."""
    nodes = gaussian_filter(FIELD.displacements_px[:11, :15], (1.0, 1.0, 0.0))
    field = DisplacementField(48.0, nodes / nodes.std())
    alignment = aligned(PixelMapping(H, field=field), (640, 480)).in_file_px(REDUCED, FILE_PX)
    assert np.abs(rebuilt(alignment, tmp_path).map(POINTS) - alignment.map(POINTS)).max() < 0.02


def test_all_parts_of_an_error_are_rebuilt(tmp_path: Path) -> None:
    numbers = {f.name: 0.1 + 0.01 * i for i, f in enumerate(fields(MappingError)) if f.type is float}
    assert len(numbers) == 4
    error = rebuilt(aligned(PixelMapping(H), FILE_PX, error=MappingError(FILE_PX, **numbers)), tmp_path).error
    assert {name: getattr(error, name) for name in numbers} == pytest.approx(numbers)


def test_status_seed_and_measurements_are_rebuilt(tmp_path: Path) -> None:
    residual = residual_of(np.array([[9.0, 8.0], [50.0, 8.0]]), np.array([[0.25, -0.5], [np.nan] * 2]))
    facts = {"issues": (Issue(RETRIEVAL, 0.1, 0.2),), "held_out_p95_px": {"homography": 0.5, "field": np.inf}}
    alignment = aligned(PixelMapping(H), FILE_PX, "seed_only", residual=residual, **facts)
    result = rebuilt(alignment, tmp_path)
    for name in ("status", "issues", "reason", "held_out_p95_px"):
        assert getattr(result, name) == getattr(alignment, name)
    assert (result.seed.kind, result.seed.peak_sigma, result.seed.runner_up_sigma) == ("rig", 30.0, 5.0)
    np.testing.assert_array_equal(result.seed.fixed_to_moving, H)
    for name in ("centres_px", "shifts_px", "median_px", "p95_px", "coverage", "peaks_sigma", "cells"):
        np.testing.assert_array_equal(getattr(result.residual, name), getattr(residual, name))


# ---- relief


def test_a_relief_is_rebuilt_whatever_the_grid_of_the_stack(run: Run, tmp_path: Path) -> None:
    """Also outside of the crop; pixels are compared below."""
    smooth = run.on_hill()
    sidecar = run.write(tmp_path, smooth, crop="common", undistort=True)
    assert np.prod(read_sidecar(sidecar).output.crop[2:]) < 0.99 * np.prod(SIZE)
    for name, alignment in smooth.items():
        result = agalign.read_alignment(sidecar, name)
        assert result.geometry == "relief"
        assert np.abs(result.map(PIXELS) - alignment.map(PIXELS)).max() < 0.02


def assert_same_as_stack(sidecar: Path, inputs: Path) -> int:
    """`read_alignment(...).warp` gives the bytes of the written bands; return how many there are."""
    content = read_sidecar(sidecar)
    area = np.s_[slice(content.output.crop[1], None), slice(content.output.crop[0], None)]
    with rasterio.open(sidecar.with_suffix(".tif")) as stack:
        for index, part in enumerate(content.bands, start=1):
            if part.status == "reference":
                continue
            alignment = agalign.read_alignment(sidecar, part.band)
            with rasterio.open(inputs / Path(part.file).name) as file:
                image = file.read(part.band_index)
            if alignment.mapping.parallax is None:
                at = geometry.lattice(*content.reference.size_px, 30, 20)
                assert np.abs(documented_reader()(band_in(sidecar, part.band), at) - alignment.map(at)).max() < 0.02
            pixels, _ = alignment.warp(image, nodata=stack.nodata)
            pixels, expected = pixels[area][: stack.height, : stack.width], stack.read(index)
            np.testing.assert_array_equal(pixels, expected)
            with pytest.raises(agalign.InputError, match=f"the aligned image {image.shape[1]} x {image.shape[0]} px"):
                alignment.warp(image[:, 1:])
    return len(content.bands) - 1


def test_an_alignment_warps_to_the_bytes_of_a_stack(aligned_flight: Path, flight: Path) -> None:
    """Of a run with default settings."""
    sidecars = find_sidecars(aligned_flight)
    assert sum(assert_same_as_stack(s, flight / s.parent.relative_to(aligned_flight)) for s in sidecars) == 8


@pytest.mark.full
@pytest.mark.real
@pytest.mark.slow
def test_an_alignment_warps_to_the_bytes_of_a_real_stack(real_data: Path, tmp_path: Path) -> None:
    """With residual lens distortion of the rig."""
    source = real_data / "flights" / "rededge_m_rowcrop"
    agalign.align_folder(source, tmp_path)
    sidecars = list(tmp_path.glob("IMG_????.json"))
    assert any(b.field is not None for b in read_sidecar(sidecars[0]).bands)
    assert sum(assert_same_as_stack(s, source) for s in sidecars) == 16


@pytest.mark.parametrize("crop", ["common", "none"])
def test_an_alignment_with_relief_warps_to_the_bytes_of_a_stack(run: Run, tmp_path: Path, crop: str) -> None:
    """Also behind a box of 12 px of parallax."""
    alignments = run.on_hill() if crop == "common" else run.with_relief(box())
    assert (alignments["NIR"].mapping.hidden(Tile(0, 0, *SIZE)).sum() > 500) == (crop == "none")
    assert assert_same_as_stack(run.write(tmp_path, alignments, crop=crop), run.capture.reference.path.parent) == 4


def test_the_sidecar_renders_the_same_bytes_again(run: Run, tmp_path: Path) -> None:
    """Shifts of windows, parallax and its standard error have more decimals in memory than in files."""
    rng, alignments = np.random.default_rng(1), {}
    parallax_px, confidence, std_px = rng.random((3, *SIZE[::-1]), np.float32)
    relief = Relief(parallax_px, confidence, std_px=std_px).on_pixels(SIZE)
    for name, alignment in run.on_hill().items():
        parallax = Parallax(relief, alignment.mapping.parallax.baseline).with_occlusions()
        residual = residual_of(rng.random((9, 2)) * SIZE, rng.standard_normal((9, 2)) / 3)
        error = MappingError(SIZE, np.eye(8) / 30, residual, parallax=parallax)
        alignments[name] = replace(
            alignment, mapping=alignment.mapping.with_parallax(parallax), residual=residual, error=error, std_px=0.3
        )
    added = {"relief_map": True, "error_map": True, "qa": True}
    sidecar = run.write(tmp_path, alignments, **added)
    for name, alignment in alignments.items():
        assert equal(agalign.read_alignment(sidecar, name).mapping, alignment.mapping)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.tif")}
    assert len(before) == 5
    for path in before.keys() - {sidecar.with_suffix(".parallax.tif")}:
        path.unlink()
    chosen = agalign.Settings(write=agalign.WriteSettings(crop="none", **added))
    batch.process_capture(batch.Task(run.capture, tmp_path, chosen, is_estimated=True))
    assert [path.name for path, data in before.items() if path.read_bytes() != data] == []


def test_a_range_on_a_finer_grid(run: Run) -> None:
    """Its pixels 20 to 420 and 14 to 334, at twice the resolution, are those from 10 to 210 and 7 to 167."""
    grid = OutputGrid(20, 14, 400, 320, PixelScale(2.0, 2.0))
    range_m = relief_layers(run.capture, run.alignments, run.relief, grid)["range"]
    assert np.median(range_m) == pytest.approx(np.median(run.truth.range_m[7:167, 10:210]), rel=0.005)


# ---- errors


def test_a_band_that_cannot_be_rebuilt(run: Run, tmp_path: Path) -> None:
    path = run.write(tmp_path)
    for name in ("SWIR", "Green"):
        with pytest.raises(
            agalign.NoSuchBandError, match=rf"\.json: no moving band '{name}'; choose from Blue, Red, NIR, Red edge"
        ):
            agalign.read_alignment(path, name)
    with pytest.raises(agalign.SidecarError, match=r"missing\.json"):
        agalign.read_alignment(tmp_path / "missing.json", "NIR")
    content, parallax = read_sidecar(path), path.with_suffix(".parallax.tif")
    bands = [b.model_copy(update={"homography": None}) if b.band == "NIR" else b for b in content.bands]
    for change, message in (
        ({"bands": bands}, "has no mapping of the band 'NIR'"),
        ({"parallax": None}, "its parallax was not written"),
    ):
        write_sidecar(path, content.model_copy(update=change))
        with pytest.raises(agalign.SidecarError, match=message):
            agalign.read_alignment(path, "NIR")
    write_sidecar(path, content)
    tifffile.imwrite(parallax, np.zeros((2, 20, 30), np.float32))
    with pytest.raises(
        agalign.SidecarError, match=r"\.parallax\.tif: is not what was written; delete it and run again"
    ):
        agalign.read_alignment(path, "NIR")
    parallax.unlink()
    with pytest.raises(
        agalign.SidecarError, match=r"\.parallax\.tif: cannot be read \(No such file or directory\); run"
    ):
        agalign.read_alignment(path, "NIR")
