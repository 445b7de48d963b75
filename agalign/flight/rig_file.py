"""The rig of a model file as JSON, which can be read without torch, as reports require."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from agalign.errors import InputError
from agalign.flight.groups import FlightCamera
from agalign.flight.rig import CaptureFactors, Rig
from agalign.host.files import open_regular
from agalign.host.text import shortened
from agalign.values.geometry import normalised
from agalign.values.mapping import DisplacementField

_MAX_SIDE_PX, _MAX_FIELD_PX, _MAX_NUMBER = 100_000, 1e4, 1e12
"""Limits of the sizes, of the displacements, and of all numbers of a rig; times are the largest."""


def rig_to_json(rig: Rig) -> str:
    """Serialise a rig without the values of its displacement fields."""
    facts = {k: v for k, v in vars(rig).items() if k != "fields"}
    return json.dumps(facts | {"field_steps_px": {b: f.step_px for b, f in rig.fields.items()}}, default=_plain)


def rig_from_json(text: str, fields: Mapping[str, NDArray[np.float64]]) -> Rig:
    """Deserialise a rig; `fields` are the values (rows, columns, 2) of the displacement fields by band.

    Raises KeyError, TypeError, ValueError or GeometryError for damaged text, and for values that no rig has.
    """
    facts = json.loads(text, parse_float=_bounded, parse_int=_bounded, parse_constant=_bounded)
    steps = facts.pop("field_steps_px")
    width, height = facts.pop("size_px")
    if not all(float(n).is_integer() and 0 < n <= _MAX_SIDE_PX for n in (width, height)):
        raise ValueError(f"the size of its images is {width:g} x {height:g}")
    facts["mean"] = {b: normalised(m) for b, m in facts["mean"].items()}
    facts["baselines"] = {b: (x, y) for b, (x, y) in facts["baselines"].items()}
    facts["factors"] = tuple(facts["factors"])
    captures = tuple(
        CaptureFactors(**one | {"motion": one["motion"] and tuple(one["motion"]), "factors": tuple(one["factors"])})
        for one in facts.pop("captures")
    )
    if not all((np.abs(values) <= _MAX_FIELD_PX).all() for values in fields.values()):  # also False for NaN
        raise ValueError("a displacement field has values that are NaN or too large")
    displacements = {b: DisplacementField(steps[b], values) for b, values in fields.items()}
    return Rig(size_px=(int(width), int(height)), captures=captures, fields=displacements, **facts)


def camera_in(facts: Mapping[str, str]) -> FlightCamera | None:
    """Return the camera in the metadata of a model file; None if it was learned for no camera in particular.

    Raises ValueError or TypeError for damaged text.
    """
    if not facts["camera"]:
        return None
    bands = json.loads(facts["camera_bands"])
    return FlightCamera(facts["camera"], tuple((str(name), int(width), int(height)) for name, width, height in bands))


def read_rig(path: Path) -> tuple[FlightCamera | None, Rig | None]:
    """Return the camera and the rig of a model file, or None for a model without a rig. Raises InputError."""
    try:
        open_regular(path).close()
        with safe_open(path, framework="np") as file:
            facts = dict(file.metadata() or {})
            names = [n for n in file.keys() if n.startswith("field.")]  # noqa: SIM118
            fields = {n.removeprefix("field."): np.asarray(file.get_tensor(n)) for n in names}
        rig = rig_from_json(facts["rig"], fields) if facts.get("rig") else None
        return camera_in(facts), rig
    except Exception as error:  # damaged files raise errors of many classes
        raise InputError(f"{path}: its rig cannot be read ({_reason(error)}); delete it and run again") from None


def model_fingerprint(path: Path) -> str:
    """Return the fingerprint of a model file: a hash of the captures and settings from which it was learned. Raises
    InputError.
    """
    try:
        open_regular(path).close()
        with safe_open(path, framework="np") as file:
            return str((file.metadata() or {})["fingerprint"])
    except Exception as error:  # damaged files raise errors of many classes
        raise InputError(f"{path}: cannot be read as a model ({_reason(error)})") from None


def _reason(error: Exception) -> str:
    """Return the first line of an error, without the number and the file of an error of the system."""
    text = getattr(error, "strerror", None) or str(error)
    return shortened(next(iter(text.splitlines()), type(error).__name__))


def _bounded(text: str) -> float:
    number = float(text)
    if not abs(number) <= _MAX_NUMBER:  # also for NaN
        raise ValueError(f"it has the number {text}")
    return number


def _plain(value: Any) -> Any:
    """Arrays as lists and records as their fields, for `json.dumps`."""
    return value.tolist() if isinstance(value, np.ndarray) else vars(value)
