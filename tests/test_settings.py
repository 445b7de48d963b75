"""What a user may choose, and what is refused."""

from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from agalign.batch import RunOptions
from agalign.cameras.discover import DiscoverOptions
from agalign.cli.main import COMMANDS
from agalign.config import JointSettings, Settings

ROOT = Path(__file__).parent.parent


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


def documented() -> dict[str, dict[str, str]]:
    """{title: {Python name: default}} of the tables in docs/options.md."""
    tables: dict[str, dict[str, str]] = {}
    for section in (ROOT / "docs" / "options.md").read_text(encoding="utf-8").split("\n## ")[1:]:
        rows = [[c.strip() for c in line.split("|")] for line in section.splitlines() if line.startswith("| `--")]
        names = {row[2].partition(" ")[0].strip("`"): row[4].strip("`") for row in rows if row[4]}
        tables[section.partition("\n")[0]] = names
    return tables


def test_documented_settings_have_the_documented_defaults() -> None:
    tables = documented()
    owners = {"Settings": Settings(), "DiscoverOptions": DiscoverOptions(), "RunOptions": RunOptions()}
    assert len(tables) == len(owners)
    for title, names in tables.items():
        (owner,) = (o for name, o in owners.items() if f"`{name}`" in title)
        assert len(names) > 5
        for name, default in names.items():
            assert str(attrgetter(name)(owner)) == default, name


def test_every_setting_is_documented() -> None:
    names = {name for table in documented().values() for name in table}
    stages = {stage: type(value) for stage, value in vars(Settings()).items()}
    settings = {f"{stage}.{name}" for stage, fields in stages.items() for name in fields.model_fields}
    settings.remove("flight.start")  # the fingerprint of a given model: set by the run
    assert settings == {name for name in names if "." in name}
    assert 15 < len(settings) <= 30


def test_options_are_documented_under_the_names_of_the_command_line() -> None:
    text = (ROOT / "docs" / "options.md").read_text(encoding="utf-8")
    options = {o for p in COMMANDS["align"].built("align").params for o in p.opts if o.startswith("--")}
    assert {o for o in options if f"`{o}`" not in text} == {"--out"}
