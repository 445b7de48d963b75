"""Check of the limit on the address space of this process."""

import sys

from agalign.errors import MemoryLimitError

MIN_ADDRESS_SPACE_BYTES = 1_800_000_000
"""Below about 1.6 GB the libraries crash, abort or hang, which cannot be caught."""


def check_address_space() -> None:
    """Raise MemoryLimitError if the address space (`ulimit -v`) is too small for the libraries."""
    if sys.platform == "win32":
        return
    import resource

    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit_bytes != resource.RLIM_INFINITY and limit_bytes < MIN_ADDRESS_SPACE_BYTES:
        raise MemoryLimitError(
            f"the address space of this process is limited to {limit_bytes / 1e9:.2f} GB (ulimit -v); agalign needs "
            f"{MIN_ADDRESS_SPACE_BYTES / 1e9:g} GB or more; raise that limit"
        )
