"""Values of options, settings, results and files."""

from typing import Literal

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
ExportProgram = Literal["odm", "metashape", "pix4d", "micasense", "opencv"]
