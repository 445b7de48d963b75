import threading

import pytest
import torch

from agalign.errors import ConfigurationError
from agalign.method import device
from agalign.method.device import choose_device, exact, one_memory_error, one_thread


def test_a_device_that_is_not_there_is_a_configuration_error() -> None:
    assert choose_device("cpu").type == "cpu"
    for name in ("nonsense", "cuda:99"):
        with pytest.raises(ConfigurationError, match=name):
            choose_device(name)


def test_threads_that_overlap_leave_torch_as_the_first_one_found_it() -> None:
    """A worker of a cluster does several captures at a time in threads of one process."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    first_is_in, second_is_in, first_is_out = (threading.Event() for _ in range(3))

    def first() -> None:
        with one_thread():
            first_is_in.set()
            second_is_in.wait(5)
        first_is_out.set()

    def second() -> None:
        first_is_in.wait(5)
        with one_thread():
            second_is_in.set()
            first_is_out.wait(5)

    try:
        threads = [threading.Thread(target=t) for t in (first, second)]
        for t in threads:
            t.start()
        for t in threads:
            t.join(10)
        # OpenMP's own number is each thread's: what counts is the one that torch hands to the next.
        assert device._inside == 0
        assert device._before == 3
    finally:
        torch.set_num_threads(before)


def test_without_float64_on_the_device_psi_is_solved_for_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    tensor = torch.ones(3, dtype=torch.float32)
    assert exact(tensor).dtype == torch.float64
    monkeypatch.setattr(device, "_has_float64", lambda _: False)
    assert exact(tensor).device.type == "cpu"
    assert exact(tensor).dtype == torch.float64


def test_want_of_memory_has_one_name() -> None:
    with pytest.raises(MemoryError, match="not enough memory"), one_memory_error():
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory")
    with pytest.raises(RuntimeError, match="something else"), one_memory_error():
        raise RuntimeError("something else, of memory")
