"""What libtiff prints past all handlers is kept back, and nothing else is."""

import os
import threading

import pytest

from agalign.products.quiet_libtiff import without_libtiff_messages


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


def test_two_threads_do_not_take_the_descriptor_from_each_other(capfd: pytest.CaptureFixture[str]) -> None:
    inside, done = threading.Event(), threading.Event()

    def writes() -> None:
        with without_libtiff_messages():
            inside.set()
            done.wait(10)

    thread = threading.Thread(target=writes)
    thread.start()
    inside.wait(10)
    with without_libtiff_messages():
        os.write(2, b"kept\n")
    done.set()
    thread.join()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "kept\nafter\n"
