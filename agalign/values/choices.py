"""Values of options, settings, results and files."""

from enum import IntFlag
from typing import Literal

MAX_JOBS = 4096
"""Maximum number of processes."""
MAX_RNG_SEED = 2**63 - 1
MAX_PIXELS = 250_000_000
"""Default limit for one image: more than any camera has."""
MAX_MOSAIC_PIXELS = 20_000_000_000
SeedKind = Literal["user", "match", "model", "rig", "centre", "geo", "structure", "identity"]
"""`centre` is from the optical centres in DJI's tags, `rig` from their calibrated homographies."""
SeedChoice = Literal["auto", "rig", "geo", "structure", "match", "identity"]
Recipe = Literal["fast", "scratch", "paper"]
Sharing = Literal["siamese", "pseudo-siamese", "unshared"]
ModelFamily = Literal["homography", "affine", "translation"]
FamilyChoice = Literal["auto", "homography", "affine", "translation"]
Space = Literal["pixel", "undistorted"]
Geometry = Literal["homography", "field", "relief", "relief and field"]
"""What a mapping has in addition to the lens models of the tags: nothing, a displacement field, a relief, or both."""
PairStatus = Literal["reference", "aligned", "predicted", "seed_only", "failed"]
PredictionSource = Literal["bands", "neighbours", "flight", "windows"]
CaptureStatus = Literal["ok", "degraded", "failed"]

BandOrder = Literal["index", "wavelength", "name"]
Interpolation = Literal["nearest", "bilinear", "cubic", "lanczos"]
Crop = Literal["flight", "common", "none"]
ReliefUse = Literal["auto", "always", "never"]
RadiometryChoice = Literal["off", "auto", "camera", "sun", "panel"]
Layout = Literal["stack", "bands", "both"]
Resolution = Literal["reference", "finest"]
RasterFormat = Literal["gtiff", "cog"]
Compression = Literal["auto", "zstd", "deflate", "none"]
ExportProgram = Literal["odm", "metashape", "pix4d"]


class Quality(IntFlag):
    """Limitations of a pixel in the quality raster; each flag is one bit."""

    OUTSIDE = 1
    """Outside the image of the band."""
    NODATA = 2
    """The band's file has no value there."""
    SATURATED = 4
    """A source pixel under the interpolation kernel is at or above the saturation value, or the correction of the
    vignetting of a raw number exceeded its type."""
    OCCLUDED = 8
    """Nearer parts of the scene occlude it in the band; the value is nodata, or interpolated."""
    PREDICTED = 16
    """The band is predicted: its image does not verify the whole mapping, or its geometry differs from the others."""
    ERROR_OVER_HALF_PX = 32
    """The expected error exceeds 0.5 px of the reference, or is unknown."""
    ERROR_OVER_1_PX = 64
    """The expected error exceeds 1 px of the reference, or is unknown."""
    MISSING = 256  # 128 is not used: other programs read these values
    """The band could not be aligned and has no pixels."""
    MOVED = 512
    """The band shows something that moved between the exposures, or is near the camera: it contradicts the mapping."""


QUALITY_MEANINGS = " ".join(str(flag.name).lower() for flag in Quality)
"""Names of the flags from the lowest bit, in the format of `flag_meanings` of the CF conventions."""
UNUSABLE_QUALITY = Quality(sum(Quality)) & ~(Quality.PREDICTED | Quality.ERROR_OVER_HALF_PX)
"""Flags of pixels that `agalign indices --mask-qa` masks."""
