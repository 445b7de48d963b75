"""Write or check the table of the licences of dependencies in docs/licences.md.

    python tools/licences.py           # writes; everything of pyproject.toml must be installed
    python tools/licences.py --check   # exit code 1 where the page lacks a library, or one that is not permissive

The check allows libraries that are not installed, and other spellings of a licence than in the table.
"""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "licences.md"
BEGIN, END = "<!-- licences -->\n", "<!-- end of licences -->\n"
READ = {"atheris": "Apache-2.0", "exifread": "BSD-3-Clause", "odc-stac": "Apache-2.0"}
"""Licences, from the licence file, of packages with missing or inexact metadata."""
SPELT = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "MIT License": "MIT",
    "Python Software Foundation License": "PSF-2.0",
}
"""Names of licences in classifiers, in short."""
NOT_PERMISSIVE = re.compile(r"GPL|General Public|MPL|Mozilla|EUPL|Proprietary|Commercial")
HEAD = "| licence | every run | extras |\n| --- | --- | --- |\n"


def main() -> None:
    """Write the table, or check it."""
    needed = requirements()
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    table, after = rest.split(END)
    if "--check" in sys.argv[1:]:
        problems = check(needed, table)
        print("\n".join(problems) or f"licences: {len(needed)} libraries, as in docs/licences.md")
        sys.exit(1 if problems else 0)
    columns: dict[str, tuple[list[str], list[str]]] = {}
    for name, is_extra in needed.items():
        columns.setdefault(licence(name), ([], []))[is_extra].append(name)
    rows = [
        f"| {text} | {', '.join(every_run)} | {', '.join(extras)} |\n"
        for text, (every_run, extras) in sorted(columns.items())
    ]
    PAGE.write_text(f"{before}{BEGIN}{HEAD}{''.join(rows)}{END}{after}", encoding="utf-8", newline="\n")


def requirements() -> dict[str, bool]:
    """Return the libraries in pyproject.toml, and whether only extras need them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [text for texts in project["optional-dependencies"].values() for text in texts]
    every_run, of_extras = (
        {Requirement(text).name.lower() for text in texts} for texts in (project["dependencies"], extras)
    )
    return {name: name not in every_run for name in sorted(every_run | of_extras)}


def licence(name: str) -> str:
    """Return the short licence of an installed library. Raises PackageNotFoundError."""
    if name in READ:
        return READ[name]
    facts = distribution(name).metadata
    classifiers = [c.rpartition(" :: ")[2] for c in facts.get_all("Classifier", []) if c.startswith("License ::")]
    short = " and ".join(SPELT.get(c, c) for c in classifiers)
    return facts.get("License-Expression") or short or (facts.get("License") or "unknown").strip().splitlines()[0]


def check(needed: dict[str, bool], table: str) -> list[str]:
    """Return the libraries that the table lacks or has in a wrong column, and those with other licences."""
    listed: dict[str, bool] = {}
    for row in table.splitlines()[2:]:
        _, every_run, extras = row.strip("|").split("|")
        listed |= {
            name: is_extra for is_extra, cell in enumerate((every_run, extras)) for name in re.findall(r"[\w.-]+", cell)
        }
    wrong = sorted({name for name, _ in needed.items() ^ listed.items()})
    problems = [f"docs/licences.md: {name}: run python tools/licences.py" for name in wrong]
    page = PAGE.read_text(encoding="utf-8").lower()
    for result in sorted({d.name.lower() for d in distributions()}):
        try:
            text = licence(result)
        except PackageNotFoundError:
            continue
        if NOT_PERMISSIVE.search(text) and result not in page:
            problems.append(f"{result} is under {text}: add it to docs/licences.md")
    return problems


if __name__ == "__main__":
    main()
