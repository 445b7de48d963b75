"""Errors of synthetic flights on two headings, for cameras without public images with ground truth: a table.

python benchmarks/cameras.py [CAPTURES] [CAMERA ...]

Cameras are painted with half of their pixels along each side but for the Altum, whose thermal band is small as it is.
"""

import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_two_headings

import agalign
from agalign.cameras.discover import DiscoverOptions
from agalign.synthetic.rig import CameraSpec
from agalign.synthetic.score import Score, score_against_truth

CAMERAS: dict[str, tuple[CameraSpec, tuple[int, int]]] = {
    "mavic": (MAVIC, (1280, 960)),
    "mavic-3m": (MAVIC_3M, (1296, 972)),
    "altum": (ALTUM, (2064, 1544)),
    "altum-pt": (ALTUM_PT, (1032, 772)),
    "6x": (SENTERA_6X, (1024, 768)),
}


def main(captures: int, names: list[str]) -> None:
    print("| camera | band | aligned | predicted | other | median, px | worst capture, px | in its own px |")
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        camera, size_px = CAMERAS[name]
        with tempfile.TemporaryDirectory() as temporary:
            folder, out = Path(temporary) / "flight", Path(temporary) / "aligned"
            truth = make_two_headings(folder, captures, size_px, camera=camera, line=captures // 2, lakes=False)
            began = time.perf_counter()
            reports = agalign.align_folder(folder, out, options=DiscoverOptions(with_rgb=True))
            seconds = time.perf_counter() - began
            by_band = defaultdict[str, list[Score]](list)
            for score in score_against_truth(reports, truth):
                by_band[score.band].append(score)
            coarse = {b.name: b.size_ratio[0] / b.view * camera.bands[camera.reference].view for b in camera.bands}
            for band, scores in by_band.items():
                counts = [sum(s.status == status for s in scores) for status in ("aligned", "predicted")]
                own = np.array([s.median_px for s in scores])
                # The grid of the sidecar contains positions in the moving file.
                there, here = own, own / coarse[band]
                print(
                    f"| {name} | {band} | {counts[0]} | {counts[1]} | {len(scores) - sum(counts)} | "
                    f"{np.median(here):.3f} | {here.max():.3f} | {np.median(there):.3f} / {there.max():.3f} |"
                )
            print(f"| {name} | all | | | | | | {seconds / captures:.1f} s a capture |", flush=True)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    main(count, sys.argv[2:] or list(CAMERAS))
