"""Camera files: their tags, one module per vendor, and the captures below a folder.

The first camera that recognises a file reads it; `generic` recognises every file.
"""

from agalign.cameras.base import Camera, default_reference, other_rig_seed, rig_seed
from agalign.cameras.dji import Dji
from agalign.cameras.generic import Generic
from agalign.cameras.mapir import Mapir
from agalign.cameras.metadata import Tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.parrot import Sequoia
from agalign.cameras.sentera import Sentera

__all__ = ["Camera", "camera_of", "default_reference", "known_cameras", "other_rig_seed", "rig_seed"]


def known_cameras(pattern: str | None = None) -> tuple[Camera, ...]:
    """Return the cameras in the order in which they are tried, `generic` last. With a `pattern` of file names only
    `generic`.
    """
    return (Generic(pattern),) if pattern else (MicaSense(), Dji(), Sequoia(), Sentera(), Mapir(), Generic())


def camera_of(tags: Tags) -> Camera:
    """Return the camera that wrote the tags of a file."""
    return next(camera for camera in known_cameras() if camera.recognises(tags))
