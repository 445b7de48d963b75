"""Tables and a figure of the scores."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from common import heat_map, pyplot

from bands.images import VARIANTS
from bands.score import AS_IT_IS, Score, Scored, markdown, summary, table

ALL_SETS = "all sets"


def tables(scored: Sequence[Scored], gigabytes: Mapping[str, float]) -> str:
    """An overview; unmodified images by set; each variant with the sets pooled; and the memory of each method."""
    degraded = summary([s for s in scored if s.variant != AS_IT_IS], ALL_SETS)
    by_variant = {variant: [s for s in degraded if s.variant == variant] for variant in VARIANTS}
    parts = [f"### {variant}\n\n{markdown(scores)}\n" for variant, scores in by_variant.items() if scores]
    memory = "; ".join(f"{name} {value:.1f}" for name, value in gigabytes.items())
    return "\n".join([overview(scored), by_set(scored), *parts, f"Largest process, GB: {memory}.\n"])


def overview(scored: Sequence[Scored]) -> str:
    """Methods by variants, all sets together: pairs claimed within 0.5 px, and wrong claims."""

    def cell(score: Score, pairs: int) -> str:
        # The number of pairs, if the method was not run on all.
        of = "" if score.pairs == pairs else f" of {score.pairs}"
        return f"{round(score.under_half_px * score.pairs)}{of}/**{score.wrong_claims}**"

    return _by_method("", {(s.method, s.variant): s for s in summary(scored, ALL_SETS)}, cell)


def by_set(scored: Sequence[Scored]) -> str:
    """Methods by sets, unmodified images: median error of the claims in px, and wrong claims."""

    def cell(score: Score, _pairs: int) -> str:
        median = "-" if np.isnan(score.median_px) else f"{score.median_px:.3f}"
        return f"{median}/**{score.wrong_claims}**"

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
    """Two heat maps, methods by variants: the share of pairs claimed to half a px, and of wrong claims."""
    scores = {(s.method, s.variant): s for s in summary(scored, ALL_SETS)}
    methods, variants = (list(dict.fromkeys(key[k] for key in scores)) for k in (0, 1))
    size = 13, 1.7 + 0.42 * len(methods)
    figure, axes = pyplot().subplots(1, 2, figsize=size, sharey=True, layout="constrained")
    shares = {key: (s.under_half_px, s.wrong_claims / s.pairs) for key, s in scores.items()}
    titles = "claimed, and within 0.5 px: % of pairs", "wrong claims, more than 1 px off: % of pairs"
    for k, (axis, title, colours) in enumerate(zip(axes, titles, ("Greens", "Reds"), strict=True)):
        grid = np.array([[shares.get((m, v), (np.nan, np.nan))[k] for v in variants] for m in methods])
        heat_map(axis, grid, methods, variants, cmap=colours)
        axis.set_title(title, fontsize=11)
    figure.savefig(path, dpi=85)
