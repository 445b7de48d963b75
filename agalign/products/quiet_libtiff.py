"""libtiff prints some errors of a full disk itself, past GDAL's error handlers, to file descriptor 2."""

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_OF_LIBTIFF = re.compile(rb"^_?(?:tiff|TIFF)\w+: .*\n?", re.MULTILINE)
_MAX_BYTES = 1 << 16
"""What a pipe holds: more is not printed."""
_ONE_AT_A_TIME = threading.Lock()


@contextmanager
def without_libtiffs_lines() -> Iterator[None]:
    """Nothing that libtiff prints inside reaches standard error; what others print there follows at the end.

    The writer finds out by itself that a file is not complete, and one line then names it.
    """
    if not _ONE_AT_A_TIME.acquire(blocking=False):
        yield  # a thread that writes at the same time has taken the descriptor
        return
    try:
        read_end, write_end = os.pipe()
        os.set_blocking(read_end, False)
        os.set_blocking(write_end, False)
        kept = os.dup(2)
        os.dup2(write_end, 2)
        os.close(write_end)
        try:
            yield
        finally:
            os.dup2(kept, 2)  # the pipe's last write end is closed by it
            os.close(kept)
            printed = b""
            with suppress(BlockingIOError):  # a process that was started meanwhile has a write end too
                printed = os.read(read_end, _MAX_BYTES)
            os.close(read_end)
            with suppress(OSError):
                os.write(2, _OF_LIBTIFF.sub(b"", printed))
    finally:
        _ONE_AT_A_TIME.release()
