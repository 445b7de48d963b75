"""What a user may choose, and what is refused."""

from typing import Any

import pytest
from pydantic import ValidationError

from agalign.config import JointSettings, Settings


@pytest.mark.parametrize(
    "wrong",
    [
        {"recipe": "slow"},
        {"sharing": "none"},
        {"model_family": "similarity"},
        {"rng_seed": -1},
        {"rng_seed": 2**63},
        {"rng_seed": 0.5},
        {"device": 1},
        {"fast": {}},
        {"longest_side_px": 4096},
    ],
)
def test_one_error_names_the_setting_that_is_wrong(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError) as raised:
        Settings.model_validate({"joint": wrong})
    (error,) = raised.value.errors()
    assert error["loc"] == ("joint", *wrong)


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        JointSettings().rng_seed = 1  # type: ignore[misc]
