from dataclasses import replace

import numpy as np
import pytest

from agalign import geometry
from agalign.check import is_as_it_was, verdict
from agalign.config import CheckSettings
from agalign.records import JointResult, Residual, Seed

SEED = Seed("rig", np.eye(3), 100.0, 100.0, 5.0)
GOOD_JOINT = JointResult(np.eye(3), 0.1, 0.95, 0.004, 75, (0.5, 1.0), "fast", "homography", 0.05, ((0.07, 0.07),) * 4)
GOOD_RESIDUAL = Residual(np.zeros((50, 2)), np.zeros((50, 2)), 0.05, 0.2, 1.0)
HALF_WRONG = np.vstack([np.zeros((20, 2)), np.full((30, 2), 5.0)])
SIZE = (1280, 960)


def judge(
    joint: JointResult | None = GOOD_JOINT, residual: Residual | None = GOOD_RESIDUAL, trusted: bool = True
) -> tuple[str, str | None]:
    return verdict(SEED, trusted, joint, "no texture", residual, SIZE, CheckSettings())


def test_all_well() -> None:
    assert judge() == ("aligned", None)


@pytest.mark.parametrize(
    ("joint", "residual", "word"),
    [
        (replace(GOOD_JOINT, retrieval=0.1), GOOD_RESIDUAL, "retrieval"),
        (replace(GOOD_JOINT, corner_std_xy_px=((0.1, 0.1), (3.0, 4.0))), GOOD_RESIDUAL, "corners"),
        (replace(GOOD_JOINT, fixed_to_moving=np.diag([-1.0, 1, 1])), GOOD_RESIDUAL, "folds"),
        (
            replace(GOOD_JOINT, fixed_to_moving=np.array([[1, 0, 0], [0, 1, 0], [-7e-4, 0, 1.0]])),
            GOOD_RESIDUAL,
            "folds",
        ),
        (GOOD_JOINT, None, "structure"),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, centres_px=np.zeros((2, 2))), "structure"),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, coverage=0.4), "40%"),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, median_px=2.5), "2.5 px"),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, median_px=float("inf")), "px"),
        (None, GOOD_RESIDUAL, "no texture"),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, shifts_px=HALF_WRONG), "in only 40%"),
        (replace(GOOD_JOINT, retrieval=float("nan")), GOOD_RESIDUAL, "retrieval"),
        (replace(GOOD_JOINT, retrieval=0.3, chance=1 / 16), GOOD_RESIDUAL, "retrieval"),
        (replace(GOOD_JOINT, corner_std_xy_px=((float("nan"), 0.1),) * 4), GOOD_RESIDUAL, "corners"),
    ],
)
def test_any_doubt_is_enough(joint: JointResult | None, residual: Residual | None, word: str) -> None:
    status, reason = judge(joint, residual)
    assert status == "seed_only"
    assert reason is not None
    assert word in reason
    assert "rig seed" in reason
    assert judge(joint, residual, trusted=False)[0] == "failed"


def test_an_aligned_input_is_left_as_it_is() -> None:
    within = replace(GOOD_JOINT, fixed_to_moving=geometry.translation(0.1, 0.1))
    beyond = replace(GOOD_JOINT, fixed_to_moving=geometry.translation(0.4, 0.1))
    precise = replace(within, corner_std_xy_px=((0.01, 0.0),) * 4)
    assert is_as_it_was(within, np.eye(3), SIZE, CheckSettings())
    assert not is_as_it_was(beyond, np.eye(3), SIZE, CheckSettings())
    assert not is_as_it_was(precise, np.eye(3), SIZE, CheckSettings())
