"""The flags of the quality raster."""

from enum import IntFlag


class Quality(IntFlag):
    """Limitations of a pixel; each flag is one bit."""

    OUTSIDE = 1
    """Outside the image of the band."""
    NODATA = 2
    """The band's file has no value there."""
    SATURATED = 4
    """A source pixel is at or above the saturation value."""
    OCCLUDED = 8
    """Nearer parts of the scene occlude it in the band; the value is nodata, or interpolated."""
    PREDICTED = 16
    """The band is not verified by its own image, but predicted."""
    ERROR_OVER_HALF_PX = 32
    """The expected error exceeds 0.5 px of the reference, or is unknown."""
    ERROR_OVER_1_PX = 64
    """The expected error exceeds 1 px of the reference, or is unknown."""
    SUN_GLINT = 128
    """More than half of the green light is sun glint on water."""
    MISSING = 256
    """The band could not be aligned and has no pixels."""


MEANINGS = " ".join(str(flag.name).lower() for flag in Quality)
"""Names of the flags from the lowest bit, in the format of `flag_meanings` of the CF conventions."""
UNUSABLE = Quality(sum(Quality)) & ~(Quality.PREDICTED | Quality.ERROR_OVER_HALF_PX)
"""Flags of pixels that `agalign indices --mask-qa` masks."""
