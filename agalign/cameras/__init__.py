"""One module a vendor; the first that recognises a file has it, and `generic` takes the rest."""

from agalign.cameras.base import Camera, default_reference, rig_seed
from agalign.cameras.dji import Dji
from agalign.cameras.generic import Generic
from agalign.cameras.mapir import Mapir
from agalign.cameras.micasense import MicaSense
from agalign.cameras.parrot import Sequoia
from agalign.cameras.sentera import Sentera

__all__ = ["Camera", "default_reference", "known_cameras", "rig_seed"]


def known_cameras(pattern: str | None = None) -> tuple[Camera, ...]:
    """The cameras in the order they are asked. With a `pattern` the names of files decide, not their tags."""
    return (Generic(pattern),) if pattern else (MicaSense(), Dji(), Sequoia(), Sentera(), Mapir(), Generic())
