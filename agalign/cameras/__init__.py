"""One module a vendor; the first that recognises a file has it, and `generic` takes the rest."""

from agalign.cameras.base import Camera, default_reference
from agalign.cameras.generic import Generic
from agalign.cameras.micasense import MicaSense
from agalign.geometry import Matrix
from agalign.records import Band

__all__ = ["Camera", "default_reference", "known_cameras", "rig_seed"]


def known_cameras(pattern: str | None = None) -> tuple[Camera, ...]:
    """The cameras in the order they are asked. With a `pattern` the names of files decide, not their tags."""
    return (Generic(pattern),) if pattern else (MicaSense(), Generic())


def rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """The first camera's answer that has one: bands carry their rig's data themselves."""
    for camera in known_cameras():
        found = camera.rig_seed(reference, moving)
        if found is not None:
            return found
    return None
