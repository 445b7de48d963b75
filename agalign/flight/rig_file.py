"""The rig that a model's file knows, read without its network: what tells of a run needs no torch."""

from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

from agalign.errors import InputError
from agalign.flight.rig import Rig
from agalign.values.geometry import apply


def read_rig(path: Path) -> tuple[str, Rig | None]:
    """(camera, its rig, None where too few captures said something of it). Raises InputError, naming the file."""
    try:
        with safe_open(path, framework="np") as file:
            facts = dict(file.metadata() or {})
            names = [n for n in file.keys() if n.startswith("field.")]  # noqa: SIM118
            fields = {n.removeprefix("field."): np.asarray(file.get_tensor(n)) for n in names}
        rig = Rig.from_json(facts["rig"], fields) if facts.get("rig") else None
        return str(facts.get("camera", "")), rig
    except Exception as error:  # of a damaged file anything may be wrong
        said = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(f"{path}: its rig cannot be read ({said})") from None


def rig_rows(rig: Rig) -> list[dict[str, Any]]:
    """A band each: where its middle lies in the moving image, how it moves, and how well it is predicted, px."""
    middle = (np.array(rig.size_px, float) - 1) / 2
    return [
        {
            "band": band, "offset_px": (apply(mean, middle[None])[0] - middle).tolist(),
            "baseline": rig.baselines[band], "from_bands_px": rig.from_bands_px[band],
            "from_neighbours_px": rig.missed_px(band, by_neighbours=True),
            "from_flight_px": rig.missed_px(band, by_neighbours=False),
            "field_px": float(np.hypot(*np.moveaxis(rig.fields[band].displacements_px, -1, 0)).max())
            if band in rig.fields else None,
        }
        for band, mean in rig.mean.items()
    ]  # fmt: skip
