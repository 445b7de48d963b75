"""What the files of a folder say: tags, one module a vendor, and captures found by them."""

from agalign.cameras.base import Camera, default_reference, other_rig_seed, rig_seed
from agalign.cameras.known import camera_of, known_cameras

__all__ = ["Camera", "camera_of", "default_reference", "known_cameras", "other_rig_seed", "rig_seed"]
