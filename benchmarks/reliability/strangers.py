"""Output folders and tags from strangers: change them at random, run the commands, and count what goes wrong.

    python benchmarks/reliability/strangers.py [--folders 5000] [--listed 1000000] [--tagged 1000]

`report`, `verify` and `export` run on each changed output folder, and on one with a map and a table
that list very many captures, each in a forked process. Wrong are tracebacks, control characters and NaN in texts, files
that are written or copied outside of the folders of the command, captures that are missing from a result that is
reported as complete, and commands that do not end in time or within the memory.
"""

import json
import math
import os
import random
import re
import resource
import shutil
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bands.score import table
from common import Ending, align, run

from agalign.cameras import tiff_directory as tiff
from agalign.cli.main import main as agalign_main
from agalign.records.sidecar_file import content_checksum, find_sidecars
from agalign.synthetic import flight as synthetic

CAPTURES, SIZE_PX, NAMES = 2, (240, 180), ("IMG_0001", "IMG_0002")
PLACED = "--georeference", "--ground-elevation=0", "--tie-points"
OPTIONS = *PLACED, "--layout=both", "--error-map", "--qa", "--index=ndvi", "--relief=always", "--relief-map"
TAG_OPTIONS = *PLACED, "--only-seed", "--bands=green,red", "--relief=never", "-j1", "-v"
MAX_S, MAX_BYTES = 60, 4 << 30
"""Limits of a command: time, and memory beyond that of this process."""
SECRET = "the contents of a file of somebody else"
FAULTS = "tracebacks", "unsafe texts", "files outside", "silent losses", "hangs", "out of memory"
TEXTS = "\x1b[2J\x07", "\u202egnp.exe", "=1+1", "</script><b>", "[bold]x[/]", "a\nb\r", "x" * 10**6, "\u0000", ""
PATHS = "../../../pwn", "../../secret.txt", "C:\\pwn", "\\\\host\\pwn", "a" * 300, "..", "CON", "x/" * 3000, "/dev/zero"
NUMBERS = 0, -1, 0.5, 1e9, 10**9, -(10**9), 1e308, -1e308, 5e-324, 2**63, 10**30, 10**4000
VALUES_OF = {"paths": PATHS, "texts": TEXTS, "numbers": NUMBERS, "NaN": (math.nan, math.inf, -math.inf)}
VALUES_OF |= {"types": (None, True, [], {}, "x", 7, [[1]], {"a": 1}), "nesting": ("@nested@",)}
TYPES_OF = {"paths": str, "texts": str, "numbers": (int, float), "NaN": (int, float)}
KINDS = *VALUES_OF, "entries", "bytes", "links"
UNSAFE = {*map(chr, (*range(9), *range(11, 32), *range(127, 160))), *"\u061c\u200e\u200f\u202a\u202b\u202d\u202e\u2028"}
NOT_IN_JSON = re.compile(r"(?<![\w\"])(NaN|-?Infinity)\b")


def fork(arguments: Sequence[str], folder: Path) -> Ending:
    """Run a command in a forked process with the working folder `folder`."""
    logs = folder / "errors.log", folder / "out.log"

    def command() -> None:
        for number, log in zip((2, 1), logs, strict=True):
            os.dup2(os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MAX_BYTES,) * 2)
        sys.argv = ["agalign", *arguments]
        agalign_main()

    process = get_context("fork").Process(target=command)
    process.start()
    process.join(MAX_S)
    code = process.exitcode
    process.kill()
    process.join()
    return Ending(code, *(log.read_text(errors="replace") for log in logs))


@contextmanager
def box_with(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Yield a temporary folder, and a copy of a folder in it, where commands may write in `a/b` only."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name), shutil.copytree(folder, Path(name, "a/b", folder.name))


def attempt(arguments: Sequence[str], box: Path, is_lost: Callable[[Ending], object]) -> Counter[str]:
    """Run a command and return its faults; `is_lost` is true for a silent loss."""
    before = {p: p.lstat().st_mtime_ns for p in box.rglob("*")}
    ending = fork(arguments, box)
    written = [p for p in box.rglob("*") if before.get(p) != p.lstat().st_mtime_ns and not p.is_dir()]
    own = [p for p in written if p.is_relative_to(box / "a/b") and p.is_file()]
    texts = [ending.out, ending.errors, *(p.read_text() for p in own if p.suffix == ".html")]
    unsafe = [text for text in texts if not UNSAFE.isdisjoint(text)]
    unsafe += [p for p in own if p.suffix in (".json", ".geojson") and NOT_IN_JSON.search(p.read_text())]
    outside = [p for p in written if p.suffix != ".log" and not p.is_relative_to(box / "a/b")]
    outside += [p for p in own if SECRET.encode() in p.read_bytes()]
    faults = Counter({"unsafe texts": len(unsafe), "files outside": len(outside), "hangs": int(ending.code is None)})
    faults["tracebacks"] = int(ending.has_traceback or ending.code not in (None, 0, 1, 2, 3))
    faults["out of memory"] = int("out of memory" in ending.errors)
    faults["silent losses"] = int(bool(is_lost(ending)))
    if +faults:
        print(*arguments[:2], dict(+faults), ending.code, ending.errors[:150], ending.errors[-250:], flush=True)
    return faults + Counter(commands=1)


# ---- changes of output folders


def places(content: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Yield the path without the indices of lists, the container and the key of all values."""
    for key in content if isinstance(content, dict) else range(len(content)):
        at = (*path, key if isinstance(content, dict) else "")
        yield at, content, key
        if isinstance(content[key], (dict, list)):
            yield from places(content[key], at)


def changed(kind: str, content: Any, secret: Path, rng: random.Random) -> None:
    """Replace a value, or remove, add or repeat entries; each field is as likely as the others."""
    fields = defaultdict(list)
    for path, *place in places(content):
        if isinstance(place[0][place[1]], TYPES_OF.get(kind, object)):
            fields[path].append(place)
    container, key = rng.choice(rng.choice(list(fields.values())))
    if kind != "entries":
        container[key] = rng.choice([str(secret), *VALUES_OF[kind]] if kind == "paths" else VALUES_OF[kind])
    elif isinstance(container[key], list):
        container[key] = rng.choice((container[key][::-1], container[key][::2], [], container[key] * 2))
    elif isinstance(container, dict) and rng.random() < 0.5:
        container["unknown"] = container.pop(key)
    else:
        del container[key]


def change(kind: str, rng: random.Random, out: Path, secret: Path) -> bool:
    """Change an output folder; return True if a sidecar no longer has the checksum of its contents."""
    sidecars, files = find_sidecars(out), sorted(p for p in out.rglob("*") if p.is_file())
    path = rng.choice(rng.choice((sidecars, sidecars, files if kind in ("bytes", "links") else [*out.glob("*.*json")])))
    contents = bytearray(path.read_bytes())
    path.unlink()
    if kind == "links":
        target = rng.choice((secret, secret.parent, path, Path("/dev/zero"), Path("missing"), os.mkfifo, Path.mkdir))
        path.symlink_to(target) if isinstance(target, Path) else target(path)
        return path in sidecars
    if kind == "bytes":
        for _ in range(rng.randint(1, 8)):
            contents[rng.randrange(len(contents))] = rng.randrange(256)
        contents = contents[: rng.choice((len(contents), rng.randrange(len(contents)), 0))]
    else:
        content = json.loads(contents)
        changed(kind, content, secret, rng)
        if "checksum" in content and rng.random() < 0.5:
            content["checksum"] = content_checksum(json.dumps(content))
        contents = json.dumps(content).replace('"@nested@"', "[" * 100_000 + "]" * 100_000).encode()
    path.write_bytes(contents)
    try:
        checksum = json.loads(contents).get("checksum")
        return path in sidecars and checksum is not None and checksum != content_checksum(contents)
    except (ValueError, RecursionError, AttributeError):
        return path in sidecars


COMMAND_LINES = {
    ("report", "a/b/out", "--json"): r'(?s)"sidecar": .*"sidecar": ',
    ("verify", "a/b/out"): "",
    ("export", "a/b/out", "--for", "odm", "-o", "a/b/files"): r"\b2 captures, ",
}
"""What a command prints if no capture is missing, by its arguments."""


def list_many(count: int, out: Path, _secret: Path) -> None:
    """Repeat an entry of the map and of the table of indices."""
    entry = json.dumps(json.loads((out / "flight.geojson").read_text())["features"][0] | {"geometry": None})
    (out / "flight.geojson").write_text('{"features": [' + ",".join([entry] * count) + "]}")
    head, row, *_ = (out / "indices.csv").read_text().splitlines()
    (out / "indices.csv").write_text("\n".join([head, *[row] * count]))


def attack_folder(change_folder: Callable[[Path, Path], bool | None], whole: Path) -> Counter[str]:
    """Return the faults of all commands on a changed copy of an output folder."""
    result: Counter[str] = Counter()
    with box_with(whole) as (box, out):
        secret = box / "secret.txt"
        secret.write_text(SECRET)
        is_changed = change_folder(out, secret)
        for arguments, complete in COMMAND_LINES.items():

            def is_lost(ending: Ending, complete: str = complete) -> bool:
                is_complete = re.search(complete, ending.out) if complete else not is_changed
                return ending.code == 0 and not is_complete and len(find_sidecars(out)) == CAPTURES

            result += attempt(arguments, box, is_lost)
    return result


# ---- tags


TAGS = {0: (272, 306, 50714), tiff.EXIF: (0x9003, 0x829A, 0x8827, 0x920A, 0xA20E, 0xA431), tiff.GPS: range(1, 7)}
TAG_VALUES = (
    *(tiff.Entry(5, 1, np.array(pair, "<u4").tobytes()) for pair in ((0, 0), (1, 0), (2**32 - 1, 1), (0, 1))),
    *(tiff.Entry(12, 1, np.float64(value).tobytes()) for value in (math.nan, math.inf, -math.inf, 1e308, -1e308)),
    *(tiff.Entry(12, 3, np.full(3, value).tobytes()) for value in (math.nan, 1e308, 89.9, -0.0)),
    *map(tiff.text, (*TEXTS, *PATHS, "9999:99:99 99:99:99", "0001:01:01 00:00:00", "S")),
)
XMP_VALUES = "nan", "-inf", "1e308", "1e14", "0", "-1", "1e-300", "&#x202e;x", "../../pwn", "=1+1", "", "x" * 10**5


def change_tags(path: Path, rng: random.Random) -> None:
    """Change up to four tags of an image, in the directories of TIFF or in the XMP packet."""
    directories, pixels = tiff.read_directories(path), tifffile.imread(path)
    directories[0] = {tag: entry for tag, entry in directories[0].items() if tag in (271, 272, 305, 306, 700, 50714)}
    packet = directories[0][tiff.XMP].data.decode()
    for _ in range(rng.randint(1, 4)):
        directory = rng.choice((*TAGS, tiff.XMP))
        if directory == tiff.XMP:
            start, end = rng.choice([match.span(1) for match in re.finditer(r">([^<>\n]+)<", packet)])
            packet = packet[:start] + rng.choice(XMP_VALUES) + packet[end:]
        else:
            directories[directory][rng.choice(TAGS[directory])] = rng.choice(TAG_VALUES)
    directories[0][tiff.XMP] = tiff.byte_string(packet.encode())
    tifffile.imwrite(path, pixels, photometric="minisblack", metadata=None)
    tiff.add_directories(path, directories[0], directories[tiff.EXIF], directories[tiff.GPS])


def attack_tags(flight: Path, rng: random.Random) -> Counter[str]:
    """Return the faults of a run over images with changed tags."""
    with box_with(flight) as (box, images):
        for path in sorted(images.rglob("IMG_*_[23].tif")):
            change_tags(path, rng)
        arguments = ["align", "a/b/flight", "-o", "a/b/out", *TAG_OPTIONS, *rng.choice((["--radiometry"], []))]

        def is_lost(ending: Ending) -> bool:
            missing = {*NAMES} - {path.stem for path in find_sidecars(box / "a/b/out")}
            return ending.code in (0, 3) and any(not re.search(f"agalign: .*{n}", ending.errors) for n in missing)

        return attempt(arguments, box, is_lost)


def main(folders: int = 5000, listed: int = 1_000_000, tagged: int = 1000, rng_seed: int = 0) -> None:
    rng, rows = random.Random(rng_seed), defaultdict[str, Counter[str]](Counter)
    import_module("agalign.cli.align_run")
    with tempfile.TemporaryDirectory() as name:
        flight, whole = Path(name, "flight"), Path(name, "out")
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        align(flight, whole, *OPTIONS)
        for _ in range(tagged):
            rows["tags of images"] += attack_tags(flight, rng)
        for number in range(folders):
            kind = KINDS[number % len(KINDS)]
            rows[f"output folder: {kind}"] += attack_folder(partial(change, kind, rng), whole)
        rows[f"{listed:,} captures listed"] = attack_folder(partial(list_many, listed), whole)
    cells = [(kind, *(row[fault] for fault in ("commands", *FAULTS))) for kind, row in rows.items()]
    print(table([("attack", "commands", *FAULTS), *cells]))


if __name__ == "__main__":
    run(main)
