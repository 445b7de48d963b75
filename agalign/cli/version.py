"""What `agalign --version` prints: versions, devices and limits."""

import math
import os
import platform
from collections.abc import Iterator

from agalign._version import __version__
from agalign.host.libraries import library_versions
from agalign.host.processes import memory_limit_bytes, total_memory_bytes, usable_cores


def version_lines() -> Iterator[str]:
    """Yield the version of agalign, and a line for each library, limit and device of this machine."""
    yield f"agalign {__version__}"
    for name, version in library_versions().items():
        yield f"{name} {version}"
    yield f"system {platform.platform()}"
    yield f"cores {usable_cores()} usable of {os.cpu_count()}"
    yield f"memory {_memory()}"
    yield from _lines_of_compiled_libraries()


def _memory() -> str:
    total_bytes, limit_bytes = total_memory_bytes(), memory_limit_bytes()
    total = "unknown" if total_bytes == math.inf else f"{total_bytes / 1e9:.1f} GB"
    return total if limit_bytes >= total_bytes else f"{total}, limited to {limit_bytes / 1e9:.1f} GB"


def _lines_of_compiled_libraries() -> Iterator[str]:
    """The version of GDAL, and the devices; or why a library cannot be loaded."""
    try:
        from agalign.pixels.gdal import gdal_version

        yield f"gdal {gdal_version()}"
        from agalign.method.device import devices

        for device in devices():
            threads = f", {device.threads} threads" if device.threads else ""
            problem = f"; cannot be used: {device.problem}" if device.problem else ""
            yield f"device {device.name}: {device.what}{threads}{problem}"
    except (ImportError, OSError, RuntimeError) as error:
        problem, *_ = f"{error}".splitlines() or [type(error).__name__]
        yield f"device unknown: {problem}"
