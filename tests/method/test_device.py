from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from agalign.batch.flight_learning import learn_flight
from agalign.cameras.discover import DiscoverOptions, discover
from agalign.capture.align_bands import align_capture_bands
from agalign.config import JointSettings, SeedSettings, Settings
from agalign.errors import ConfigurationError
from agalign.flight.model import load_model, save_model
from agalign.method import device
from agalign.method.device import choose_device, one_memory_error, one_thread
from agalign.method.fast import Schedule
from agalign.method.joint import learn_and_refine
from agalign.method.paper import Training
from agalign.method.state import ImageGroup, MovingImage
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.choices import Recipe
from agalign.values.lens import Lens
from agalign.values.mapping import DisplacementField

from ..builders import in_full_run, two_views, whole
from .pretended_device import NAME, PretendedDevice


def test_an_unavailable_device_is_a_configuration_error(monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_device("cpu").type == "cpu"
    assert choose_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    for name in ("nonsense", "cuda:99", "hpu", "xpu:99"):
        with pytest.raises(ConfigurationError, match=name):
            choose_device(name)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigurationError, match="no CUDA device") as raised:
        choose_device("cuda")
    assert "Torch not compiled" not in str(raised.value)


def test_overlapping_contexts_restore_the_threads_of_torch() -> None:
    """A worker of a cluster processes several captures in threads of one process."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    first, second = ExitStack(), ExitStack()
    try:
        for context in (first, second):
            context.enter_context(one_thread())
        for context, threads in ((first, 1), (second, 3)):
            assert torch.get_num_threads() == 1
            context.close()
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_out_of_memory_is_always_a_memory_error() -> None:
    with pytest.raises(MemoryError, match="Failed to allocate"), one_memory_error():
        cv2.resize(np.zeros((9, 9)), (1 << 30, 1 << 20))
    with pytest.raises(MemoryError, match="can't allocate memory"), one_memory_error():
        torch.empty(1 << 60)
    with pytest.raises(RuntimeError, match="something else"), one_memory_error():
        raise RuntimeError("something else, of memory")


AssertEqualOnGpu = Callable[[Callable[[str], JointResult], bool], None]
"""Call with a function that aligns on the device of a name, and whether the GPU has float64, which Apple's lack."""


@pytest.fixture
def assert_equal_on_gpu(monkeypatch: pytest.MonkeyPatch) -> AssertEqualOnGpu:
    """The results of the CPU and of a pretended GPU are equal; all work is in one thread."""
    monkeypatch.setattr(ThreadPoolExecutor, "map", lambda _self, function, *items: map(function, *items))

    def check(align: Callable[[str], JointResult], has_float64: bool) -> None:
        monkeypatch.setattr(device, "_has_float64", lambda d: has_float64 or d.type != NAME)
        on_cpu = align("cpu")
        with PretendedDevice(has_float64=has_float64) as used:
            on_gpu = align(NAME)
        assert used.operations > 1000
        np.testing.assert_allclose(on_gpu.fixed_to_moving, on_cpu.fixed_to_moving, rtol=1e-9)
        np.testing.assert_allclose((on_gpu.loss, on_gpu.retrieval), (on_cpu.loss, on_cpu.retrieval), rtol=1e-6)
        assert on_gpu.iterations == on_cpu.iterations

    return check


@pytest.mark.full
@pytest.mark.parametrize(
    ("recipe", "has_float64"), [("fast", False), in_full_run("fast", True), in_full_run("paper", False)]
)
def test_a_gpu_gives_the_result_of_the_cpu(
    assert_equal_on_gpu: AssertEqualOnGpu, recipe: Recipe, has_float64: bool
) -> None:
    fixed, moving = (view.pixels for view in two_views(geometry.translation(6.0, -4.0), 260, 200))
    lens, field = Lens(260.0, 260.0, 130.0, 100.0, (0.01,)), DisplacementField(60.0, np.full((5, 6, 2), 0.1))
    short = {"schedule": Schedule(max_steps=10, enough_retrieval=2.0), "training": Training(200, 1)}

    def align(name: str) -> JointResult:
        rgb, band = whole(np.stack([fixed, 0.5 * fixed, -fixed]), lens), whole(moving, lens)
        seed, settings = geometry.translation(7.0, -5.0), JointSettings(recipe=recipe, device=name)
        group = ImageGroup(rgb, [MovingImage(band, seed, max_shift_px=9.0, field=field)])
        (result,) = learn_and_refine(group, settings, lambda *_: None, **short).values()
        assert result.iterations > 0
        return result

    assert_equal_on_gpu(align, has_float64)


@pytest.mark.full
def test_a_flight_on_a_gpu_has_the_result_of_the_cpu(
    assert_equal_on_gpu: AssertEqualOnGpu, flight: Path, tmp_path: Path
) -> None:
    """Learning, the model file, keypoint matching and refinement with the frozen network."""
    captures = discover(flight, DiscoverOptions(bands=("Green", "NIR"))).captures

    def align(name: str) -> JointResult:
        settings = Settings(joint=JointSettings(device=name), seed=SeedSettings(force="match"))
        model, path = learn_flight(captures, settings, lambda *_: None), tmp_path / name
        save_model(model, path)
        loaded = load_model(path, lambda: choose_device(name))
        assert {w.device.type for w in (*model.net.parameters(), *loaded.net.parameters())} == {name}
        return align_capture_bands(captures[0], settings, loaded, lambda *_: None)["NIR"].joint

    assert_equal_on_gpu(align, True)
