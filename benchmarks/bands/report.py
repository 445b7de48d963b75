"""Tables and a figure of the scores."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bands.score import AS_IT_IS, Score, Scored, markdown, summary


def tables(scored: Sequence[Scored], gigabytes: Mapping[str, float]) -> str:
    """An overview; unmodified images by set; each variant with the sets pooled; and the memory of each method."""
    groups: dict[str, list[Score]] = {}
    for score in summary([s for s in scored if s.variant != AS_IT_IS], "all sets"):
        groups.setdefault(score.variant, []).append(score)
    parts = [
        overview(scored),
        by_set(scored),
        *(f"### {title}\n\n{markdown(scores)}\n" for title, scores in groups.items()),
    ]
    memory = "; ".join(f"{name} {value:.1f}" for name, value in gigabytes.items())
    return "\n".join([*parts, f"Largest process, GB: {memory}.\n"])


def overview(scored: Sequence[Scored]) -> str:
    """Methods by variants, all sets together: pairs claimed within 0.5 px, and wrong claims."""
    scores, methods, variants = _by_method_and_variant(scored)
    pairs = {v: max(s.pairs for (_, w), s in scores.items() if v == w) for v in variants}
    lines = ["| | " + " | ".join(f"{v} ({n})" for v, n in pairs.items()) + " |", "|---" * (1 + len(variants)) + "|"]
    for method in methods:
        cells = [_overview_cell(scores.get((method, v)), pairs[v]) for v in variants]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def by_set(scored: Sequence[Scored]) -> str:
    """Methods by sets, unmodified images: median error of the claims in px, and wrong claims."""
    scores = summary([s for s in scored if s.variant == AS_IT_IS])
    pairs: dict[str, int] = {}
    for score in scores:
        pairs[score.set] = max(score.pairs, pairs.get(score.set, 0))
    lines = ["| method | " + " | ".join(f"{name} ({n})" for name, n in pairs.items()) + " |"]
    lines.append("|---" * (1 + len(pairs)) + "|")
    for method in dict.fromkeys(score.method for score in scores):
        own = {score.set: score for score in scores if score.method == method}
        cells = [_set_cell(own.get(name)) for name in pairs]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _set_cell(score: Score | None) -> str:
    if score is None:
        return "-"
    median = "-" if np.isnan(score.median_px) else f"{score.median_px:.3f}"
    return f"{median} / **{score.wrong_claims}**"


def _overview_cell(score: Score | None, pairs: int) -> str:
    """A method that is not asked of all pairs says of how many it was."""
    if score is None:
        return "-"
    of = "" if score.pairs == pairs else f" of {score.pairs}"
    return f"{round(score.under_half_px * score.pairs)}{of} / **{score.wrong_claims}**"


def _by_method_and_variant(scored: Sequence[Scored]) -> tuple[dict[tuple[str, str], Score], list[str], list[str]]:
    scores = {(s.method, s.variant): s for s in summary(scored, "all sets")}
    methods, variants = (list(dict.fromkeys(key[k] for key in scores)) for k in (0, 1))
    return scores, methods, variants


def draw(scored: Sequence[Scored], path: Path) -> None:
    """Two heat maps, methods by variants: the share of pairs claimed to half a px, and of wrong claims."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    scores, methods, variants = _by_method_and_variant(scored)
    figure, axes = plt.subplots(1, 2, figsize=(13, 0.5 + 0.42 * len(methods) + 1.2), sharey=True, layout="constrained")
    for axis, title, colours, values in (
        (axes[0], "claimed, and within 0.5 px: % of pairs", "Greens", lambda s: 100 * s.under_half_px),
        (axes[1], "wrong claims, more than 1 px off: % of pairs", "Reds", lambda s: 100 * s.wrong_claims / s.pairs),
    ):
        grid = np.array([[_value(scores.get((m, v)), values) for v in variants] for m in methods])
        axis.imshow(np.nan_to_num(grid), cmap=colours, vmin=0, vmax=100, aspect="auto")
        for (row, column), value in np.ndenumerate(grid):
            text = "-" if np.isnan(value) else f"{value:.0f}"
            axis.text(column, row, text, ha="center", va="center", color="white" if value > 60 else "black", fontsize=9)
        axis.set_xticks(range(len(variants)), variants, rotation=40, ha="right")
        axis.set_yticks(range(len(methods)), methods)
        axis.set_title(title, fontsize=11)
    figure.savefig(path, dpi=85)


def _value(score: Score | None, of: object) -> float:
    return np.nan if score is None else of(score)  # type: ignore[operator]
