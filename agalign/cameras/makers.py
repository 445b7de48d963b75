"""The makers of cameras: a new one is a module with a subclass of `Camera`, and an entry here.

The first camera that recognises a file reads it; `Generic` recognises every file.
"""

from agalign.cameras.base import Camera
from agalign.cameras.dji import Dji
from agalign.cameras.generic import Generic
from agalign.cameras.mapir import Mapir
from agalign.cameras.metadata import Tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.parrot import Sequoia
from agalign.cameras.sentera import Sentera


def known_cameras(pattern: str | None = None) -> tuple[Camera, ...]:
    """Return the cameras in the order in which they are tried, `generic` last. With a `pattern` of file names only
    `generic`.
    """
    return (Generic(pattern),) if pattern else (MicaSense(), Dji(), Sequoia(), Sentera(), Mapir(), Generic())


def camera_of(tags: Tags) -> Camera:
    """Return the camera that wrote the tags of a file."""
    return next(camera for camera in known_cameras() if camera.recognises(tags))
