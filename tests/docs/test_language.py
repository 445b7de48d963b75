"""Discouraged phrases are counted in all text of the project: for each there is a plainer or more usual one."""

import re
from pathlib import Path

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
MAX_IN_DOCUMENTS = 5
MAX_IN_PACKAGE = 20


def count(paths: list[Path]) -> tuple[int, str]:
    found: dict[str, int] = {}
    for path in paths:
        for phrase in DISCOURAGED.findall(path.read_text(encoding="utf-8")):
            where = f"{path.relative_to(ROOT)}: {phrase.lower()}"
            found[where] = found.get(where, 0) + 1
    return sum(found.values()), "\n".join(f"{number} {where}" for where, number in found.items())


def test_the_documents_are_in_plain_terms() -> None:
    examples = sorted(path for path in (ROOT / "examples").iterdir() if path.is_file())
    total, where = count([*PAGES, ROOT / "CHANGELOG.md", ROOT / "docs" / "api.rst", *examples])
    assert total <= MAX_IN_DOCUMENTS, f"{total} discouraged phrases:\n{where}"


def test_the_package_is_in_plain_terms() -> None:
    """Comments and docstrings included."""
    total, where = count(
        [p for p in sorted((ROOT / "agalign").rglob("*")) if p.suffix in {".py", ".j2", ".js", ".json"}]
    )
    print(f"{total} discouraged phrases in agalign/")
    assert total <= MAX_IN_PACKAGE, f"{total} discouraged phrases:\n{where}"
