"""What is rendered again without estimating: changed options, lost files, and a run that was killed in between."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

import agalign
from agalign.batch import capture_task
from agalign.batch.render import _output
from agalign.batch.run import plan_run
from agalign.records.captures import bands_of
from agalign.records.cautions import RunFacts
from agalign.records.sidecar_file import content_checksum, find_sidecars, read_sidecar, verify_outputs
from agalign.spectral_indices.rasters import index_rasters
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture
from agalign.values.fields import POSITION_DECIMALS
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.radiometric_errors import PANEL
from agalign.values.radiometry import Radiometry

from ..builders import in_full_run, joint_result, residual_of
from ..conftest import raising, read_json, seeded
from ..program import agalign_here
from ..rasters.test_relief_map import SIZE, Run
from ..run_outputs import aligned, context_of, table_in

pytestmark = pytest.mark.slow

THREE = agalign.DiscoverOptions(bands=("Green", "Red", "NIR"))
SEEDS = seeded("rig")
OTHER = {
    "radiometry": "sun",
    "interpolation": "bilinear",
    "crop": "none",
    "layout": "both",
    "format": "cog",
    "qa": True,
    "error_map": True,
    "tie_points": True,
}


@pytest.fixture
def without_estimating(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From its call on, a capture that is estimated is an error."""
    error = raising(AssertionError("estimated again"))
    return lambda: monkeypatch.setattr(capture_task, "align_capture_bands", error)


def files_of(out: Path) -> dict[str, bytes | str]:
    """The bytes of the files of the captures below a folder; the checksums of their sidecars without times, and without
    those of the images, which a link that another test makes changes.
    """
    sidecars = find_sidecars(out)
    paths = (p for folder in {s.parent for s in sidecars} for p in folder.iterdir())
    return {
        p.relative_to(out).as_posix(): content_checksum(json.dumps({**read_json(p), "input_states": {}}))
        if p in sidecars
        else p.read_bytes()
        for p in paths
        if p.is_file()
    }


def assert_same_files(out: Path, expected: Path) -> None:
    one, other = files_of(out), files_of(expected)
    assert sorted(one) == sorted(other)
    assert [name for name in one if one[name] != other[name]] == []
    assert all(problems == [] for _, problems in verify_outputs(out))


@pytest.mark.full
def test_other_options_render_the_bytes_of_a_direct_run(
    flight: Path, tmp_path: Path, without_estimating: Callable[[], None]
) -> None:
    settings = agalign.Settings(relief=agalign.ReliefSettings(use=False))
    others = settings.model_copy(update={"write": agalign.WriteSettings.model_validate(OTHER)})
    out, direct = tmp_path / "out", tmp_path / "direct"
    agalign.align_folder(flight, direct, settings=others, options=THREE)
    agalign.align_folder(flight, out, settings=settings, options=THREE)
    before = files_of(out)
    without_estimating()
    reports = agalign.align_folder(flight, out, settings=others, options=THREE)
    assert [(r.state, r.error, r.removed) for r in reports] == [("done", None, ())] * 2
    assert_same_files(out, direct)
    assert all(before[name] != data for name, data in files_of(direct).items() if name in before)
    again = agalign.align_folder(flight, out, settings=others, options=THREE)
    assert [r.state for r in again] == ["kept"] * 2


def with_field(run: Run) -> dict[str, Alignment]:
    """Alignments with a displacement field, and numbers of many digits, which a sidecar rounds."""
    rng = np.random.default_rng(0)
    result = {}
    for name, alignment in run.alignments.items():
        field = DisplacementField(48.0, rng.normal(0, 1, (6, 7, 2)).round(POSITION_DECIMALS))
        mapping = replace(alignment.mapping, parallax=None, field=field)
        centres_px = rng.uniform((0, 0), SIZE, (30, 2))
        residual = residual_of(centres_px, rng.normal(0, 0.1, (30, 2)), sigma=17.123456)
        joint = joint_result(std_px=0.0512345678, covariance=np.diag(rng.uniform(0, 0.01, 8)))
        error = MappingError(
            alignment.size_px,
            joint.covariance_px2,
            residual,
            lens_std_px=rng.uniform(0, 0.1, 4),
            field_std_px=1.23456789,
            relief_std_px=0.23456789,
        )
        result[name] = replace(alignment, mapping=mapping, residual=residual, joint=joint, error=error)
    return result


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("relief"))


def alignments_of(run: Run, kind: str) -> dict[str, Alignment]:
    if kind == "field":
        return with_field(run)
    rng = np.random.default_rng(1)
    hill = run.on_hill()
    joint = joint_result(std_px=0.0512345678)
    result = {}
    for name, alignment in hill.items():
        lens_std_px, parallax = rng.uniform(0, 0.1, 4), alignment.mapping.parallax
        error = MappingError(
            alignment.size_px, joint.covariance_px2, alignment.residual, lens_std_px=lens_std_px, parallax=parallax
        )
        result[name] = replace(alignment, joint=joint, error=error)
    return result


@pytest.mark.parametrize(
    ("kind", "crop"),
    [
        ("relief", "common"),
        *(in_full_run(*pair) for pair in (("field", "none"), ("field", "common"), ("relief", "none"))),
    ],
)
def test_relief_and_field_are_rendered_on_another_grid(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_estimating: Callable[[], None],
    kind: str,
    crop: str,
) -> None:
    """The parallax is known outside of the rasters that the first run wrote."""
    folder, out, direct = run.capture.reference.path.parents[2], tmp_path / "out", tmp_path / "direct"
    alignments = alignments_of(run, kind)
    monkeypatch.setattr(capture_task, "align_capture_bands", lambda *_: alignments)
    settings = seeded(crop="none" if crop == "common" else "common")
    others = seeded(**(OTHER | {"crop": crop, "relief_map": True, "fill_occluded": True, "undistort": True}))
    (first,) = agalign.align_folder(folder, out, settings=settings)
    assert (first.state, first.error, first.path.with_suffix(".parallax.tif").exists()) == (
        "done",
        None,
        kind == "relief",
    )
    agalign.align_folder(folder, direct, settings=others)
    without_estimating()
    (report,) = agalign.align_folder(folder, out, settings=others)
    assert (report.state, report.error) == ("done", None)
    assert report.result.output.crop != first.result.output.crop
    assert_same_files(out, direct)


@pytest.fixture
def out(flight: Path, tmp_path: Path) -> Path:
    agalign.align_folder(flight, tmp_path / "out", settings=SEEDS)
    return tmp_path / "out"


def test_a_deleted_stack_is_rendered_from_its_sidecar(
    flight: Path, out: Path, without_estimating: Callable[[], None]
) -> None:
    before, stack = files_of(out), out / "0000SET" / "000" / "IMG_0002.tif"
    stack.unlink()
    without_estimating()
    plan = plan_run(agalign.discover(flight), out, SEEDS)
    assert list(plan.values()) == [
        "kept from an earlier run",
        "to be rendered again; changed since: files that are missing",
    ]
    reports = agalign.align_folder(flight, out, settings=SEEDS)
    assert [(r.state, r.error) for r in reports] == [("kept", None), ("done", None)]
    assert files_of(out) == before


def test_a_deleted_parallax_is_estimated_again(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, calls = run.capture.reference.path.parents[2], []

    def align(*_: object) -> dict[str, Alignment]:
        calls.append(1)
        return run.on_hill()

    monkeypatch.setattr(capture_task, "align_capture_bands", align)
    for _ in range(2):
        (report,) = agalign.align_folder(folder, tmp_path, settings=seeded())
        before = files_of(tmp_path)
        report.path.with_suffix(".parallax.tif").unlink()
    assert len(calls) == 2
    agalign.align_folder(folder, tmp_path, settings=seeded())
    assert (len(calls), files_of(tmp_path)) == (3, before)


def test_a_run_that_is_killed_before_rendering_renders_on_resume(
    flight: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_estimating: Callable[[], None]
) -> None:
    killed = tmp_path / "killed"
    with monkeypatch.context() as patch:
        patch.setattr(capture_task, "render", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            agalign.align_folder(flight, killed, settings=SEEDS)
    (sidecar,) = map(read_sidecar, find_sidecars(killed))
    assert (sidecar.output, sidecar.products, sidecar.rendered_with) == (None, [], "")
    plan = plan_run(agalign.discover(flight), killed, SEEDS)
    assert list(plan.values()) == ["to be rendered", "to be aligned"]
    without_estimating()
    first, second = agalign.align_folder(flight, killed, settings=SEEDS)
    assert (first.state, first.error) == ("done", None)
    assert "estimated again" in second.error
    assert {k: v for k, v in files_of(out).items() if "IMG_0001" in k} == files_of(killed)


@pytest.mark.full
def test_a_run_that_is_killed_while_it_renders_again_renders_on_resume(
    flight: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_estimating: Callable[[], None]
) -> None:
    """Some files have the new options then, and the sidecar describes the old ones."""
    others = seeded("rig", qa=True, interpolation="nearest")
    agalign.align_folder(flight, tmp_path / "direct", settings=others)
    without_estimating()
    with monkeypatch.context() as patch:
        patch.setattr("agalign.rasters.preview.Preview.write", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            agalign.align_folder(flight, out, settings=others)
    unchanged = read_sidecar(find_sidecars(out)[0])
    assert unchanged.rendered_with == ""
    for settings, states in ((SEEDS, ["done", "kept"]), (others, ["done", "done"])):
        reports = agalign.align_folder(flight, out, settings=settings)
        assert sorted(r.state for r in reports) == states
    assert_same_files(out, tmp_path / "direct")


# ---- spectral indices


def values_of(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return np.asarray(file.read().astype(float))


def ndvi_of_stack(path: Path) -> np.ndarray:
    with rasterio.open(path) as stack:
        planes = dict(zip(stack.descriptions, stack.read(masked=True).astype(float), strict=True))
    return np.asarray(((planes["NIR"] - planes["Red"]) / (planes["NIR"] + planes["Red"])).filled(np.nan))


@pytest.mark.full
def test_indices_of_a_later_command_are_calculated_of_the_new_pixels(
    flight: Path, aligned_flight: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(aligned_flight, tmp_path / "out")
    stack = out / "0000SET" / "000" / "IMG_0001.tif"
    ndvi, savi = (stack.with_name(f"IMG_0001_{name}.tif") for name in ("ndvi", "savi"))

    def rows(index: str) -> list[dict[str, str]]:
        return [row for row in table_in(out / "indices.csv") if row["index"] == index]

    def indices(names: str) -> None:
        assert agalign_here("indices", out, "--index", names).returncode == 0

    def align(*options: str) -> str:
        done = agalign_here(flight, "-o", out, *options)
        assert done.returncode == 0
        assert "2 finished captures to be rendered again; changed since: --radiometry" in done.stderr
        return " ".join(done.stderr.split())

    indices("ndvi")
    of_raw, (before, _) = values_of(ndvi), rows("ndvi")
    assert before["input"] == "raw numbers"
    assert "removed" not in align("--radiometry", "sun")
    assert not np.allclose(values_of(ndvi), of_raw, atol=0.01, equal_nan=True)
    known = np.isfinite(values_of(ndvi)[0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(values_of(ndvi)[0][known], ndvi_of_stack(stack)[known], atol=1e-5)
    for row in rows("ndvi"):
        values = values_of(out / row["file"])
        assert (row["input"], float(row["median"])) == ("reflectance", pytest.approx(np.nanmedian(values), abs=1e-4))
    assert abs(float(rows("ndvi")[0]["median"]) - float(before["median"])) > 0.01

    indices("savi")
    assert len(rows("savi")) == 2
    said = align("--radiometry", "off")
    assert "agalign: 2 files of an earlier command removed, such as" in said
    assert "_savi.tif: needs reflectance, and the bands are raw numbers; align with --radiometry" in said
    assert not list(savi.parent.glob("*_savi.*"))
    assert rows("savi") == []
    np.testing.assert_array_equal(values_of(ndvi), of_raw)
    assert rows("ndvi")[0] == before
    assert all(problems == [] for _, problems in verify_outputs(out))


# ---- what is removed


@pytest.mark.full
def test_nothing_is_removed_silently_with_another_layout(flight: Path, tmp_path: Path) -> None:
    def align(**write: Any) -> agalign.CaptureReport:
        return agalign.align_folder(flight, tmp_path, settings=seeded("rig", **write))[0]

    added = {"qa": True, "error_map": True, "tie_points": True}
    stack, band = (tmp_path / "0000SET" / "000" / name for name in ("IMG_0001.tif", "IMG_0001_4.tif"))
    align(**added)
    before, qa = set(files_of(tmp_path)), stack.with_suffix(".qa.tif").read_bytes()
    report = align(layout="bands")
    assert report.removed == ((stack, "--layout bands"),)
    after = set(files_of(tmp_path))
    assert before - after == {f"0000SET/000/IMG_000{number}.tif" for number in (1, 2)}
    assert stack.with_suffix(".qa.tif").read_bytes() == qa
    assert {part.kind for part in report.result.products} >= {"band", "qa", "tie_points", "error_map"}
    report = align()
    assert (band, "--layout stack") in report.removed
    assert len(report.removed) == 5
    assert set(files_of(tmp_path)) == before


def test_removed_files_are_printed(flight: Path, out: Path) -> None:
    done = agalign_here(flight, "-o", out, "--seed", "rig", "--only-seed", "--layout", "bands")
    (line,) = [text for text in " ".join(done.stderr.split()).split("agalign: ") if "removed" in text]
    assert line.startswith("2 files of an earlier command removed, such as ")
    assert re.search(r"IMG_000[12]\.tif: --layout bands $", line)


# ---- the size of a sidecar


def test_a_sidecar_of_five_bands_is_small(aligned_flight: Path) -> None:
    for path in find_sidecars(aligned_flight):
        assert len(read_sidecar(path).bands) == 5
        assert path.stat().st_size < 150_000


def test_an_index_that_a_command_has_masked_stays_masked(flight: Path, aligned_flight: Path, tmp_path: Path) -> None:
    """Also if the run names it, as it did when it computed it without a mask."""
    out = shutil.copytree(aligned_flight, tmp_path / "out")
    for options, is_masked in (({}, False), ({"statistics": True}, True)):
        write = agalign.WriteSettings(qa=True, indices=("ndvi",), **options)
        agalign.align_folder(flight, out, settings=agalign.Settings(write=write))
        rasters = [raster for path in find_sidecars(out) for raster in index_rasters(path.with_suffix(""))]
        assert [raster.is_masked for raster in rasters] == [is_masked] * 2
        agalign.indices(out, ["ndvi"], mask_qa=True)


def test_stacks_of_a_camera_have_the_same_bands_in_the_same_order(flight: Path, tmp_path: Path) -> None:
    """Also without a file, with an unreadable one, and with a constant band."""
    folder, out = shutil.copytree(flight, tmp_path / "in"), tmp_path / "out"
    for number, damage in (("2", Path.unlink), ("4", lambda path: path.write_text("no image")), ("5", _make_constant)):
        damage(next(folder.rglob(f"IMG_0001_{number}.tif")))
    settings = seeded("rig", radiometry="camera", qa=True)
    options = agalign.DiscoverOptions(reference="Blue")
    agalign.align_folder(folder, out, settings=settings, options=options)
    lacking, whole = (read_sidecar(path) for path in find_sidecars(out))
    stacks, qualities = ([path.with_suffix(end) for path in find_sidecars(out)] for end in (".tif", ".qa.tif"))
    with rasterio.open(stacks[0]) as stack, rasterio.open(stacks[1]) as other:
        assert stack.descriptions == other.descriptions == ("Blue", "Green", "Red", "NIR", "Red edge")
        assert np.isnan(stack.read([2, 4, 5])).all()
        tags = [stack.tags(index) for index in (2, 4, 5)]
        assert [one["STATUS"] for one in tags] == ["missing", "missing", "failed"]
        assert [one["wavelength"] for one in tags] == [other.tags(index)["wavelength"] for index in (2, 4, 5)]
        assert tags[0]["REASON"] == "a band of this camera is missing"
        assert tags[1]["REASON"].startswith("IMG_0001_4.tif: is not a TIFF")
        assert "constant" in tags[2]["REASON"]
    with rasterio.open(qualities[0]) as quality:
        assert quality.descriptions == ("all bands", *stack.descriptions)
    assert [lacking.missing_bands, whole.missing_bands] == [["Green", "NIR"], []]
    reasons = {name: reason for name, status, reason in lacking.pairs if status == "missing"}
    assert reasons == {name: tag["REASON"] for name, tag in zip(("Green", "NIR"), tags, strict=False)}
    causes = {c.band: c.remedy.cause for c in RunFacts().cautions(lacking) if c.status == "missing"}
    assert causes == {"Green": "a band of this camera is missing", "NIR": "a file cannot be read"}
    assert lacking.output is not None
    assert lacking.output.bands == list(stack.descriptions)
    # A band is read from its own layers.
    red = {band.name: band for band in bands_of(lacking, stacks[0].parent, mask_qa=True)}["Red"]
    assert (red.band_index, red.quality and red.quality[1]) == (3, 4)
    # With the files of the flight again, the capture is estimated again, and its stack has the same bands.
    shutil.copytree(flight, folder, dirs_exist_ok=True)
    agalign.align_folder(folder, out, settings=settings, options=options)
    with rasterio.open(stacks[0]) as stack:
        assert stack.descriptions == ("Blue", "Green", "Red", "NIR", "Red edge")
        assert not np.isnan(stack.read()).all(axis=(1, 2)).any()


def _make_constant(path: Path) -> None:
    with rasterio.open(path, "r+") as file:
        file.write(np.full((1, *file.shape), 20_000, file.dtypes[0]))


def test_each_band_has_its_quantity_and_its_source() -> None:
    """A thermal band is the reference; temperatures have no expected error."""
    thermal, light = Radiometry("temperature", 27315.0, 1.0, 0.01), Radiometry("reflectance", 0.0, 1.0, 1.0)
    bands = (
        Band("LWIR", Path("6.tif"), 1, 40, 30, "uint16", radiometry=thermal),
        Band("NIR", Path("4.tif"), 1, 40, 30, "uint16", radiometry=replace(light, source="panel", errors=(PANEL,))),
    )
    capture = Capture("IMG_0001", Path(), bands, 0)
    context = context_of(capture, {"NIR": aligned(PixelMapping(np.eye(3)), (40, 30))}, radiometry="panel")
    output = _output(context, {"LWIR": 0.5})
    assert output.radiometry == "temperature by camera calibration and reflectance by panel"
    assert output.light_sources == {"NIR": "panel"}
    parts = [(p.band, p.quantity, p.source, p.std_percent) for p in output.band_radiometry]
    assert parts[1:] == [("NIR", "reflectance", "panel", 3.0)]
    assert parts[0][:3] == ("LWIR", "temperature", "camera calibration")
    assert np.isnan(parts[0][3])
    assert [part.band for part in output.illumination] == ["NIR"]
