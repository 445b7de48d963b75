"""Wrong arguments of the public functions, and arrays of other libraries."""

import copy
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import agalign
from agalign.pixels.masks import raster_of
from agalign.records.sidecar_file import read_sidecar
from agalign.values.arguments import checked
from agalign.values.mapping import PixelMapping

from .conftest import textured_image

WRONG: dict[str, object] = {
    "nothing": None, "integer": 3, "large": 10**400, "number": 3.5, "nan": float("nan"), "text": "x", "no text": "",
    "nul": "a\0b", "surrogate": "\ud800", "bytes": b"x", "list": [], "numbers": [1, 2, 3], "none inside": [None],
    "texts": [["a"]], "mapping": {}, "set": {1}, "range": range(3), "iterator": iter([1]), "object": object(),
    "truth": True, "function": len, "class": dict, "settings": agalign.Settings(), "array": np.zeros(3),
    "empty array": np.zeros(0), "complex array": np.zeros((2, 2), complex), "text array": np.array("x"),
    "time": np.datetime64("2026-06-01"),
}  # fmt: skip
CONSTANT = np.ones((64, 64), np.float32)


def alignment() -> agalign.Alignment:
    return agalign.Alignment(PixelMapping(np.eye(3)), (64, 64), (), agalign.Seed("user", np.eye(3), 0.0))


def right_arguments(aligned: Path) -> dict[str, tuple[Callable[..., object], dict[str, object]]]:
    """Public functions with arguments that take no time; folders and files of the input are missing."""
    sidecar = aligned / "0000SET" / "000" / "IMG_0001.json"
    of_run = {"settings": None, "run": None}
    return {
        "align": (agalign.align, {"fixed": CONSTANT, "moving": CONSTANT, "seed": None, "seed_std_px": None,
            "fixed_valid": None, "moving_valid": None, "settings": None}),
        "warp_onto": (agalign.warp_onto, {"moving": CONSTANT, "fixed_to_moving": np.eye(3), "fixed_size_px": (9, 9),
            "valid": None, "interpolation": "lanczos"}),
        "align_capture": (agalign.align_capture, {"capture": None, "out": "out", "settings": None}),
        "align_folder": (agalign.align_folder, {"folder": "no", "out": "out", "options": None, "model": None,
            "progress": None} | of_run),
        "onto": (agalign.onto, {"reference": "no.tif", "moving": ["no.tif"], "out": "out", "band": None} | of_run),
        "indices": (agalign.indices, {"out": "no", "names": ["ndvi"], "formulas": (), "target": None,
            "mask_qa": False, "run": None}),
        "export": (agalign.export, {"out": "no", "target": "new", "program": "odm", "copy": False}),
        "discover": (agalign.discover, {"folder": "no", "options": None}),
        "open_capture": (agalign.open_capture, {"path": sidecar, "masked": True}),
        "open_flight": (agalign.open_flight, {"out": aligned, "masked": True}),
        "read_alignment": (agalign.read_alignment, {"sidecar": sidecar, "band": "NIR"}),
        "dask_executor": (agalign.dask_executor, {"address": "no", "jobs": 1}),
        "map": (alignment().map, {"reference_px": [[0, 0]]}),
        "inverse": (alignment().inverse, {"moving_px": [[0, 0]]}),
        "warp": (alignment().warp, {"moving": CONSTANT, "valid": None, "nodata": None, "interpolation": "nearest"}),
    }  # fmt: skip


NAMES = [*right_arguments(Path())]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_wrong_arguments_raise_an_error_of_one_line(
    name: str, aligned_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is accepted, or named in an error of this package."""
    monkeypatch.chdir(tmp_path)
    (function, right), errors = right_arguments(aligned_flight)[name], list[str]()
    for argument in right:
        for wrong in WRONG.values():
            try:
                with warnings.catch_warnings(action="ignore"):
                    function(**right | {argument: wrong})
            except agalign.AgalignError as error:
                errors.append(str(error))
    assert len(errors) >= len(WRONG)
    assert [text for text in errors if "\n" in text or len(text) > 400] == []


def test_every_public_function_is_tried() -> None:
    assert {n for n in agalign.__all__ if callable(f := getattr(agalign, n)) and not isinstance(f, type)} <= {*NAMES}


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: agalign.align(CONSTANT, CONSTANT, settings="x"), "settings is 'x', not Settings"),
        (lambda: alignment().map([1, 2, 3]), "reference_px must be positions x, y (..., 2), not int64 (3,)"),
        (lambda: alignment().inverse("x"), "moving_px must be positions x, y (..., 2), not <U1 ()"),
        (lambda: agalign.indices("out", [3]), "names is [3], not a sequence of texts"),
        (lambda: agalign.indices("out", "ndvi"), "names is 'ndvi', not a sequence of texts"),
        (lambda: agalign.onto("june.tif", "july.tif", "out"), "moving is 'july.tif', not a sequence of paths"),
        (lambda: agalign.align_folder(None, "out"), "folder is None, not a path"),
        (lambda: agalign.align_folder("a", "out", progress=3), "progress is 3, not a function"),
        (lambda: agalign.export("out", "new", "x"), "program is 'x'; choose from odm, metashape, pix4d"),
        (lambda: agalign.open_flight("out", masked="no"), "masked is 'no', not True or False"),
        (lambda: alignment().is_usable("1"), "accept_predicted_px is '1', not a number"),
        (lambda: alignment().warp(CONSTANT, nodata="x"), "nodata is 'x', not a number"),
        (lambda: agalign.read_alignment("a.json", 3), "band is 3, not a text"),
        (lambda: agalign.dask_executor("local", jobs="2"), "jobs is '2', not an integer"),
    ],
)
def test_the_argument_is_named(call: Callable[[], object], said: str) -> None:
    with pytest.raises(agalign.InputError) as raised:
        call()
    assert str(raised.value) == said


def test_a_wrong_number_of_workers_is_refused() -> None:
    with (
        pytest.raises(agalign.ConfigurationError, match="jobs is -1; give 1 to 4096"),
        agalign.dask_executor("local", -1),
    ):
        pass


@pytest.mark.parametrize(
    ("options", "wrong"), [(agalign.RunOptions, {"overwite": True}), (agalign.DiscoverOptions, {"band": ("NIR",)})]
)
def test_an_option_that_does_not_exist_is_refused(options: Callable[..., object], wrong: dict[str, object]) -> None:
    with pytest.raises((TypeError, ValueError), match=next(iter(wrong))):
        options(**wrong)


def test_arguments_that_do_not_exist_are_those_of_python() -> None:
    @checked
    def function(number: int) -> int:
        return number

    assert function(np.int64(3)) == 3
    with pytest.raises(TypeError):
        function(3, 4)  # type: ignore[call-arg]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16, torch.uint8], ids=str)
def test_tensors_are_images_like_arrays(dtype: torch.dtype) -> None:
    array = (40 * textured_image(64, 64, 1) + 128).clip(1, 254)
    tensor = torch.from_numpy(array).to(dtype)
    expected = raster_of(tensor.float().numpy().astype(np.uint8 if dtype == torch.uint8 else np.float32), None, "fixed")
    if dtype.is_floating_point:
        tensor.requires_grad_()
    result = raster_of(tensor, torch.ones(64, 64, dtype=torch.bool), "fixed")
    np.testing.assert_array_equal(result.pixels, expected.pixels)
    np.testing.assert_array_equal(result.valid, expected.valid)
    warped, known = agalign.warp_onto(tensor, torch.eye(3, requires_grad=True), (64, 64))
    assert known.all()
    np.testing.assert_array_equal(warped, tensor.detach().float().numpy())


def test_masked_pixels_are_not_valid() -> None:
    image = np.ma.masked_array(textured_image(64, 64, 1), np.zeros((64, 64), bool))
    image[10:20, 30:] = np.ma.masked
    expected = np.ones((64, 64), bool)
    expected[10:20, 30:] = False
    np.testing.assert_array_equal(raster_of(image, None, "fixed").valid, expected)
    np.testing.assert_array_equal(raster_of(np.ma.dstack([image] * 3), None, "fixed").valid, expected)
    for warped, known in (alignment().warp(image), agalign.warp_onto(image, np.eye(3), (64, 64))):
        np.testing.assert_array_equal(known, expected)
        assert np.isnan(warped[~expected]).all()
    valid = np.ma.masked_array(np.ones((64, 64), bool), ~expected)
    np.testing.assert_array_equal(raster_of(image.data, valid, "fixed").valid, expected)


@pytest.mark.slow
def test_a_copy_of_a_result_equals_it(aligned_flight: Path, flight: Path) -> None:
    """A worker returns such a copy."""
    path = aligned_flight / "0000SET" / "000" / "IMG_0001.json"
    sidecar = read_sidecar(path)
    nir = next(band for band in sidecar.bands if band.band == "NIR")
    report = agalign.CaptureReport("IMG_0001", "done", sidecar.without_tables(), path)
    scan = agalign.discover(flight)
    results: tuple[Any, ...] = (
        report, agalign.FlightReports([report]), sidecar, agalign.read_alignment(path, "NIR"), scan, scan.captures[0],
        nir.seed, nir.joint, nir.metrics, agalign.Prediction(np.eye(3), "flight", 0.3),
        agalign.IndexReport("a", "ndvi"), agalign.ExportReport(1, [path], [], ["note"]),
    )  # fmt: skip
    for result in results:
        assert pickle.loads(pickle.dumps(result)) == result
        assert copy.deepcopy(result) == result
        assert result != "another"
    assert agalign.Seed("user", np.eye(3), 0.0) != agalign.Seed("user", 2 * np.eye(3), 0.0)
    assert agalign.Seed("user", np.eye(3), 0.0) != agalign.Seed("user", np.eye(4), 0.0)
    other = agalign.read_alignment(path.with_name("IMG_0002.json"), "NIR")
    assert other != agalign.read_alignment(path, "NIR")


def test_names_of_indices_are_in_lower_case_as_those_of_their_files() -> None:
    assert agalign.WriteSettings(indices=(" NDVI", "ndre")).indices == ("ndvi", "ndre")
