"""The mark by which a command recognises the files that an earlier one wrote, whatever their names."""

import os
import re
from contextlib import suppress
from pathlib import Path

from agalign.host.files import open_regular

SOFTWARE = "agalign"
"""Value of the tag Software of every raster."""
PNG_MARK = b"Software\0" + SOFTWARE.encode()
"""Text chunk of every PNG file: keyword and text."""
JPEG_MARK = b"\xff\xfe" + (2 + len(SOFTWARE)).to_bytes(2) + SOFTWARE.encode()
"""Comment of every JPEG file, with its marker and length."""
_POSITIONS = "reference_x_px", "reference_y_px", "moving_x_px", "moving_y_px"
TIES_COLUMNS = "band", "status", *_POSITIONS, "residual_px", "weight"
"""Columns of tables of tie points."""
TIES_MEMBER = "coordinates_in"
"""First member of tie points as GeoJSON, which has none of this name."""
_TIFF_MARK = rb'(?<![ -~])%b\0|<Item name="REFERENCE_BAND">' % SOFTWARE.encode()
"""The tag Software, not the end of a longer text; that of GDAL's metadata in files of single bands, which keep the
camera's software."""
_MARKS = {
    b"II": _TIFF_MARK,
    b"MM": _TIFF_MARK,
    b"\x89P": re.escape(PNG_MARK),
    b"\xff\xd8": re.escape(JPEG_MARK),
    b"ba": re.escape(",".join(TIES_COLUMNS).encode()),
    b'{"': re.escape(f'{{"type": "FeatureCollection", "{TIES_MEMBER}"'.encode()),
}
"""Patterns of marks by the first two bytes of a file: TIFF in both orders of bytes, PNG, JPEG, CSV, GeoJSON."""
_SEARCHED_BYTES = 1 << 16
"""The mark is near the start of a file, or near its end in a TIFF to which tags were added."""


def is_own_file(path: Path) -> bool:
    """Return True for an output of agalign other than JSON records, and for an empty file, which holds nothing."""
    with suppress(OSError):
        return not path.stat().st_size or has_mark(path)
    return False


def has_mark(path: Path) -> bool:
    """Return True for an output of agalign other than JSON records."""
    with suppress(OSError), open_regular(path) as file:
        start, size = file.read(_SEARCHED_BYTES), file.seek(0, os.SEEK_END)
        file.seek(max(_SEARCHED_BYTES, size - _SEARCHED_BYTES))
        end = file.read()
        mark = _MARKS.get(start[:2])
        return mark is not None and any(re.search(mark, part) for part in (start, end))
    return False
