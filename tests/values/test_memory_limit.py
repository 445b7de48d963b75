"""The limit on the address space is checked before the libraries are loaded."""

import pytest

from agalign.errors import MemoryLimitError, is_out_of_memory
from agalign.values.memory_limit import MIN_ADDRESS_SPACE_BYTES, check_address_space

resource = pytest.importorskip("resource", reason="address space is limited on POSIX only")


@pytest.mark.parametrize("limit_bytes", [resource.RLIM_INFINITY, MIN_ADDRESS_SPACE_BYTES])
def test_enough_address_space_is_accepted(monkeypatch: pytest.MonkeyPatch, limit_bytes: int) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit_bytes, resource.RLIM_INFINITY))
    check_address_space()


def test_too_little_address_space_is_refused_with_both_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1_200_000_000, resource.RLIM_INFINITY))
    with pytest.raises(MemoryLimitError, match=r"limited to 1\.20 GB \(ulimit -v\); agalign needs 1\.8 GB or more"):
        check_address_space()


@pytest.mark.parametrize("text", ["can't start new thread", "could not create a primitive"])
def test_what_libraries_raise_when_memory_is_short(text: str) -> None:
    assert is_out_of_memory(RuntimeError(text))
