"""Runs methods on the band pairs of the sets that are on disk, and scores what they claim.

    pip install -e '.[bench]' && python benchmarks/bands/run.py DATA [-o results.csv] [--plot FILE] [--figures]
        [--methods 'SIFT + RANSAC;mine.py:align'] [--sets p4m_forest,...] [--variants 'as it is,turn 10,...']

DATA is any folder: images are recognised by their checksums, and missing sets are listed with their publisher. Each
method runs in a process of its own with as many threads as it takes; one that raises has refused the pair. Scores are
written to -o, and as tables next to it (.md); the mapping of each pair to --mappings, in the format of score.py. With
--figures, those of the methods that were run also replace the scores of these methods in results.csv next to this file,
from which the comparison in docs/figures/figures.csv is counted.
"""

import csv
import json
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, its package is not found

from common import align, flight_and_out, heat_map, pyplot, run, timed, write_band
from figures_csv import FiguresOption, TableRow, write_figures
from peers import METHODS, Align, grey_raster, method_named

from agalign.cameras.discover import discover
from agalign.pixels.raster import suffix_format
from agalign.records.sidecar import BandResult
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values import geometry, lens
from agalign.values.capture import Band
from agalign.values.mapping import PixelMapping
from bands import score
from bands.images import LENS_CORRECTED, VARIANTS, Image, Paths, degraded, locate, read, straightened
from bands.score import AS_IT_IS, Pair, Score, Scored, summary, table

WHOLE = {"agalign, capture": (), "agalign, capture, no tags": ("--ignore-metadata",)}
"""Runs of the command line on a whole flight, with its files and tags: options by name."""
ALL_METHODS = (*METHODS, *WHOLE)
RESULTS = Path(__file__).with_name("results.csv")
COMMAND = "python benchmarks/bands/run.py DATA"
"""Runs of some methods add up to this one."""
SHORT = "agalign, pair", "SIFT + RANSAC", "ECC on gradients", "agalign, capture"
"""Methods in the table of the published sets."""
Row = dict[str, Any]
_FIELDS = ("method", "set", "capture", "file", "variant", "claimed", "seconds", "homography", "grid")


def _grid(reference_px: Any, moving_px: Any) -> Row:
    return {"reference_px": np.round(reference_px, 4).tolist(), "moving_px": np.round(moving_px, 4).tolist()}


# ---- the program on a whole flight


def by_command_line(method: str, paths: Paths, pairs: Sequence[Pair], variant: str) -> list[Row]:
    """`agalign FOLDER` on the files of a set, with degraded moving bands of the pairs; the rest of the flight is
    unchanged. A band is claimed if it is aligned; a predicted one is given and not claimed.
    """
    with flight_and_out() as (flight, out):
        flight.mkdir()
        for name, path in paths.items():
            shutil.copyfile(path, flight / name)
        for pair in pairs if variant != AS_IT_IS else ():
            write_band(flight / pair.file, degraded(read(paths[pair.file]), pair, variant))
        seconds = align(flight, out, *WHOLE[method]) / (len(paths) - len({p.reference for p in pairs}))
        bands = {band.file: band for path in find_sidecars(out) for band in read_sidecar(path).bands}
    return [{**claim(bands.get(pair.file)), "seconds": seconds} for pair in pairs]


def claim(band: BandResult | None) -> Row:
    """Return the mapping of a band in a sidecar, if it has one, and whether it is claimed."""
    if band is None or band.status not in ("aligned", "predicted") or band.grid is None:
        return {}
    claimed = "yes" if band.status == "aligned" else "no"
    return {"grid": _grid(band.grid.reference_px, band.grid.moving_px), "claimed": claimed}


# ---- pair methods


def bands_of(paths: Paths) -> dict[str, Band]:
    """Return the bands with the lenses of a set's files by name; none for files without tags."""
    if not has_tags(paths):
        return {}
    with tempfile.TemporaryDirectory() as folder:
        for name, path in paths.items():
            Path(folder, name).symlink_to(path.resolve())
        return {band.path.name: band for capture in discover(Path(folder)).captures for band in capture.bands}


def has_tags(paths: Paths) -> bool:
    """Return True for files of a camera, which are a flight."""
    return all(suffix_format(path) == "TIFF" for path in paths.values())


def lens_corrected(method: Align, fixed: tuple[Image, Band], moving: tuple[Image, Band]) -> Row:
    """Return the mapping by a pair method of images without distortion, as a grid between the raw pixels of the files.
    The correction is not included in its seconds.
    """
    images = [straightened(replace(grey_raster(image), lens=band.lens)) for image, band in (fixed, moving)]
    seconds, matrix = timed(method, images[0].pixels, images[1].pixels)
    if matrix is None:
        return {"seconds": seconds}
    here = geometry.lattice(*images[0].size_px, 33, 25)
    there = PixelMapping(geometry.normalised(matrix), fixed[1].lens, moving[1].lens)(here)
    return {"grid": _grid(here, there), "seconds": seconds}


def asked(method: Align, pair: Pair, variant: str, paths: Paths, bands: Mapping[str, Band]) -> Row:
    """Return the mapping of a pair by a pair method; an exception is a refusal."""
    fixed, moving = read(paths[pair.reference]), degraded(read(paths[pair.file]), pair, variant)
    try:
        if variant == LENS_CORRECTED:
            return lens_corrected(method, (fixed, bands[pair.reference]), (moving, bands[pair.file]))
        seconds, matrix = timed(method, fixed, moving)
    except Exception as error:  # any exception of a method
        print(f"{pair.key}, {variant}: refused ({type(error).__name__}: {error})", file=sys.stderr)
        return {}
    return {"seconds": seconds} | ({} if matrix is None else {"homography": np.asarray(matrix, float).tolist()})


# ---- tables and a figure


def tables(scored: Sequence[Scored], gigabytes: Mapping[str, float]) -> str:
    """An overview; unmodified images by set; each variant with the sets pooled; and the memory of each method."""
    pooled = summary([s for s in scored if s.variant != AS_IT_IS], "all sets")
    by_variant = {variant: [s for s in pooled if s.variant == variant] for variant in VARIANTS}
    parts = [f"### {variant}\n\n{score.markdown(scores)}\n" for variant, scores in by_variant.items() if scores]
    memory = "; ".join(f"{name} {value:.1f}" for name, value in gigabytes.items())
    return "\n".join([overview(scored), by_set(scored), *parts, f"Largest process, GB: {memory}.\n"])


def overview(scored: Sequence[Scored]) -> str:
    """Methods by variants, all sets together: pairs claimed within 0.5 px, and wrong claims."""

    def cell(s: Score, pairs: int) -> str:
        # The number of pairs, if the method was not run on all.
        of = "" if s.pairs == pairs else f" of {s.pairs}"
        return f"{round(s.under_half_px * s.pairs)}{of}/**{s.wrong_claims}**"

    return _by_method("", {(s.method, s.variant): s for s in summary(scored, "all sets")}, cell)


def by_set(scored: Sequence[Scored]) -> str:
    """Methods by sets, unmodified images: median error of the claims in px, and wrong claims."""

    def cell(s: Score, _pairs: int) -> str:
        median = "-" if np.isnan(s.median_px) else f"{s.median_px:.3f}"
        return f"{median}/**{s.wrong_claims}**"

    scores = summary([s for s in scored if s.variant == AS_IT_IS])
    return _by_method("method", {(s.method, s.set): s for s in scores}, cell)


def _by_method(corner: str, scores: Mapping[tuple[str, str], Score], cell: Callable[[Score, int], str]) -> str:
    """A row for each method, a column for each variant or set, with its number of pairs in the head."""
    methods, columns = (dict.fromkeys(key[k] for key in scores) for k in (0, 1))
    pairs = {c: max(s.pairs for (_, column), s in scores.items() if column == c) for c in columns}
    rows = [
        [method, *(cell(scores[method, c], pairs[c]) if (method, c) in scores else "-" for c in columns)]
        for method in methods
    ]
    return table([[corner, *(f"{c} ({n})" for c, n in pairs.items())], *rows]) + "\n"


def draw(scored: Sequence[Scored], path: Path) -> None:
    """Draw two heat maps, methods by variants: shares of pairs accepted within 0.5 px, and of wrong pairs."""
    scores = summary(scored, "all sets")
    methods, variants = (list(dict.fromkeys(getattr(s, name) for s in scores)) for name in ("method", "variant"))
    grids = np.full((2, len(methods), len(variants)), np.nan)
    for s in scores:
        grids[:, methods.index(s.method), variants.index(s.variant)] = s.under_half_px, s.wrong_claims / s.pairs
    size = 13, 1.7 + 0.42 * len(methods)
    figure, axes = pyplot().subplots(1, 2, figsize=size, sharey=True, layout="constrained")
    titles = "accepted, error up to 0.5 px: % of pairs", "accepted, wrong by more than 1 px: % of pairs"
    names = [score.VARIANT_NAMES.get(v, v) for v in variants]
    for axis, grid, title, colours in zip(axes, grids, titles, ("Greens", "Reds"), strict=True):
        heat_map(axis, grid, methods, names, cmap=colours)
        axis.set_title(title, fontsize=11)
    figure.savefig(path, dpi=85)


# ---- methods on all sets


def applies(name: str, variant: str, pairs: Sequence[Pair], bands: Mapping[str, Band], paths: Paths) -> bool:
    """Return False for images without a lens to correct, and for the program on corrected images or without tags."""
    if variant == LENS_CORRECTED:
        used = [bands.get(file) for p in pairs for file in (p.reference, p.file)]
        return name not in WHOLE and all(b is not None and lens.is_distorting(b.lens) for b in used)
    return name not in WHOLE or has_tags(paths)


def run_method(
    located: Mapping[str, Paths], sets: dict[str, Any], variants: Sequence[str], name: str
) -> tuple[list[Row], float]:
    """Return (rows of one method for all pairs, memory of the largest process in GB). Raises UnavailableError."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of every unknown tag
    method = None if name in WHOLE else method_named(name)
    rows: list[Row] = []
    for set_name, paths in located.items():
        bands = bands_of(paths)
        for variant in variants:
            pairs = score.pairs_of(sets[set_name], variant)
            if not applies(name, variant, pairs, bands, paths):
                continue
            if method is None:
                mapped = by_command_line(name, paths, pairs, variant)
            else:
                mapped = [asked(method, pair, variant, paths, bands) for pair in pairs]
            for pair, row in zip(pairs, mapped, strict=True):
                key = dict(zip(("set", "capture", "file"), pair.key, strict=True))
                rows.append({"method": name, "variant": variant, **key, **row})
    processes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return rows, max(resource.getrusage(one).ru_maxrss for one in processes) / 1e6


def in_its_process(function: Any, name: str) -> tuple[list[Row], float]:
    """Return the result of a method in a process of its own, which may crash; no rows without a result."""
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(function, name).result()
    except Exception as error:  # any exception of a method
        print(f"{name}: left out ({error})", file=sys.stderr)
        return [], 0.0


def print_missing(missing: Mapping[str, Sequence[str]], sets: dict[str, Any]) -> None:
    for name, files in missing.items():
        published = sets[name]["published"]
        where = f"{published['repository']}, {published['path']}" if "repository" in published else published["by"]
        count = f"{len(files)} of {len(sets[name]['files'])}"
        print(f"{name}: left out, {count} files are missing ({where})", file=sys.stderr)


def write_mappings(rows: Iterable[Row], path: Path) -> None:
    """Write the rows in the format that score.py reads."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _FIELDS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: json.dumps(v) if k in ("homography", "grid") else v for k, v in row.items()})


# ---- figures


def replace_scores(path: Path, scores: Sequence[Score]) -> list[Score]:
    """Replace the scores of some methods in a file, keep those of others and the order, and return all."""
    by_method: dict[str, list[Score]] = {}
    for s in score.read_scores(path):
        by_method.setdefault(s.method, []).append(s)
    by_method |= {method: [s for s in scores if s.method == method] for method in {s.method: s for s in scores}}
    result = [s for some in by_method.values() for s in some]
    score.write_csv(result, path)
    return result


def comparison(scores: Sequence[Score], sets: Mapping[str, Any]) -> Iterable[TableRow]:
    """Yield the rows of methods on all sets, and on the published ones; the identity aligns nothing."""
    published = [s for s in scores if "repository" in sets[s.set]["published"] and s.method in SHORT]
    for name, some in (("comparison", scores), ("comparison on published sets", published)):
        for method in {s.method: s for s in some if s.method != "identity"}:
            own = [s for s in some if s.method == method]
            cells = {
                "accepted": sum(s.claimed for s in own),
                "wrong by more than 1 px": sum(s.wrong_claims for s in own),
                "accepted within 0.5 px": sum(round(s.under_half_px * s.pairs) for s in own),
            }
            yield TableRow(name, method, f"{sum(s.pairs for s in own)} pairs", cells)


def main(
    data: Path,
    output: Annotated[Path, typer.Option("-o", "--output")] = Path("results.csv"),
    methods: Annotated[str, typer.Option(help="separated by ;, FILE.py:FUNCTION among them")] = ";".join(ALL_METHODS),
    sets: Annotated[str, typer.Option(help="separated by commas; by default all")] = "",
    variants: Annotated[str, typer.Option(help="separated by commas")] = ",".join(VARIANTS),
    jobs: Annotated[int, typer.Option(help="methods at a time; above one, seconds mean little")] = 1,
    mappings: Path | None = None,
    plot: Path | None = None,
    *,
    figures: FiguresOption = False,
) -> None:
    if figures and (sets or variants != ",".join(VARIANTS)):
        sys.exit("--figures needs all sets and variants; omit --sets and --variants")
    known = score.read_sets()
    if sets:
        known = {name: known[name] for name in sets.split(",")}
    if unknown := set(variants.split(",")) - set(VARIANTS):
        sys.exit(f"unknown variant '{unknown.pop()}'; choose from {', '.join(VARIANTS)}")
    located, missing = locate(data, known)
    print_missing(missing, known)
    if not located:
        sys.exit(f"{data}: contains no complete set")
    names = methods.split(";")
    one = partial(in_its_process, partial(run_method, located, known, variants.split(",")))
    with ThreadPoolExecutor(jobs) as pool:
        result = dict(zip(names, pool.map(one, names), strict=True))
    rows = [row for some, _ in result.values() for row in some]
    if mappings:
        write_mappings(rows, mappings)
    scored = score.score_pairs(rows, known)
    score.write_csv(summary(scored), output)
    if figures:
        write_figures(comparison(replace_scores(RESULTS, summary(scored)), known), command=COMMAND)
    text = tables(scored, {name: gigabytes for name, (some, gigabytes) in result.items() if some})
    output.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    if plot:
        draw(scored, plot)


if __name__ == "__main__":
    run(main)
