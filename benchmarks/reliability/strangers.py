"""Output folders, options and tags from strangers: change them at random, run the commands, and count what goes wrong.

    python benchmarks/reliability/strangers.py [--folders 5000] [--listed 1000000] [--tagged 1000] [--no-options]

`report`, `verify`, `export`, `plots` and `mosaic` run on each changed output folder, each in a forked process. Wrong
are tracebacks, files that are written or copied outside of the folders of the command, captures that are missing from
a result that is reported as complete, and commands that do not end in time or within the memory.
"""

import json
import math
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "qgis" / "agalign_provider"))

from command import sidecars_below
from common import Section, align, run

from agalign.cameras import tiff_directory as tiff
from agalign.cli.main import COMMANDS
from agalign.cli.main import main as agalign_main
from agalign.products.sidecar_file import content_checksum, find_sidecars
from agalign.synthetic import flight as synthetic

CAPTURES, SIZE_PX = 2, (240, 180)
OPTIONS = [
    *("--layout", "both", "--georeference", "--ground-elevation", "0", "--error-map", "--qa", "--tie-points", "--stac"),
    *("--index", "ndvi", "--relief", "always", "--relief-map"),
]
TAG_OPTIONS = (
    *("--only-seed", "--bands", "green,red", "--georeference", "--ground-elevation", "0", "--stac", "--tie-points"),
    *("--relief", "never", "-j", "1", "-v"),
)
PRELOADED = (
    *("geopandas", "exactextract", "agalign.products.plots", "agalign.products.mosaic", "agalign.products.export"),
    *("agalign.batch", "agalign.cli.align_run", "agalign.products.stac", "pystac"),
)
MAX_S, MAX_BYTES = 20, 4 << 30
"""Limits of a command: time, and memory beyond that of this process."""
SECRET = "the contents of a file of somebody else"
NESTED = "@nested@"
FAULTS = "tracebacks", "files outside", "silent losses", "hangs", "out of memory"
TEXTS = "\x1b[2J\x07", "\u202egnp.exe", "=1+1", "</script><b>", "[bold]x[/]", "a\nb\r", "x" * 10**6, "\u0000", ""
PATHS = (
    "../../../pwn",
    "../../secret.txt",
    "C:\\pwn",
    "\\\\host\\pwn",
    "a" * 300,
    "..",
    "CON",
    "link",
    "x/" * 3000,
    "/dev/zero",
)
NUMBERS = 0, -1, 0.5, 1e9, 10**9, -(10**9), 1e308, -1e308, 5e-324, 2**63, 10**30, 10**4000
VALUES_OF = {"paths": PATHS, "texts": TEXTS, "numbers": NUMBERS, "NaN": (math.nan, math.inf, -math.inf)}
VALUES_OF |= {"types": (None, True, [], {}, "x", 7, [[1]], {"a": 1}), "nesting": (NESTED,)}
TYPES_OF = {"paths": str, "texts": str, "numbers": (int, float), "NaN": (int, float)}
KINDS = *VALUES_OF, "entries", "bytes", "links"


@dataclass(frozen=True)
class Ending:
    """How a command ended, and what it printed."""

    code: int | None
    """None after the time limit; negative if a signal ended it."""
    out: str
    errors: str

    def faults(self) -> Iterator[str]:
        if self.code is None:
            yield "hangs"
        elif "Traceback" in self.errors or "please report" in self.errors or self.code not in (0, 1, 2, 3):
            yield "tracebacks"
        if "out of memory" in self.errors:
            yield "out of memory"


def attempt(arguments: list[str], folder: Path, max_s: float = MAX_S) -> Ending:
    """Run a command in a forked process with the working folder `folder`."""
    logs = folder / "out.log", folder / "errors.log"
    process = os.fork()
    if process == 0:
        for number, log in enumerate(logs, start=1):
            os.dup2(os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
        os.chdir(folder)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, used + MAX_BYTES))
        sys.argv, code = ["agalign", *arguments], 70
        try:
            agalign_main()
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stdout.flush()
            os._exit(code)
    code, began = None, time.monotonic()
    while code is None and time.monotonic() - began < max_s:
        time.sleep(0.005)
        done, status = os.waitpid(process, os.WNOHANG)
        code = os.waitstatus_to_exitcode(status) if done else None
    if code is None:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
    return Ending(code, *(log.read_text(errors="replace") for log in logs))


# ---- changes of output folders


def places(content: Any) -> dict[tuple[str, ...], list[tuple[Any, Any]]]:
    """Return (container, key) of all values, by their path without the indices of lists."""
    result: dict[tuple[str, ...], list[tuple[Any, Any]]] = defaultdict(list)
    remaining = [((), content)]
    while remaining:
        path, container = remaining.pop()
        for key in container if isinstance(container, dict) else range(len(container)):
            at = (*path, key if isinstance(container, dict) else "")
            result[at].append((container, key))
            if isinstance(container[key], (dict, list)):
                remaining.append((at, container[key]))
    return result


def place(content: Any, rng: random.Random, of: type | tuple[type, ...] = object) -> tuple[Any, Any]:
    """Return (container, key) of a random value of a type, each field as likely as the others."""
    fields = ([(c, k) for c, k in one if isinstance(c[k], of)] for one in places(content).values())
    return rng.choice(rng.choice([field for field in fields if field]))


def changed(kind: str, content: Any, secret: Path, rng: random.Random) -> None:
    """Replace a value, or remove, add or repeat entries."""
    container, key = place(content, rng, TYPES_OF.get(kind, object))
    if kind != "entries":
        container[key] = rng.choice([str(secret), *VALUES_OF[kind]] if kind == "paths" else VALUES_OF[kind])
    elif isinstance(container[key], list):
        container[key] = rng.choice((container[key][::-1], container[key][::2], [], container[key] * 2))
    elif isinstance(container, dict) and rng.random() < 0.5:
        container["unknown"] = container.pop(key)
    else:
        del container[key]


def replaced(path: Path, rng: random.Random, secret: Path) -> None:
    """Replace a file by a link, a pipe or a folder."""
    path.unlink()
    target = rng.choice((secret, secret.parent, path, Path("/dev/zero"), Path("missing"), os.mkfifo, Path.mkdir))
    path.symlink_to(target) if isinstance(target, Path) else target(path)


def change(kind: str, out: Path, secret: Path, rng: random.Random) -> bool:
    """Change an output folder; return True if a sidecar no longer has the checksum of its contents."""
    sidecars, files = find_sidecars(out), sorted(p for p in out.rglob("*") if p.is_file())
    path = rng.choice(rng.choice((sidecars, sidecars, files if kind in ("bytes", "links") else [*out.glob("*.*json")])))
    if kind == "links":
        replaced(path, rng, secret)
        return path in sidecars
    contents = bytearray(path.read_bytes())
    if kind == "bytes":
        for _ in range(rng.randint(1, 8)):
            contents[rng.randrange(len(contents))] = rng.randrange(256)
        contents = contents[: rng.choice((len(contents), rng.randrange(len(contents)), 0))]
    else:
        content = json.loads(contents)
        changed(kind, content, secret, rng)
        if "checksum" in content and rng.random() < 0.5:
            content["checksum"] = content_checksum(json.dumps(content))
        contents = json.dumps(content).replace(f'"{NESTED}"', "[" * 100_000 + "]" * 100_000).encode()
    path.unlink()
    path.write_bytes(contents)
    try:
        checksum = json.loads(contents).get("checksum")
        return path in sidecars and checksum is not None and checksum != content_checksum(contents)
    except (ValueError, RecursionError, AttributeError):
        return path in sidecars


COMMAND_LINES = {
    "report": (("report", "a/b/out", "--json"), r'(?s)"sidecar": .*"sidecar": '),
    "verify": (("verify", "a/b/out"), ""),
    "export": (("export", "a/b/out", "--for", "opencv", "-o", "a/b/matrices"), r"\b2 captures, "),
    "files": (("export", "a/b/out", "--for", "odm", "-o", "a/b/files"), r"\b2 captures, "),
    "plots": (("plots", "a/b/out", "plots.geojson", "-o", "a/b/plots.csv"), "captures: 2"),
    "mosaic": (("mosaic", "a/b/out", "-o", "a/b/field.tif"), "Mosaic of 2 captures"),
}
"""Arguments, and what a command prints if no capture is missing."""


def _is_outside(path: Path, box: Path) -> bool:
    """True for a file outside of the folders of the commands, and for one with what is outside of them."""
    if not path.is_relative_to(box / "a/b"):
        return path.suffix != ".log"
    return path.is_file() and SECRET.encode() in path.read_bytes()


def attack_folder(kind: str, whole: Path, rng: random.Random) -> Counter[str]:
    """Return the faults of all commands on a changed copy of an output folder."""
    result: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        box = Path(name)
        out, secret = box / "a/b/out", box / "secret.txt"
        shutil.copytree(whole, out, copy_function=os.link)
        shutil.copy(whole / "flight.geojson", box / "plots.geojson")
        secret.write_text(SECRET)
        is_changed = change(kind, out, secret, rng)
        for command, (arguments, complete) in COMMAND_LINES.items():
            before = {p: p.lstat().st_mtime_ns for p in box.rglob("*")}
            ending = attempt(list(arguments), box)
            faults = Counter(ending.faults())
            written = [p for p in box.rglob("*") if before.get(p) != p.lstat().st_mtime_ns and not p.is_dir()]
            faults["files outside"] = sum(_is_outside(p, box) for p in written)
            is_lost = is_changed if command == "verify" else re.search(complete, ending.out) is None
            faults["silent losses"] = int(ending.code == 0 and is_lost and len(find_sidecars(out)) == CAPTURES)
            result += faults
            result["commands"] += 1
            if +faults:
                print(kind, command, dict(+faults), ending.code, ending.errors[:150], ending.errors[-250:], flush=True)
    return result


# ---- options from a file


VALUES = (
    *("true", "0", "-1", "1.5", "nan", "inf", "-inf", "1e308", "9223372036854775808", "[]", "[[1]]", "{a=1}"),
    *("1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "9" * 5000, "[" * 9999 + "]" * 9999, '""', '"x"'),
    *('"\\u001b[2J\\u202e"', '"../../pwn"', '"/dev/zero"', '"\\u0000"', '["a", 1]', f'"{"x" * 9999}"'),
)
FILES = (
    *(b"", b"\xef\xbb\xbfjobs = 1", b"jobs = 1\r\n", "jobs = 1".encode("utf-16"), b"\xff", b"jobs = 1\njobs = 2"),
    *(
        b"[tool.agalign]\njobs = 1",
        b"local = true",
        b"schema = 'agalign-options/2'",
        b"include = '../../*'\nout = '..'",
    ),
)


def attack_options(text: bytes, flight: Path) -> Counter[str]:
    """Return the faults of a run with these options that only prints what it would do."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "a.toml").write_bytes(text)
        ending = attempt(["align", str(flight), "--config", "a.toml", "--dry-run"], Path(name))
        # The file and what the command prints.
        result = Counter({"commands": 1, "files outside": len(list(Path(name).iterdir())) - 3})
        result += Counter(ending.faults())
        if len(+result) > 1:
            print(text[:80], dict(+result), ending.code, ending.errors[-400:], flush=True)
    return result


def options_in_files() -> Iterator[bytes]:
    """Yield every option of `align` with every value, and other files."""
    parameters = COMMANDS["align"].built("align").params
    for name in (max(p.opts, key=len).lstrip("-") for p in parameters if p.param_type_name == "option"):
        yield from (f"{name} = {value}".encode() for value in VALUES)
    yield from FILES


# ---- tags


TAGS = {0: (272, 306, 50714), tiff.EXIF: (0x9003, 0x829A, 0x8827, 0x920A, 0xA20E, 0xA431), tiff.GPS: range(1, 7)}
TAG_VALUES = (
    *(tiff.Entry(5, 1, np.array(pair, "<u4").tobytes()) for pair in ((0, 0), (1, 0), (2**32 - 1, 1), (0, 1))),
    *(tiff.Entry(12, 1, np.float64(value).tobytes()) for value in (math.nan, math.inf, -math.inf, 1e308, -1e308)),
    *(tiff.Entry(12, 3, np.full(3, value).tobytes()) for value in (math.nan, 1e308, 89.9, -0.0)),
    *map(tiff.text, (*TEXTS, *PATHS, "9999:99:99 99:99:99", "0001:01:01 00:00:00", "S")),
)
XMP_VALUES = "nan", "-inf", "1e308", "1e14", "0", "-1", "1e-300", "&#x202e;x", "../../pwn", "=1+1", "", "x" * 10**5
UNSAFE = {*map(chr, (*range(9), *range(11, 32), *range(127, 160))), *"\u061c\u200e\u200f\u202a\u202b\u202d\u202e\u2028"}


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
    """Return the faults of a run over images with changed tags; unsafe characters and JSON with NaN count too."""
    with tempfile.TemporaryDirectory() as name:
        box, out = Path(name), Path(name, "a/b/out")
        shutil.copytree(flight, box / "in")
        for path in sorted((box / "in").rglob("IMG_*_[23].tif")):
            change_tags(path, rng)
        radiometry = rng.choice((["--radiometry"], []))
        ending = attempt(["align", "in", "-o", "a/b/out", *TAG_OPTIONS, *radiometry], box)
        result = Counter([*ending.faults(), "commands"])
        written = [p for p in box.rglob("*") if not p.is_dir() and not p.is_relative_to(box / "in")]
        result["files outside"] = sum(_is_outside(p, box) for p in written)
        shown = [ending.out, ending.errors, *(p.read_text() for p in out.glob("*.html"))]
        result["tracebacks"] += sum(not UNSAFE.isdisjoint(one) for one in shown)
        result["tracebacks"] += sum(not _is_standard(p) for p in written if p.suffix in (".json", ".geojson"))
        result["silent losses"] = int(ending.code == 0 and len(sidecars_below(out)) < CAPTURES)
        if len(+result) > 1:
            print(dict(+result), ending.code, ending.errors[-300:], flush=True)
    return result


def _is_standard(path: Path) -> bool:
    """False for a file with NaN or infinity, which JSON lacks."""
    return not re.search(r"(?<![\w\"])(NaN|-?Infinity)\b", path.read_text())


# ---- many captures


def attack_by_size(count: int, whole: Path) -> Counter[str]:
    """Return the faults of the commands on an output folder with a map and a table that list very many captures."""
    result: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        box, out = Path(name), Path(name, "a/b/out")
        shutil.copytree(whole, out)
        shutil.copy(whole / "flight.geojson", box / "plots.geojson")
        entry = json.dumps(json.loads((out / "flight.geojson").read_text())["features"][0] | {"geometry": None})
        (out / "flight.geojson").write_text('{"features": [' + ",".join([entry] * count) + "]}")
        head, row, *_ = (out / "indices.csv").read_text().splitlines()
        (out / "indices.csv").write_text("\n".join([head, *[row] * count]))
        for command, (arguments, _) in COMMAND_LINES.items():
            ending = attempt(list(arguments), box, max_s=600)
            result += Counter([*ending.faults(), "commands"])
            print(f"{count} captures listed: {command}", ending.code, ending.errors[-300:], flush=True)
    return result


def main(
    folders: int = 5000, listed: int = 1_000_000, tagged: int = 1000, options: bool = True, rng_seed: int = 0
) -> None:
    section, rng = Section("strangers", None), random.Random(rng_seed)
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for module in PRELOADED:
        import_module(module)
    with tempfile.TemporaryDirectory() as name:
        flight, whole = Path(name, "flight"), Path(name, "whole")
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        align(flight, whole, *OPTIONS)
        for _ in range(tagged):
            rows["tags of images"] += attack_tags(flight, rng)
        for number in range(folders):
            kind = KINDS[number % len(KINDS)]
            rows[f"output folder: {kind}"] += attack_folder(kind, whole, rng)
        if listed:
            rows[f"{listed:,} captures listed"] += attack_by_size(listed, whole)
        for contents in options_in_files() if options else ():
            rows["options of --config"] += attack_options(contents, flight)
    cells = [(kind, *(str(row[fault]) for fault in ("commands", *FAULTS))) for kind, row in rows.items()]
    section.table([("attack", "commands", *FAULTS), *cells])


if __name__ == "__main__":
    run(main)
