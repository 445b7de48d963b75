"""Errors of the seeds of each camera: the table of docs/cameras.md.

    python benchmarks/seeds.py DATA

DATA holds captures below flights/ and captures/, with reference ties in ties.json beside them. Without ties the windows
of the two bands tell what is left, where they can.
"""

import json
import sys
from pathlib import Path

import numpy as np

from agalign.cameras.discover import discover
from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.seeding import best_seed
from agalign.config import SeedSettings
from agalign.values import geometry
from agalign.values.capture import Capture
from agalign.values.mapping import PixelMapping

KINDS = ("identity", "rig", "structure", "chosen")


def seeds_of(pair: BandPair) -> dict[str, PixelMapping]:
    """Return the mappings between raw px of each kind of seed, and of the one that a run selects."""
    plain = geometry.overlay(pair.fixed.size_px, pair.moving.size_px)
    result = {"identity": PixelMapping(plain)}
    if "rig" in pair.candidates:
        result["rig"] = pair.mapping(pair.candidates["rig"])
    shifted = best_seed(pair, {"identity": plain})
    if shifted.kind == "structure":
        result["structure"] = pair.mapping(shifted.fixed_to_moving)
    result["chosen"] = pair.mapping(best_seed(pair, pair.candidates).fixed_to_moving)
    return result


def errors(capture: Capture, ties: dict | None) -> dict[str, list[float]]:
    """Return the median error of each pair, px, by kind of seed."""
    pairs, _ = read_pairs(capture, SeedSettings())
    result: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for pair in pairs:
        known = None if ties is None else ties["bands"].get(pair.bands[0].path.name)
        if ties is not None and known is None:
            continue
        for kind, mapping in seeds_of(pair).items():
            if known is not None:
                points = np.array(known["ties"])
                error = np.linalg.norm(mapping(points[:, :2]) - points[:, 2:], axis=1)
                result[kind].append(float(np.median(error)))
            else:
                result[kind].append(pair.reference.windows.residuals(pair.warped_moving(mapping)).median_px)
    return result


def main(data: Path) -> None:
    print("| camera, set | pairs | " + " | ".join(KINDS) + " |\n|---|---|" + "---|" * len(KINDS))
    for folder in sorted(p for p in [*(data / "flights").iterdir(), *(data / "captures").iterdir()] if p.is_dir()):
        ties_path = folder / "ties.json"
        truth = json.loads(ties_path.read_text()) if ties_path.is_file() else None
        totals: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for capture in discover(folder).captures:
            files = {b.path.name for b in capture.bands}
            ties = next((t for t in truth.values() if t["reference"] in files), None) if truth else None
            for kind, values in errors(capture, ties).items():
                totals[kind] += values
        cells = [f"{np.median(v):.1f} / {max(v):.1f}" if v else "-" for v in totals.values()]
        name = f"{folder.name}{'' if truth else ', by windows'}"
        print(f"| {name} | {len(totals['identity'])} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
