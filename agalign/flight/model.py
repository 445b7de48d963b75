"""What a flight has learnt, and the file that holds it: one network, and the mappings that it found.

The captures of a flight share their cameras, so what tells the bands' patches apart on a few of them does on all (what
the paper leaves as future work).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from agalign._version import __version__
from agalign.errors import InputError, OutputError
from agalign.flight.rig import Rig
from agalign.method.descriptor import Descriptor
from agalign.method.match import matching_network
from agalign.values.files import complete_file
from agalign.values.geometry import Matrix

_FORMAT = "agalign-model/1"


@dataclass(frozen=True)
class FlightModel:
    """A learnt network and the mappings that it found, for one camera."""

    net: Descriptor
    camera: str
    """As `groups.camera_key` has it; empty for one that was learnt on pairs of any cameras."""
    bands: tuple[str, ...]
    """Names of the moving bands; the network's side of one is its place here, counted from 1."""
    mappings: Mapping[str, Matrix]
    """Median fixed_to_moving of the bands whose held-out patches were told apart, undistorted px of the files."""
    fingerprint: str
    """Of what it was learnt from, and how."""
    rig: Rig | None = None
    """What the flight knows of the camera's geometry; None where too few captures said something of it."""

    def side(self, band: str) -> int | None:
        """The network's side for a moving band; None where it knows none of that name."""
        return self.bands.index(band) + 1 if band in self.bands else None

    def matching_network(self, band: str, channels: tuple[int, int]) -> Descriptor:
        """A network that matches the reference with a moving band, images of these channels."""
        return matching_network(self.net, self.side(band) or 1, channels)


def save_model(model: FlightModel, path: Path) -> None:
    """Write a model, complete or not at all. Raises OutputError."""
    tensors = {f"theta.{k}": v.detach().cpu().contiguous() for k, v in model.net.state_dict().items()}
    tensors |= {f"mapping.{k}": torch.tensor(m) for k, m in model.mappings.items()}
    if model.rig is not None:
        tensors |= {f"field.{k}": torch.tensor(f.displacements_px).contiguous() for k, f in model.rig.fields.items()}
    facts = {
        "format": _FORMAT, "agalign": __version__, "camera": model.camera, "bands": json.dumps(model.bands),
        "sharing": model.net.sharing, "channels": json.dumps(model.net.channels), "fingerprint": model.fingerprint,
        "rig": "" if model.rig is None else model.rig.as_json(),
    }  # fmt: skip
    try:
        with complete_file(path) as partial:
            save_file(tensors, partial, facts)
    except SafetensorError as error:
        raise OutputError(f"{path}: cannot be written ({error})") from None


def load_model(path: Path, device: Callable[[], torch.device]) -> FlightModel:
    """Raises InputError, naming the file, where it is not a model of this program."""
    try:
        with safe_open(path, framework="pt") as file:
            facts = file.metadata() or {}
            if facts.get("format") != _FORMAT:
                raise InputError(f"{path}: is no model of agalign; give a file of an earlier run's models folder")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        bands = tuple(json.loads(facts["bands"]))
        channels = json.loads(facts["channels"])
        net = Descriptor(facts["sharing"], channels, half_rectified=True, unit_length=True)
        net.load_state_dict({k.removeprefix("theta."): v for k, v in tensors.items() if k.startswith("theta.")})
        net.learnt = True
        fields = {k.removeprefix("field."): v.numpy() for k, v in tensors.items() if k.startswith("field.")}
        rig = Rig.from_json(facts["rig"], fields) if facts.get("rig") else None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as a model ({str(error).splitlines()[0]})") from None
    mappings = {k.removeprefix("mapping."): v.numpy() for k, v in tensors.items() if k.startswith("mapping.")}
    return FlightModel(net.to(device()), facts["camera"], bands, mappings, facts["fingerprint"], rig)
