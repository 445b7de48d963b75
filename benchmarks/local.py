"""What local displacements gain over relief: synthetic flights with terraces and trees, against their exact truth.

python benchmarks/local.py [RELIEF_M...]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import agalign
from agalign.config import LocalSettings, Settings
from agalign.synthetic.flight import make_flight
from agalign.synthetic.score import score_against_truth


def main(reliefs_m: list[float]) -> None:
    print("| relief, m | local | median, px | 95 %, px | worst band's 95 % | aligned |\n|---|---|---|---|---|---|")
    for relief_m in reliefs_m:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            truth = make_flight(folder / "flight", 2, rng_seed=5, relief_m=relief_m)
            for use in (False, True):
                settings = Settings(local=LocalSettings(use=use))
                reports = agalign.align_folder(folder / "flight", folder / f"aligned-{use}", settings=settings)
                scores = score_against_truth(reports, truth)
                median, p95 = (np.mean([getattr(s, name) for s in scores]) for name in ("median_px", "p95_px"))
                worst = max(s.p95_px for s in scores)
                aligned = sum(s.status == "aligned" for s in scores)
                cells = f"{median:.3f} | {p95:.3f} | {worst:.3f} | {aligned} of {len(scores)}"
                print(f"| {relief_m:g} | {'yes' if use else 'no'} | {cells} |", flush=True)


if __name__ == "__main__":
    main([float(v) for v in sys.argv[1:]] or [0.0, 2.0, 4.0])
