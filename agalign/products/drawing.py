"""Drawing text on pictures, and writing them as PNG."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from agalign.errors import OutputError
from agalign.values.files import complete_file

Picture = NDArray[np.uint8]
"""(height, width, 3) red, green, blue."""
_TEXT_COLOUR = 40, 40, 40


def write_png(image: Picture, path: Path) -> None:
    """Write a picture atomically. Raises OutputError."""
    with complete_file(path) as partial:
        encoded, data = cv2.imencode(".png", image[..., ::-1])
        if not encoded:
            raise OutputError(f"{path}: cannot be encoded")
        partial.write_bytes(data.tobytes())


def with_text(
    image: Picture, text: str, at_px: tuple[float, float], size_px: float = 14, anchor: str = "ls"
) -> Picture:
    """Return the picture with a line of text; `anchor` is Pillow's, by default the left end of the baseline."""
    drawn = Image.fromarray(image)
    ImageDraw.Draw(drawn).text(at_px, text, _TEXT_COLOUR, ImageFont.load_default(size_px), anchor)
    return np.asarray(drawn)
