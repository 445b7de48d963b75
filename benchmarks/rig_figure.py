"""Draw the rig of a model file: positions of the lenses, and displacements that the lens models do not include.

python benchmarks/rig_figure.py MODEL.safetensors FIGURE.png
"""

from pathlib import Path

import numpy as np
from common import pyplot, run

from agalign.flight.model import load_model
from agalign.method.device import choose_device
from agalign.values import geometry

COLOURS = {"blue": "#3465c8", "green": "#2f9e44", "red": "#d6363e", "nir": "#7a3fb0", "red edge": "#e07b1a"}
_TIMES = 800
"""Scale of the arrows of the displacement field."""


def main(model_path: Path, figure_path: Path) -> None:
    model = load_model(model_path, lambda: choose_device("cpu"))
    if model.rig is None:
        raise SystemExit(f"{model_path}: contains no rig")
    rig, bands = model.rig, list(model.rig.mean)
    figure, axes = pyplot().subplots(1, 1 + len(bands), figsize=(3.1 * (1 + len(bands)), 3.2), layout="constrained")
    plan = axes[0]
    plan.plot(0, 0, "o", color="0.4", markersize=9)
    plan.annotate("reference", (0, 0), textcoords="offset points", xytext=(8, 6), color="0.3")
    for band in bands:
        x, y = rig.baselines[band]
        colour = COLOURS.get(band.lower(), "0.2")
        plan.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2})
        plan.annotate(band, (x, y), textcoords="offset points", xytext=(5, 4), color=colour, weight="bold")
    reach = 1.25 * max(max(map(abs, rig.baselines[b])) for b in bands)
    plan.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", title="baselines, all together 1")
    plan.axhline(0, color="0.9", zorder=0)
    plan.axvline(0, color="0.9", zorder=0)
    for axis, band in zip(axes[1:], bands, strict=True):
        width, height = rig.size_px
        axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
        if band not in rig.fields:
            axis.set_title(f"{band}: no field")
            continue
        points = geometry.lattice(width, height, 13, 10)
        apart = rig.fields[band](points)
        length = np.linalg.norm(apart, axis=1)
        style = {"angles": "xy", "scale_units": "xy", "scale": 1, "cmap": "viridis", "clim": (0, 0.25), "width": 0.006}
        axis.quiver(*points.T, *(_TIMES * apart.T), length, **style)
        axis.set_title(f"{band}: up to {length.max():.2f} px")
    figure.suptitle(f"{len(rig.captures)} captures; arrows of the lens fields {_TIMES} times as long", fontsize=9)
    figure.savefig(figure_path, dpi=70)


if __name__ == "__main__":
    run(main)
