"""Write or check the table of the licences of dependencies in docs/project/licences.md.

    python tools/licences.py           # writes; everything of pyproject.toml must be installed
    python tools/licences.py --check   # exit code 1 where the page lacks a library, or one that is not permissive

The check allows libraries that are not installed, and other spellings of a licence than in the table.
"""

import re
import sys
import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from bands.score import table
from common import with_section

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "project" / "licences.md"
SPELT = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "MIT License": "MIT",
    "Python Software Foundation License": "PSF-2.0",
}
"""Names of licences in classifiers, in short."""
DEVELOPMENT = {"bench", "dev", "docs", "fuzz"}
"""Extras that nobody needs who uses or redistributes agalign."""
NOT_PERMISSIVE = re.compile(r"GPL|General Public|MPL|Mozilla|EUPL|Proprietary|Commercial")


def main() -> None:
    """Write the table, or check it."""
    every_run, extras = requirements()
    if "--check" in sys.argv[1:]:
        problems = check(every_run, extras)
        print("\n".join(problems) or f"licences: {len(every_run | extras)} libraries, as in docs/project/licences.md")
        sys.exit(1 if problems else 0)
    columns = {text: ([], []) for text in sorted(set(map(licence, every_run | extras)))}
    for column, names in enumerate((every_run, extras)):
        for name in sorted(names):
            columns[licence(name)][column].append(name)
    rows = [(text, *(", ".join(names) for names in both)) for text, both in columns.items()]
    content = table([("licence", "every run", "extras"), *rows]) + "\n"
    PAGE.write_text(with_section(PAGE, "licences", content), encoding="utf-8", newline="\n")


def requirements() -> tuple[set[str], set[str]]:
    """Return the libraries in pyproject.toml that every run needs, and those that only extras for users need."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    by_extra = project["optional-dependencies"].items()
    of_extras = [text for extra, texts in by_extra if extra not in DEVELOPMENT for text in texts]
    every_run, extras = ({Requirement(text).name.lower() for text in t} for t in (project["dependencies"], of_extras))
    return every_run, extras - every_run


def licence(name: str) -> str:
    """Return the short licence of an installed library. Raises PackageNotFoundError."""
    facts = distribution(name).metadata
    classifiers = [c.rpartition(" :: ")[2] for c in facts.get_all("Classifier", []) if c.startswith("License ::")]
    short = " and ".join(SPELT.get(c, c) for c in classifiers)
    return facts.get("License-Expression") or short or (facts.get("License") or "unknown").strip().splitlines()[0]


def check(every_run: set[str], extras: set[str]) -> list[str]:
    """Return the libraries that the table lacks or has in a wrong column, and those with other licences."""
    page = PAGE.read_text(encoding="utf-8").lower()
    rows = re.findall(r"^\| (?!licence|---).* \| (.*) \| (.*) \|$", page.partition("<!-- end of")[0], re.MULTILINE)
    listed = (set(re.findall(r"[\w.-]+", " ".join(column))) for column in zip(*rows, strict=True))
    wrong = sorted(set().union(*(one ^ other for one, other in zip((every_run, extras), listed, strict=True))))
    problems = [f"docs/project/licences.md: {name}: run python tools/licences.py" for name in wrong]
    for name in sorted({d.name.lower() for d in distributions()}):
        with suppress(PackageNotFoundError):
            if NOT_PERMISSIVE.search(licence(name)) and name not in page:
                problems.append(f"{name} is under {licence(name)}: add it to docs/project/licences.md")
    return problems


if __name__ == "__main__":
    main()
