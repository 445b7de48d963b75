"""The rig as JSON, and reading it from a model file without torch, as reports of a run require."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from agalign.errors import InputError
from agalign.flight.rig import CaptureFactors, Rig
from agalign.values.displacement import DisplacementField
from agalign.values.files import open_regular


def rig_to_json(rig: Rig) -> str:
    """Serialise a rig without the values of its displacement fields."""
    facts = {k: v for k, v in vars(rig).items() if k not in ("mean", "fields", "captures")}
    facts["mean"] = {b: m.tolist() for b, m in rig.mean.items()}
    facts["seen"] = [vars(c) for c in rig.captures]
    return json.dumps(facts | {"field_steps_px": {b: f.step_px for b, f in rig.fields.items()}})


def rig_from_json(text: str, fields: Mapping[str, NDArray[np.float64]]) -> Rig:
    """Deserialise a rig; `fields` are the values (rows, columns, 2) of the displacement fields by band.

    Raises KeyError, TypeError or ValueError for damaged text.
    """
    facts = json.loads(text)
    steps = facts.pop("field_steps_px")
    width, height = facts.pop("size_px")
    return Rig(
        size_px=(int(width), int(height)), mean={b: np.array(m) for b, m in facts.pop("mean").items()},
        baselines={b: (x, y) for b, (x, y) in facts.pop("baselines").items()},
        factors=tuple(facts.pop("factors")),
        captures=tuple(_capture_factors(c) for c in facts.pop("seen")),
        fields={b: DisplacementField(steps[b], values) for b, values in fields.items()}, **facts,
    )  # fmt: skip


def read_rig(path: Path) -> tuple[str, Rig | None]:
    """Return the camera and the rig of a model file, or None for a model without a rig. Raises InputError."""
    try:
        open_regular(path).close()
        with safe_open(path, framework="np") as file:
            facts = dict(file.metadata() or {})
            names = [n for n in file.keys() if n.startswith("field.")]  # noqa: SIM118
            fields = {n.removeprefix("field."): np.asarray(file.get_tensor(n)) for n in names}
        rig = rig_from_json(facts["rig"], fields) if facts.get("rig") else None
        return str(facts.get("camera", "")), rig
    except Exception as error:  # damaged files raise errors of many classes
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(f"{path}: its rig cannot be read ({reason})") from None


def _capture_factors(facts: Mapping[str, Any]) -> CaptureFactors:
    motion = facts["motion"]
    return CaptureFactors(
        facts["seconds"], facts["altitude_m"], None if motion is None else (motion[0], motion[1]),
        tuple(facts["factors"]),
    )  # fmt: skip
