"""Shares of errors below the expected error, by the distance from the windows that measure the alignment.

    pip install -e '.[bench]' && python benchmarks/errors_by_distance.py DATA

Pairs of the comparison (`bands/run.py`) with a blurred, noisy or half-saturated moving band are aligned without tags.
The errors are measured at their tie points, whose noise is not part of the expected error. How that grows with the
distance is decided by `_FAR_VARIANCE_FACTOR` and `_FAR_SPACINGS` in agalign/values/mapping_error.py. With normally
distributed errors, 0.63 of them are below one expected error and 0.98 below two.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from bands import score
from bands.images import degraded, locate, read
from common import print_head, print_row, run
from scipy.spatial import cKDTree

import agalign

VARIANTS = "blur 3 px", "noise 30 %", "half saturated"
SPACINGS = 0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, np.inf
"""Limits of the distance from the nearest measured window, in spacings of the windows."""


def errors(fixed: np.ndarray, moving: np.ndarray, pair: score.Pair) -> np.ndarray:
    """Return (n, 3): distance from the windows in spacings, error, and expected error, px of the reference; empty for a
    pair that is neither aligned nor predicted.
    """
    result = agalign.align(fixed, moving)
    residual = None if result.error is None else result.error.residual
    if result.status not in ("aligned", "predicted") or residual is None or not residual.is_measured.any():
        return np.empty((0, 3))
    distance_px, _ = cKDTree(residual.measured_px).query(pair.reference_px)
    error_px = np.linalg.norm(result.map(pair.reference_px) - pair.moving_px, axis=1)
    columns = distance_px / residual.spacing_px, error_px, result.error_px(pair.reference_px)
    return np.stack(columns, axis=1)[np.isfinite(error_px)]


def main(data: Path) -> None:
    """Print the shares of all pairs whose images are below DATA."""
    known = score.read_sets()
    located, _ = locate(data, known)
    if not located:
        sys.exit(f"{data}: contains no complete set")
    found = [np.empty((0, 3))]
    for variant in VARIANTS:
        for name, paths in located.items():
            for pair in score.pairs_of(known[name], variant):
                fixed, moving = read(paths[pair.reference]), degraded(read(paths[pair.file]), pair, variant)
                found.append(errors(fixed, moving, pair))
    spacings, error_px, expected_px = np.concatenate(found).T
    print_head("distance, spacings", "tie points", "within 1", "within 2", "RMS error, px", "RMS expected, px")
    for low, high in pairwise(SPACINGS):
        some = (spacings >= low) & (spacings < high)
        if some.any():
            shares = [f"{np.mean(error_px[some] <= n * expected_px[some]):.2f}" for n in (1, 2)]
            rms = [f"{np.sqrt(np.square(values[some]).mean()):.2f}" for values in (error_px, expected_px)]
            print_row(f"{low:g} to {high:g}", some.sum(), *shares, *rms)


if __name__ == "__main__":
    run(main)
