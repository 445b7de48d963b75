"""Discouraged phrases are counted in all text of the project, names included: each has a plainer or more usual one."""

import re
from pathlib import Path

import pytest

from .blocks import PAGES, ROOT

THINGS = (
    "command|fault|file|folder|image|index|letter|limit|list|mistake|model|name|option|reflectance|regular|run|sidecar|"
    "table|toml"
)
DISCOURAGED = re.compile(
    rf"""\b(?:
    beside | whom | whose | thereof | whereby | of[ ]which | lies | lay | lays | laid | lain | told | tells | foretells?
    | fell[ ]short | shortfall | so[ ]many[ ]times | as[ ]it[ ]stands | want[ ]of | bears | nobody | or[ ]not[ ]at[ ]all
    | stands[ ](?:in|on|for|there|beside|above|against) | what[ ]to[ ]try | what[ ]is[ ]left | error[ ]bars? | vouch\w*
    | judged? | believed? | speaks?[ ](?:of|against) | knows?[ ](?:of|nothing|no|where|what) | (?:to|can)[ ]be[ ]had
    | (?:gives?|given)[ ]up | goes[ ]on | worked[ ]out | anew | turned[ ]by | known[ ]to[ ]\d | nothing[ ](?:of|but)
    | says?[ ](?:of|that|so|what|where|which|who) | is[ ]no[ ](?:{THINGS}) | for[ ]ever | without[ ]a[ ]word
    )\b""",
    re.IGNORECASE | re.VERBOSE,
)
MAX_IN_DOCUMENTS = 2
MAX_IN_CODE = {"agalign": 26, "benchmarks": 0, "qgis": 0, "recipe": 0, "tests": 4, "tools": 0}
SUFFIXES = {".j2", ".js", ".json", ".py", ".sh", ".yaml"}


def count(paths: list[Path]) -> tuple[int, str]:
    found: dict[str, int] = {}
    for path in paths:
        for phrase in DISCOURAGED.findall(path.read_text(encoding="utf-8").replace("_", " ")):
            where = f"{path.relative_to(ROOT)}: {phrase.lower()}"
            found[where] = found.get(where, 0) + 1
    return sum(found.values()), "\n".join(f"{number} {where}" for where, number in found.items())


def test_the_documents_are_in_plain_terms() -> None:
    examples = sorted(path for path in (ROOT / "examples").iterdir() if path.is_file())
    total, where = count([*PAGES, ROOT / "CHANGELOG.md", ROOT / "docs" / "api.rst", *examples])
    assert total <= MAX_IN_DOCUMENTS, f"{total} discouraged phrases:\n{where}"


@pytest.mark.parametrize("folder", MAX_IN_CODE)
def test_code_is_in_plain_terms(folder: str) -> None:
    """Comments, docstrings and names."""
    paths = [p for p in sorted((ROOT / folder).rglob("*")) if p.suffix in SUFFIXES and p != Path(__file__)]
    assert paths
    total, where = count(paths)
    assert total <= MAX_IN_CODE[folder], f"{total} discouraged phrases:\n{where}"
