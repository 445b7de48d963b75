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
COLUMNS = "| library | versions | licence | for |\n| --- | --- | --- | --- |\n"


def main() -> None:
    """Write the table, or check it."""
    wanted = requirements()
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    stands, after = rest.split(END)
    if "--check" in sys.argv[1:]:
        problems = check(wanted, stands)
        print("\n".join(problems) or f"licences: {len(wanted)} libraries, as docs/licences.md says")
        sys.exit(1 if problems else 0)
    rows = [f"| {name} | {versions} | {licence(name)} | {groups} |\n" for name, (versions, groups) in wanted.items()]
    PAGE.write_text(f"{before}{BEGIN}{COLUMNS}{''.join(rows)}{END}{after}", encoding="utf-8", newline="\n")


def requirements() -> dict[str, tuple[str, str]]:
    """Return {library: (versions, purpose)} from pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions: dict[str, str] = {}
    groups: dict[str, list[str]] = {}
    for group, texts in {"every run": project["dependencies"], **project["optional-dependencies"]}.items():
        for one in map(Requirement, texts):
            # Extras may require different versions: the table has the first.
            versions.setdefault(one.name.lower(), str(one.specifier))
            groups.setdefault(one.name.lower(), []).append(group if group == "every run" else f"`{group}`")
    names = sorted(versions, key=lambda name: ("every run" not in groups[name], name))
    return {name: (versions[name], ", ".join(groups[name])) for name in names}


def licence(name: str) -> str:
    """Return the short licence of an installed library. Raises PackageNotFoundError."""
    if name in READ:
        return READ[name]
    facts = distribution(name).metadata
    classifiers = [c.rpartition(" :: ")[2] for c in facts.get_all("Classifier", []) if c.startswith("License ::")]
    short = " and ".join(SPELT.get(c, c) for c in classifiers)
    return facts.get("License-Expression") or short or (facts.get("License") or "not said").strip().splitlines()[0]


def check(wanted: dict[str, tuple[str, str]], table: str) -> list[str]:
    """Return the libraries that the table lacks or lists with another licence."""
    listed = {row.split(" | ")[0].removeprefix("| "): row for row in table.splitlines()[2:]}
    problems = [f"docs/licences.md lacks {name}: python tools/licences.py" for name in wanted if name not in listed]
    problems += [f"docs/licences.md has {name}, which nothing needs" for name in listed if name not in wanted]
    for name, (versions, groups) in wanted.items():
        row = listed.get(name, "")
        if row and not (row.startswith(f"| {name} | {versions} |") and row.endswith(f"| {groups} |")):
            problems.append(f"docs/licences.md says otherwise of {name}: python tools/licences.py")
    page = PAGE.read_text(encoding="utf-8").lower()
    for result in sorted({d.name.lower() for d in distributions()}):
        try:
            said = licence(result)
        except PackageNotFoundError:
            continue
        if NOT_PERMISSIVE.search(said) and result not in page:
            problems.append(f"{result} is under {said}: add it to docs/licences.md")
    return problems


if __name__ == "__main__":
    main()
