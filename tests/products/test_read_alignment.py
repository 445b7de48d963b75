"""The alignment that is rebuilt from a sidecar is the alignment of the run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from scipy.ndimage import gaussian_filter

import agalign
from agalign.errors import NoSuchBandError, SidecarError, UnreadableFileError
from agalign.products.fill_sidecar import sidecar_of
from agalign.products.relief_map import relief_layers
from agalign.products.sidecar_file import read_sidecar, write_sidecar
from agalign.relief.occlusion import occluded
from agalign.synthetic import cameras
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, PairScales, Residual, Seed
from agalign.values.capture import Band, Capture
from agalign.values.displacement import DisplacementField
from agalign.values.image import OutputGrid, Tile
from agalign.values.issues import RETRIEVAL, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale
from agalign.values.relief import Parallax, Relief

from .test_relief_map import PIXELS, SIZE, Run, read
from .test_sidecar import context_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
FILE_PX = 1280, 960
H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [1e-5, -2e-5, 1.0]])
LENSES = tuple(cameras.BANDS[k].lens(*FILE_PX) for k in (1, 3))
FIELD = DisplacementField(48.0, np.random.default_rng(0).normal(0, 1, (21, 28, 2)))
REDUCED = PairScales(PixelScale(0.5, 0.5), PixelScale(0.25, 0.25))
POINTS = geometry.lattice(*FILE_PX, 97, 83)


def rebuilt(alignment: Alignment, folder: Path) -> Alignment:
    """From a written sidecar."""
    bands = tuple(Band(name, Path(f"{name}.tif"), 1, *FILE_PX, "uint16") for name in ("green", "nir"))
    write_sidecar(folder / "c.json", sidecar_of(context_of(Capture("c", Path(), bands, 0), {"nir": alignment})))
    return agalign.read_alignment(folder / "c.json", "nir")


@pytest.mark.parametrize(
    "mapping",
    [PixelMapping(H), PixelMapping(H, *LENSES), PixelMapping(H, local=FIELD), PixelMapping(H, *LENSES, local=FIELD)],
    ids=["homography", "lenses", "field", "lenses and field"],
)
def test_mappings_of_files_are_rebuilt(mapping: PixelMapping, tmp_path: Path) -> None:
    alignment = Alignment(mapping, FILE_PX, "aligned", (), Seed("rig", H, 30.0))
    result = rebuilt(alignment, tmp_path)
    assert np.abs(result.map(POINTS) - alignment.map(POINTS)).max() < 0.02
    assert np.abs(result.mapping.of_the_plane(POINTS) - PixelMapping(H)(POINTS)).max() > 1 or mapping == PixelMapping(H)
    assert (result.geometry, result.space, result.size_px) == (alignment.geometry, alignment.space, FILE_PX)


def test_a_field_of_reduced_images_is_rebuilt(tmp_path: Path) -> None:
    """Its nodes are not at pixels of the file."""
    nodes = gaussian_filter(FIELD.displacements_px[:11, :15], (1.0, 1.0, 0.0))
    field = DisplacementField(48.0, nodes / nodes.std())
    on_images = Alignment(PixelMapping(H, local=field), (640, 480), "aligned", (), Seed("rig", H, 30.0))
    alignment = on_images.in_file_px(REDUCED, FILE_PX)
    assert np.abs(rebuilt(alignment, tmp_path).map(POINTS) - alignment.map(POINTS)).max() < 0.02


def test_status_seed_and_measurements_are_rebuilt(tmp_path: Path) -> None:
    residual = Residual.of(np.array([[9.0, 8.0], [50.0, 8.0]]), np.array([[0.25, -0.5], [np.nan] * 2]), np.ones(2))
    alignment = Alignment(
        PixelMapping(H), FILE_PX, "seed_only", (Issue(RETRIEVAL, 0.1, 0.2),), Seed("rig", H, 30.0, 30.0, 5.0),
        residual=residual, candidates={"homography": 0.5, "field": np.inf},
    )  # fmt: skip
    result = rebuilt(alignment, tmp_path)
    assert (result.status, result.issues, result.reason) == ("seed_only", alignment.issues, alignment.reason)
    assert (result.seed.kind, result.seed.peak_sigma, result.seed.runner_up_sigma) == ("rig", 30.0, 5.0)
    np.testing.assert_array_equal(result.seed.fixed_to_moving, H)
    assert result.residual is not None
    np.testing.assert_array_equal(result.residual.shifts_px, residual.shifts_px)
    assert (result.residual.p95_px, result.residual.coverage) == (residual.p95_px, 0.5)
    assert result.candidates == alignment.candidates


# ---- relief


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("relief"))


def on_hill(alignment: Alignment) -> Alignment:
    hill = 8 * np.exp(-((PIXELS - np.array(SIZE) / 2) ** 2).sum(axis=-1) / 2 / 40**2).astype(np.float32)
    parallax = alignment.mapping.parallax
    assert parallax is not None
    parallax = replace(parallax, relief=Relief(hill, np.ones_like(hill)), hidden=None)
    return replace(alignment, mapping=alignment.mapping.with_parallax(parallax))


@pytest.mark.parametrize(
    "settings",
    [{}, {"crop": "common"}, {"crop": "common", "undistort": True}],
    ids=str,
)
def test_a_relief_is_rebuilt_where_it_was_written(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, object]
) -> None:
    """A hill: steps of a relief are not reproduced on a grid with other pixels."""
    smooth = {name: on_hill(alignment) for name, alignment in run.alignments.items()}
    monkeypatch.setattr(run, "alignments", smooth)
    sidecar = run.write(tmp_path, monkeypatch, **settings)
    assert sidecar.output is not None
    lower, size_px = np.array(sidecar.output.crop[:2]), np.array(sidecar.output.crop[2:])
    at = lens.undistort(run.capture.reference.lens, PIXELS) if "undistort" in settings else PIXELS
    written = ((at >= lower) & (at <= lower + size_px - 1)).all(axis=-1)
    assert written.mean() > 0.5
    assert written.all() == (not settings)
    for name, alignment in smooth.items():
        result = agalign.read_alignment(tmp_path / run.capture.folder / f"{sidecar.capture}.json", name)
        assert result.geometry == "relief"
        assert np.abs(result.map(PIXELS) - alignment.map(PIXELS))[written].max() < 0.02


def test_a_relief_on_a_finer_grid_is_rebuilt(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pixels 20 to 420 and 14 to 334, at twice the resolution, are those from 10 to 210 and 7 to 167."""
    sidecar = run.write(tmp_path, monkeypatch)
    path = tmp_path / run.capture.folder / f"{sidecar.capture}.json"
    monkeypatch.setattr(run, "alignments", {n: on_hill(a) for n, a in run.alignments.items()})
    grid = OutputGrid(20, 14, 400, 320, PixelScale(2.0, 2.0))
    layers = relief_layers(run.capture, run.alignments, run.alignments["NIR"].mapping.parallax.relief, grid)  # type: ignore[union-attr]
    tifffile.imwrite(path.with_name(f"{sidecar.capture}.relief.tif"), layers["parallax"].astype(np.float32))
    output = sidecar.output.model_copy(update={"crop": (20, 14, 400, 320), "scale": (2.0, 2.0)})  # type: ignore[union-attr]
    write_sidecar(path, sidecar.model_copy(update={"output": output}))
    at = PIXELS[8:166, 11:209]
    result = agalign.read_alignment(path, "NIR")
    assert np.abs(result.map(at) - run.alignments["NIR"].map(at)).max() < 0.02


def test_occlusions_are_those_of_the_run(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a box of 12 px of parallax."""
    z = np.zeros(SIZE[::-1], np.float32)
    z[60:120, 80:160] = 12
    box = Relief(z, np.ones_like(z))
    boxes = {}
    for name, alignment in run.alignments.items():
        assert alignment.mapping.parallax is not None
        baseline = alignment.mapping.parallax.baseline
        parallax = Parallax(box, baseline, occluded(box, baseline))
        boxes[name] = replace(alignment, mapping=alignment.mapping.with_parallax(parallax))
    monkeypatch.setattr(run, "alignments", boxes)
    sidecar = run.write(tmp_path, monkeypatch)
    result = agalign.read_alignment(tmp_path / run.capture.folder / f"{sidecar.capture}.json", "NIR")
    expected = boxes["NIR"].mapping.hidden(Tile(0, 0, *SIZE))
    assert expected.sum() > 500
    np.testing.assert_array_equal(result.mapping.hidden(Tile(0, 0, *SIZE)), expected)


def test_warp_gives_the_pixels_of_the_stack(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the steps of the relief."""
    sidecar = run.write(tmp_path, monkeypatch)
    folder = tmp_path / run.capture.folder
    (band,) = (b for b in run.capture.moving if b.name == "NIR")
    with rasterio.open(band.path) as file, rasterio.open(folder / f"{sidecar.capture}.tif") as stack:
        index = stack.descriptions.index("NIR") + 1
        expected, known = stack.read(index).astype(float), stack.read_masks(index) > 0
        pixels, valid = agalign.read_alignment(folder / f"{sidecar.capture}.json", "NIR").warp(file.read(1))
    assert (valid == known).mean() > 0.95
    assert not known.all()
    both = valid & known
    assert np.percentile(np.abs(pixels - expected)[both], 99) < 0.03 * expected[both].std()


# ---- errors


def test_a_band_that_cannot_be_rebuilt(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = run.write(tmp_path, monkeypatch)
    path = tmp_path / run.capture.folder / f"{sidecar.capture}.json"
    for name in ("SWIR", "Green"):
        with pytest.raises(
            NoSuchBandError, match=rf"\.json: no moving band '{name}'; choose from Blue, Red, NIR, Red edge"
        ):
            agalign.read_alignment(path, name)
    with pytest.raises(SidecarError, match=r"missing\.json"):
        agalign.read_alignment(tmp_path / "missing.json", "NIR")
    relief = path.with_name(f"{sidecar.capture}.relief.tif")
    assert set(read(relief)) == {"parallax"}
    relief.unlink()
    with pytest.raises(UnreadableFileError, match=r"\.relief\.tif"):
        agalign.read_alignment(path, "NIR")
    content = read_sidecar(path)
    for change, message in (
        ({"homography": None}, "has no mapping of the band 'NIR'"),
        ({"relief": content.bands[3].relief.model_copy(update={"file": None})}, "its relief was not written"),  # type: ignore[union-attr]
    ):
        bands = [b.model_copy(update=change) if b.band == "NIR" else b for b in content.bands]
        write_sidecar(path, content.model_copy(update={"bands": bands}))
        with pytest.raises(SidecarError, match=message):
            agalign.read_alignment(path, "NIR")
