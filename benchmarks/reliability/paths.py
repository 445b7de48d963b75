"""Paths that look like addresses, options or other files: which files does a command open, and does it connect?

    python benchmarks/reliability/paths.py [--places folder,out,onto] [--spellings 37]

Each command gets one spelling in one place, under `strace`: as an argument, or as the name of a folder or file below
FOLDER or OUT. Wrong are tracebacks, connections, and files that are opened outside of the scratch folder, the system
and the program; or in a decoy at the place that `file:/…` names. Linux only. Without strace nothing is measured.
"""

import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from common import ended, print_head, print_row, run

from agalign.pixels.gdal import open_local
from agalign.rasters.geotiff import tiled_profile

MAX_S = 120
SPELLINGS = (
    *("file:DECOY", "FILE:DECOY", "file://DECOY", "http:/127.0.0.1:9/x", "http://127.0.0.1:9/x", "https://a.example/y"),
    *("s3:/b", "s3://bucket/x", "gs://b/x", "az://b/x", "ftp://127.0.0.1/x", "zip:DECOY/a.zip!"),
    *("zip+https://127.0.0.1:9/x.zip", "/vsizip/a.zip", "/vsimem/x", "/vsicurl/http://127.0.0.1:9/x", "vsizip/a.zip"),
    *("C:\\x", "C:/x", "\\\\host\\share", "GTIFF_DIR:1:x", "NETCDF:x", "HDF5:x", "-x", "--out", "a\nb", "b\r\x1b[2J"),
    *("x" * 256, "\u00e9" * 128, "e\u0301", "\u202egpj", "%2e%2e", "?x#y", "[x", "~", "$HOME", ".. "),
)
ARGUMENTS: dict[str, Callable[[str], list[str]]] = {
    "folder": lambda s: ["align", "--only-seed", "-q", "--", s],
    "out": lambda s: ["align", "flight", "--only-seed", "-q", f"--out={s}"],
    "config": lambda s: ["align", "flight", "-o", "o", f"--config={s}"],
    "model": lambda s: ["align", "flight", "-o", "o", f"--model={s}"],
    "include": lambda s: ["info", "flight", f"--include={s}"],
    "onto": lambda s: ["onto", "-o", "o", "--", "flight/f_green.tif", s],
    "export": lambda s: ["export", "flight", "--for", "odm", f"-o{s}"],
    "indices": lambda s: ["indices", "flight", f"--out={s}"],
    "report": lambda s: ["report", "--", s],
}
"""Arguments of a command with a spelling, by place."""
NAMES = "folder below FOLDER", "file below FOLDER", "folder below OUT"
"""Places of a spelling as a name."""
_CALL = re.compile(r"^\d+ +(\w+)\((.*)")
_FILE_CALLS = "open,openat,openat2,creat,mkdir,mkdirat,rename,renameat,renameat2,link,linkat,unlink,unlinkat"


def main(places: str = "", spellings: int = len(SPELLINGS)) -> None:
    if shutil.which("strace") is None:
        sys.exit("strace is not installed: nothing is measured")
    chosen = [p for p in (*ARGUMENTS, *NAMES) if not places or p in places.split(",")]
    print_head("place", "tries", "exit codes", "tracebacks", "connections", "files outside", "files of the decoy")
    for place in chosen:
        counts, codes = Counter[str](), Counter[int]()
        for spelling in SPELLINGS[:spellings]:
            with tempfile.TemporaryDirectory() as scratch:
                box = Path(scratch)
                if (command := prepared(box, place, spelling)) is not None:
                    code, found = traced(box, *command)
                    counts["tries"] += 1
                    codes[code] += 1
                    counts.update(kind for kind, _ in found)
                    for kind, what in found:
                        print(f"{place} {spelling!r}: {kind}: {what[:160]}", file=sys.stderr)
        of_codes = ", ".join(f"{code}: {n}" for code, n in sorted(codes.items()))
        kinds = "tracebacks", "connections", "files outside", "files of the decoy"
        print_row(place, counts["tries"], of_codes, *(counts[kind] for kind in kinds))


def prepared(box: Path, place: str, spelling: str) -> tuple[list[str], Path] | None:
    """Write a capture and a decoy; return (arguments, working folder), or None if a file system has no such name."""
    work, decoy = box / "work", box / "decoy"
    write_capture(work / "flight", 96)
    write_capture(decoy, 64)
    text = spelling.replace("DECOY", str(decoy))
    if place in ARGUMENTS:
        return ARGUMENTS[place](text), work
    (work / "all").mkdir()
    try:
        if place == "file below FOLDER":
            for path in (work / "flight").iterdir():
                path.rename(work / "all" / path.name.replace("f", text.replace("/", "_"), 1))
        else:
            target = work / "all" / text.replace("://", ":/").lstrip("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            (work / "flight").rename(target)
    except OSError:
        return None
    if place == "folder below OUT":
        (work / "o").mkdir()
        return ["align", "../all", "-o", ".", "--only-seed", "-q"], work / "o"
    return ["align", ".", "-o", "../o", "--only-seed", "-q"], work / "all"


def write_capture(folder: Path, side_px: int) -> None:
    """Write the two bands of a capture."""
    folder.mkdir(parents=True)
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (side_px, side_px)), (0, 0), 2)
    pixels = cv2.normalize(texture, None, 1000, 30000, cv2.NORM_MINMAX).astype(np.uint16)
    for name in ("green", "nir"):
        with open_local(folder / f"f_{name}.tif", "w", **tiled_profile(side_px, side_px, 1, "uint16")) as file:
            file.write(pixels, 1)


def traced(box: Path, arguments: list[str], work: Path) -> tuple[int, list[tuple[str, str]]]:
    """Run the program under strace; return its exit code, and (kind, what) of all that is wrong."""
    trace = box / "trace.txt"
    strace = ["strace", "-f", "-qq", "-s", "900", "-e", f"trace={_FILE_CALLS},connect", "-o", str(trace)]
    command = ["env", "-C", str(work), f"TMPDIR={box}", "PYTHONDONTWRITEBYTECODE=1"]
    program = f"import sys; sys.path.insert(0, {str(Path(__file__).resolve().parents[2])!r}); "
    program += "from agalign.__main__ import main; main()"
    ending = ended([*command, *strace, sys.executable, "-c", program, *arguments], MAX_S)
    found = [("tracebacks", ending.errors[-200:])] if ending.has_traceback else []
    return -1 if ending.code is None else ending.code, found + list(
        wrong_calls(trace.read_text(errors="replace"), box, work)
    )


def wrong_calls(trace: str, box: Path, work: Path) -> Iterator[tuple[str, str]]:
    """Yield (kind, line) of the calls that connect, or that open a file outside of the folders of a command."""
    repository, home = Path(__file__).resolve().parents[2], Path.home()
    usual = (sys.prefix, sys.base_prefix, str(repository), *(p for p in sys.path if p), str(home / ".cache"))
    usual += ("/usr", "/lib", "/etc", "/proc", "/sys", "/dev", "/bin", "/opt", "/run", str(box))
    for line in trace.splitlines():
        call = _CALL.match(line)
        if call is None or (call[1] == "connect" and "AF_UNIX" in line):
            continue
        if call[1] == "connect":
            yield "connections", line
            continue
        for text in re.findall(r'"((?:[^"\\]|\\.)*)"', call[2]) if " = -1 " not in line else ():
            path = os.path.normpath(work / text.encode().decode("unicode_escape", "replace"))
            if path.startswith(str(box / "decoy")):
                yield "files of the decoy", line
            elif not path.startswith(usual) and path not in ("/", "/tmp", str(home)):
                yield "files outside", line


if __name__ == "__main__":
    run(main)
