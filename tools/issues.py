"""Write the table of what may be said of a band pair into docs/troubleshooting.md, or check that it stands there.

    python tools/issues.py [--check]

The sentences are the program's own (agalign/values/issues.py).
"""

import re
import sys
from pathlib import Path
from typing import get_args

from agalign.values.issues import Issue, IssueKind, remedy, sentence

PAGE = Path(__file__).resolve().parents[1] / "docs" / "troubleshooting.md"
_BEGIN, _END = "<!-- doubts -->\n", "<!-- end of doubts -->"


def table() -> str:
    """Markdown; numbers and details are dots."""
    rows = {}
    for kind in get_args(IssueKind):
        detail = "FILE: cannot be read (\0)" if kind == "unreadable" else "\0"
        said = sentence(Issue(kind, 0.0, 0.0, detail))
        said = re.sub(r"\d+(\.\d+)?", "…", said.replace("\0", "…"))
        rows.setdefault(remedy(kind), []).append(f"`{said}`")
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
