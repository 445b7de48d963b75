"""Runs methods on the band pairs of the sets that are on disk, and scores what they claim.

    pip install -e '.[bench]' && python benchmarks/bands/run.py DATA [-o results.csv] [--plot FILE]
        [--methods 'SIFT + RANSAC;mine.py:align'] [--sets p4m_forest,...] [--variants 'as it is,turn 10,...']

DATA is any folder: images are known by their checksums, and sets that are not there are named, with where they are
published. Each method runs in a process of its own with as many threads as it takes; one that raises has refused the
pair. Scores are written to -o, and as tables beside it (.md); what was said of each pair to --said, as score.py reads
it.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, its package is not to be found

from bands import capture
from bands.images import LENS_CORRECTED, VARIANTS, Located, locate, read, spoilt
from bands.methods import PAIR_METHODS, Align, UnavailableError, method_named
from bands.report import draw, tables
from bands.score import Pair, pairs_of, read_sets, score_pairs, summary, write_csv

Row = dict[str, Any]
METHODS = (*PAIR_METHODS, *capture.WHOLE)
SLOW = ("kornia ImageRegistrator",)
"""Run where they are named."""
_FIELDS = ("method", "set", "capture", "file", "variant", "claimed", "seconds", "homography", "grid")


def asked(align: Align, pair: Pair, variant: str, paths: dict[str, Path], bands: dict[str, Any]) -> Row:
    """What a pair method says of a pair; an exception is a refusal."""
    fixed, moving = read(paths[pair.reference]), read(paths[pair.file])
    if variant != LENS_CORRECTED:
        moving = spoilt(moving, pair, variant)
    began = time.perf_counter()
    try:
        if variant == LENS_CORRECTED:
            return capture.lens_corrected(align, (fixed, bands[pair.reference]), (moving, bands[pair.file]))
        matrix = align(fixed, moving)
    except Exception as error:  # whatever a method dies of is its own affair
        print(f"{pair.key}, {variant}: refused ({type(error).__name__}: {error})", file=sys.stderr)
        return {"seconds": time.perf_counter() - began}
    said = {} if matrix is None else {"homography": [[float(v) for v in row] for row in matrix]}
    return {**said, "seconds": time.perf_counter() - began}


def run_method(name: str, located: Located, sets: dict[str, Any], variants: Sequence[str]) -> list[Row]:
    """What one method says of everything. Raises UnavailableError."""
    align = None if name in capture.WHOLE else method_named(name)
    rows: list[Row] = []
    for set_name, paths in located.paths.items():
        tags = capture.has_tags(paths)
        with tempfile.TemporaryDirectory() as links:
            bands = capture.bands_of(paths, Path(links))
        for variant in variants:
            pairs = pairs_of(sets[set_name], variant)
            if not capture.applies(name, variant, pairs, bands, tags=tags):
                continue
            if align is None:
                with tempfile.TemporaryDirectory() as folder:
                    said = capture.by_command_line(name, paths, pairs, variant, Path(folder))
            else:
                said = [asked(align, pair, variant, paths, bands) for pair in pairs]
            of = {"method": name, "variant": variant}
            rows += [
                {**of, "set": p.set, "capture": p.capture, "file": p.file, **s}
                for p, s in zip(pairs, said, strict=True)
            ]
    return rows


def child(name: str, arguments: Sequence[str]) -> tuple[list[Row], float]:
    """(rows, largest memory in GB) of this script running one method, none where it could not.

    A method that takes its process with it takes no other's.
    """
    with tempfile.NamedTemporaryFile("r", suffix=".json") as file:
        process = subprocess.Popen([sys.executable, __file__, *arguments, "--only", name, "-o", file.name])
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            print(f"{name}: left out", file=sys.stderr)
            return [], 0.0
        return json.load(file), usage.ru_maxrss / 1e6


def tell_missing(located: Located, sets: dict[str, Any]) -> None:
    for name, files in located.missing.items():
        published = sets[name]["published"]
        where = f"{published['repository']}, {published['path']}" if "repository" in published else published["by"]
        print(
            f"{name}: left out, {len(files)} of {len(sets[name]['files'])} files are not there ({where})",
            file=sys.stderr,
        )


def write_said(rows: Iterable[Row], path: Path) -> None:
    """The rows as score.py reads them."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _FIELDS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            cells = {k: json.dumps(v) if k in ("homography", "grid") else v for k, v in row.items()}
            writer.writerow(cells)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results.csv"))
    parser.add_argument("--methods", help=f"separated by ;: FILE.py:FUNCTION, {'; '.join(METHODS)}")
    parser.add_argument("--sets", help="separated by commas")
    parser.add_argument("--variants", help=f"separated by commas: {', '.join(VARIANTS)}")
    parser.add_argument(
        "--jobs", type=int, default=1, help="methods at a time; with more than one, seconds mean little"
    )
    parser.add_argument("--said", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    options = parsed()
    sets = read_sets()
    if options.sets:
        sets = {name: sets[name] for name in options.sets.split(",")}
    variants = options.variants.split(",") if options.variants else VARIANTS
    if unknown := set(variants) - set(VARIANTS):
        sys.exit(f"there is no variant {unknown.pop()}")
    located = locate(options.data, sets)
    if options.only:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of every tag it does not know
        try:
            options.output.write_text(json.dumps(run_method(options.only, located, sets, variants)))
        except UnavailableError as error:
            sys.exit(f"{options.only}: {error}")
        return
    tell_missing(located, sets)
    if not located.paths:
        sys.exit(f"{options.data}: no set is there")
    names = options.methods.split(";") if options.methods else [m for m in METHODS if m not in SLOW]
    arguments = [str(options.data), "--sets", ",".join(located.paths), "--variants", ",".join(variants)]
    with ThreadPoolExecutor(options.jobs) as pool:
        result = dict(zip(names, pool.map(lambda name: child(name, arguments), names), strict=True))
    rows = [row for some, _ in result.values() for row in some]
    if options.said:
        write_said(rows, options.said)
    scored = score_pairs(rows, sets)
    write_csv(summary(scored), options.output)
    text = tables(scored, {name: gigabytes for name, (some, gigabytes) in result.items() if some})
    options.output.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    if options.plot:
        draw(scored, options.plot)


if __name__ == "__main__":
    main()
