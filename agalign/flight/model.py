"""The learned model of a flight (network, mappings and rig) and its file.

One network, trained on a few captures of a flight, describes the bands of all of them (the paper proposes this as
future work).
"""

import hashlib
import json
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save

from agalign._version import __version__
from agalign.errors import InputError, is_out_of_memory
from agalign.flight.groups import FlightCamera
from agalign.flight.rig import Rig
from agalign.flight.rig_file import camera_in, rig_from_json, rig_to_json
from agalign.host.files import complete_file, open_regular
from agalign.host.text import shortened
from agalign.method.descriptor import Descriptor
from agalign.values.geometry import Matrix, normalised

_FORMAT, _FORMER_FORMAT = "agalign-model/2", "agalign-model/1"
"""The former one had the lengths of a rig in px of each band."""


@dataclass(frozen=True)
class FlightModel:
    """A learned network, the mappings of the bands and the rig of one camera."""

    net: Descriptor
    camera: FlightCamera | None
    """`groups.flight_camera` of the captures; None if it was learned on pairs of several cameras."""
    bands: tuple[str, ...]
    """Names of the moving bands, in the order of the network's sides from 1."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving of each band that passed held-out retrieval, undistorted px of the files: the mean of the rig if
    there is one, else the median."""
    fingerprint: str
    """Hash of the captures and settings from which it was learned."""
    rig: Rig | None = None
    """Geometry of the camera; None if too few captures determine it."""
    folder: str = ""
    """Folder of the flight, relative to its input folder."""
    captured_at: tuple[str, ...] = ()
    """Times of the first and the last capture of the flight, ISO 8601; empty if they are unknown."""

    def side(self, band: str) -> int | None:
        """Return the network's side of a moving band; None for an unknown band."""
        return self.bands.index(band) + 1 if band in self.bands else None


def save_model(model: FlightModel, path: Path) -> None:
    """Write a model atomically; equal models have equal bytes. Raises OutputError."""
    tensors = {f"theta.{k}": v.detach().cpu().contiguous() for k, v in model.net.state_dict().items()}
    tensors |= {f"mapping.{k}": torch.tensor(m) for k, m in model.mappings.items()}
    if model.rig is not None:
        tensors |= {f"field.{k}": torch.tensor(f.displacements_px).contiguous() for k, f in model.rig.fields.items()}
    facts = {
        "format": _FORMAT,
        "agalign": __version__,
        "camera": "" if model.camera is None else model.camera.name,
        "camera_bands": "" if model.camera is None else json.dumps(model.camera.bands),
        "bands": json.dumps(model.bands),
        "sharing": model.net.sharing,
        "channels": json.dumps(model.net.channels),
        "fingerprint": model.fingerprint,
        "rig": "" if model.rig is None else rig_to_json(model.rig),
        "folder": model.folder,
        "captured_at": json.dumps(model.captured_at),
    }
    contents = _with_sorted_header(save(tensors, facts | {"digest": _digest(tensors, facts)}))
    with complete_file(path) as partial:
        partial.write_bytes(contents)


def load_model(path: Path, device: Callable[[], torch.device]) -> FlightModel:
    """Read a model and move its network to `device()`. Raises InputError if the file is damaged or not a model."""
    try:
        model = _read_model(path)
    except InputError:
        raise
    except Exception as error:  # damaged files raise errors of many classes
        if is_out_of_memory(error):
            raise MemoryError(str(error)) from None
        text = error.strerror if isinstance(error, OSError) else str(error)
        reason = shortened(next(iter((text or "").splitlines()), type(error).__name__))
        raise InputError(
            f"{path}: cannot be read as a model ({reason}); give a file of an earlier run's models folder"
        ) from None
    return replace(model, net=model.net.to(device()))


def _read_model(path: Path) -> FlightModel:
    facts, tensors = _read_contents(path)
    channels = [int(c) for c in json.loads(facts["channels"])]
    max_count = 512  # of sides, and of channels of a side: far above those of a model, so the file is damaged
    if not 1 < len(channels) <= max_count or not all(0 < c <= max_count for c in channels):
        raise ValueError(f"invalid numbers of channels: {channels[:8]}")
    net = Descriptor(facts["sharing"], channels, half_rectified=True, unit_length=True)
    net.load_state_dict(_with_prefix("theta.", tensors))
    fields = {band: values.numpy() for band, values in _with_prefix("field.", tensors).items()}
    return FlightModel(
        net,
        camera=camera_in(facts),
        bands=tuple(map(str, json.loads(facts["bands"]))),
        mappings={band: normalised(matrix.numpy()) for band, matrix in _with_prefix("mapping.", tensors).items()},
        fingerprint=facts["fingerprint"],
        rig=rig_from_json(facts["rig"], fields) if facts.get("rig") else None,
        folder=shortened(facts.get("folder", "")),
        captured_at=tuple(shortened(str(time)) for time in json.loads(facts.get("captured_at", "[]"))),
    )


def _read_contents(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the metadata and the tensors of a file after checking its size, format, checksum and values."""
    max_mib = 256  # far above the size of a model: larger files are other files
    max_value = 1e6  # weights are below 100 and mappings are in px
    with open_regular(path) as opened:
        if os.fstat(opened.fileno()).st_size > max_mib << 20:
            raise ValueError(f"it is larger than {max_mib} MiB")
    with safe_open(path, framework="pt") as file:
        facts = dict(file.metadata() or {})
        if facts.get("format") == _FORMER_FORMAT:
            raise ValueError("an earlier version wrote it; learn it again")
        if facts.get("format") != _FORMAT:
            raise InputError(f"{path}: is not a model of agalign; give a file of an earlier run's models folder")
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    digest = facts.pop("digest", None)
    if digest is None:
        raise ValueError("it has no checksum")
    if digest != _digest(tensors, facts):
        raise ValueError("it is damaged")
    if not all((t.abs() <= max_value).all() for t in tensors.values()):  # also False for NaN
        raise ValueError(f"it has values that are NaN or above {max_value:.0e}")
    return facts, tensors


def _with_prefix(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Select the tensors with a prefix, which is removed from their names."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


def _digest(tensors: Mapping[str, torch.Tensor], facts: Mapping[str, str]) -> str:
    """Return the checksum of the contents; the format of safetensors has none."""
    result = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        result.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        result.update(tensor.contiguous().numpy().tobytes())
    return result.hexdigest()


def _with_sorted_header(contents: bytes) -> bytes:
    """Sort the names in the header of a safetensors file; the library writes the metadata in random order."""
    (length,) = struct.unpack_from("<Q", contents)
    header = json.dumps(json.loads(contents[8 : 8 + length]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + contents[8 + length :]
