"""Suppression of messages that libtiff prints to file descriptor 2 instead of passing them to GDAL's error handler."""

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_LIBTIFF_LINE = re.compile(rb"^_?(?:tiff|TIFF)\w+: .*\n?", re.MULTILINE)
_MAX_BYTES = 1 << 16
"""Capacity of a pipe on Linux: what exceeds it is lost."""
_REDIRECTED = threading.RLock()
"""File descriptor 2 belongs to the process: one thread redirects it, and others wait before they write."""


@contextmanager
def without_libtiff_messages() -> Iterator[None]:
    """Drop what libtiff prints to standard error inside the block, such as for a full disk; other text is printed at
    its end. `checked_raster` detects and reports the incomplete file itself.
    """
    with _REDIRECTED:
        read_end, write_end = os.pipe()
        os.set_blocking(read_end, False)
        os.set_blocking(write_end, False)
        stderr = os.dup(2)
        os.dup2(write_end, 2)
        os.close(write_end)
        try:
            yield
        finally:
            os.dup2(stderr, 2)  # closes the last write end of the pipe in this process
            os.close(stderr)
            printed = b""
            with suppress(BlockingIOError):  # a child process started in the block has the write end open too
                printed = os.read(read_end, _MAX_BYTES)
            os.close(read_end)
            with suppress(OSError):
                os.write(2, _LIBTIFF_LINE.sub(b"", printed))
