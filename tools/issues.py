"""Write the table of what may be said of a band pair into docs/troubleshooting.md, or check that it stands there.

    python tools/issues.py [--check]

The sentences are the program's own (agalign/values/issues.py and the checks in agalign/verify).
"""

import re
import sys
from pathlib import Path

from agalign.values.issues import Issue, sentence
from agalign.verify.checks import KINDS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "troubleshooting.md"
_BEGIN, _END = "<!-- doubts -->\n", "<!-- end of doubts -->"


def table() -> str:
    """Markdown; numbers and details are dots."""
    rows = {}
    for kind in KINDS.values():
        detail = "FILE: cannot be read (\0)" if kind.code == "unreadable" else "\0"
        said = sentence(Issue(kind, 0.0, 0.0, detail))
        said = re.sub(r"\d+(\.\d+)?", "…", said.replace("\0", "…"))
        rows.setdefault(kind.remedy, []).append(f"`{said}`")
    lines = ["| said of a pair | mostly | try |", "|---|---|---|"]
    lines += [f"| {'; '.join(said)} | {r.cause} | {r.advice} |" for r, said in rows.items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    text = PAGE.read_text(encoding="utf-8")
    head, _, rest = text.partition(_BEGIN)
    _, _, tail = rest.partition(_END)
    page = head + _BEGIN + table() + _END + tail
    if page == text:
        return
    if "--check" in sys.argv[1:]:
        sys.exit(f"{PAGE.name}: its table of doubts is old; run python tools/issues.py")
    PAGE.write_text(page, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
