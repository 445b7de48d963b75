"""Calibration of the reported uncertainty: aligns a synthetic flight and compares it with its exact homographies.

    python benchmarks/uncertainty.py [captures, by default 12] [rng seed]

At each corner of the reference and along each axis, the error should lie within one reported standard deviation in
68 % and within 1.96 of them in 95 % of the cases.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import agalign
from agalign.synthetic import flight as synthetic
from agalign.values import geometry


def main() -> None:
    captures = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    rng_seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    ratios: dict[str, list[float]] = {}
    errors: dict[str, list[float]] = {}
    claims: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "flight", Path(folder) / "aligned"
        truth = json.loads(synthetic.make_flight(source, captures, rng_seed=rng_seed).read_text())
        for report in agalign.align_folder(source, out):
            for band in report.sidecar.bands if report.sidecar else ():
                if band.status != "aligned":
                    continue
                true = np.array(truth[report.sidecar.capture]["bands"][band.file]["fixed_to_moving"])
                size = report.sidecar.reference.width, report.sidecar.reference.height
                corners = geometry.corners(*size)
                back = geometry.compose(geometry.invert(true), np.array(band.homography.fixed_to_moving))
                error = geometry.apply(back, corners) - corners
                std = np.array(band.joint.corner_std_xy_px)
                ratios.setdefault(band.band, []).extend(np.abs(error / std).ravel())
                errors.setdefault(band.band, []).extend(np.abs(error).ravel())
                claims.setdefault(band.band, []).extend(std.ravel())
    print("| band | corners x axes | within 1 std (68 %) | within 1.96 std (95 %) | rms error, px | rms std, px |")
    print("|---|---|---|---|---|---|")
    for name in [*ratios, "all"]:
        r, e, s = (
            np.concatenate(list(table.values())) if name == "all" else np.array(table[name])
            for table in (ratios, errors, claims)
        )
        print(
            f"| {name} | {len(r)} | {(r <= 1).mean():.0%} | {(r <= 1.96).mean():.0%} "
            f"| {np.sqrt((e**2).mean()):.3f} | {np.sqrt((s**2).mean()):.3f} |"
        )


if __name__ == "__main__":
    main()
