"""The cameras that agalign knows. The first that recognises a file has it, and `generic` takes the rest."""

from agalign.cameras.base import Camera
from agalign.cameras.dji import Dji
from agalign.cameras.generic import Generic
from agalign.cameras.mapir import Mapir
from agalign.cameras.metadata import Tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.parrot import Sequoia
from agalign.cameras.sentera import Sentera


def known_cameras(pattern: str | None = None) -> tuple[Camera, ...]:
    """The cameras in the order they are asked. With a `pattern` the names of files decide, not their tags."""
    return (Generic(pattern),) if pattern else (MicaSense(), Dji(), Sequoia(), Sentera(), Mapir(), Generic())


def camera_of(tags: Tags) -> Camera:
    """The camera that wrote a file's tags."""
    return next(camera for camera in known_cameras() if camera.recognises(tags))
