"""Errors of the seeds of each camera, px: median and maximum over pairs, by kind of seed.

    python benchmarks/seeds.py DATA

DATA holds captures below flights/ and captures/, some with reference ties in ties.json. Without ties, the error is the
residual in windows of the two bands, where there is one.
"""

from pathlib import Path

import numpy as np
from common import Ties, print_head, print_row, read_ties, run

from agalign.cameras.discover import discover
from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.seeding import best_seed
from agalign.config import SeedSettings
from agalign.values import geometry
from agalign.values.mapping import PixelMapping

KINDS = ("identity", "rig", "structure", "chosen")


def seeds_of(pair: BandPair) -> dict[str, PixelMapping]:
    """Return the mappings between raw px of each kind of seed, and of the one that a run selects."""
    plain = geometry.overlay(pair.fixed.size_px, pair.moving.size_px)
    result = {"identity": PixelMapping(plain)}
    if "rig" in pair.seed_matrices:
        result["rig"] = pair.mapping(pair.seed_matrices["rig"])
    shifted = best_seed(pair, {"identity": plain})
    if shifted.kind == "structure":
        result["structure"] = pair.mapping(shifted.fixed_to_moving)
    result["chosen"] = pair.mapping(best_seed(pair, pair.seed_matrices).fixed_to_moving)
    return result


def error_px(pair: BandPair, mapping: PixelMapping, truth: Ties) -> float:
    """Return the median error of a pair at its ties, or without truth in windows."""
    if not truth:
        return pair.reference.windows.residuals(pair.warped_moving(mapping)).median_px
    ties = np.array(truth[pair.bands[0].path.name]["ties"])
    return float(np.median(np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)))


def main(data: Path) -> None:
    print_head("camera, set", "pairs", *KINDS)
    for folder in sorted(p for part in ("flights", "captures") for p in (data / part).iterdir() if p.is_dir()):
        truth, errors = read_ties(folder / "ties.json"), {kind: list[float]() for kind in KINDS}
        for pair in (p for capture in discover(folder).captures for p in read_pairs(capture, SeedSettings())[0]):
            if not truth or pair.bands[0].path.name in truth:
                for kind, mapping in seeds_of(pair).items():
                    errors[kind].append(error_px(pair, mapping, truth))
        cells = [f"{np.median(v):.1f} / {max(v):.1f}" if v else "-" for v in errors.values()]
        print_row(f"{folder.name}{'' if truth else ', by windows'}", len(errors["identity"]), *cells)


if __name__ == "__main__":
    run(main)
