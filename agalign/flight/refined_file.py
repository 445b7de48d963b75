"""The refined mappings of the captures from which a flight was learned, as JSON."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from agalign.values.alignment import JointResult, RefinedPair, Seed
from agalign.values.geometry import normalised
from agalign.values.pixel_units import FixedImagePx


def refined_to_json(refined: Mapping[str, Mapping[str, RefinedPair]]) -> str:
    """Serialise refined mappings by capture and band; numbers are read again exactly."""
    return json.dumps(
        {key: {band: _facts(pair) for band, pair in pairs.items()} for key, pairs in refined.items()}, sort_keys=True
    )


def refined_from_json(text: str) -> dict[str, dict[str, RefinedPair]]:
    """Deserialise refined mappings. Raises AttributeError, KeyError, TypeError or ValueError for damaged text."""
    return {key: {band: _pair(facts) for band, facts in of.items()} for key, of in json.loads(text).items()}


def _facts(pair: RefinedPair) -> dict[str, Any]:
    result = {k: v for k, v in vars(pair.result).items() if k != "loss"}  # NaN with a frozen network
    covariance = pair.result.corner_covariance_px2
    result["fixed_to_moving"] = pair.result.fixed_to_moving.tolist()
    result["corner_covariance_px2"] = None if covariance is None else covariance.tolist()
    seed = vars(pair.seed) | {"fixed_to_moving": pair.seed.fixed_to_moving.tolist()}
    return {"seed": seed, "result": result, "sizes_px": pair.sizes_px}


def _pair(facts: Mapping[str, Any]) -> RefinedPair:
    seed, result = dict(facts["seed"]), dict(facts["result"])
    covariance = result.pop("corner_covariance_px2")
    (fixed_width, fixed_height), (moving_width, moving_height) = facts["sizes_px"]
    return RefinedPair(
        Seed(fixed_to_moving=normalised(np.array(seed.pop("fixed_to_moving"))), **seed),
        JointResult[FixedImagePx](
            fixed_to_moving=normalised(np.array(result.pop("fixed_to_moving"))), loss=math.nan,
            levels=tuple(result.pop("levels")),
            corner_std_xy_px=tuple((x, y) for x, y in result.pop("corner_std_xy_px")),
            corner_covariance_px2=None if covariance is None else np.array(covariance), **result,
        ),
        ((fixed_width, fixed_height), (moving_width, moving_height)),
    )  # fmt: skip
