"""What libtiff prints past all handlers is kept back, and nothing else is."""

import os
import threading
import time

import pytest

from agalign.products.checked_raster import without_libtiff_messages


def test_only_the_lines_of_libtiff_are_kept_back(capfd: pytest.CaptureFixture[str]) -> None:
    with without_libtiff_messages():
        os.write(2, b"_tiffWriteProc: No space left on device.\nkept\nTIFFAppendToStrip: Write error.\n")
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "kept\nafter\n"


def test_an_error_inside_gives_the_descriptor_back(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OSError, match="full"), without_libtiff_messages():
        raise OSError("full")
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"


def test_the_lines_of_two_threads_are_kept_back(capfd: pytest.CaptureFixture[str]) -> None:
    first_is_inside = threading.Event()

    def first() -> None:
        with without_libtiff_messages():
            first_is_inside.set()
            time.sleep(0.2)  # the second thread tries to enter
            os.write(2, b"_tiffWriteProc: File too large.\nkept\n")

    def second() -> None:
        first_is_inside.wait(10)
        with without_libtiff_messages(), without_libtiff_messages():
            time.sleep(0.4)  # the first thread has left
            os.write(2, b"_tiffWriteProc: File too large.\nalso kept\n")

    threads = [threading.Thread(target=each) for each in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "kept\nalso kept\nafter\n"
