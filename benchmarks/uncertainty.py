"""Calibration of the reported uncertainty: aligns a synthetic flight and compares it with its exact homographies.

    python benchmarks/uncertainty.py [captures, by default 12] [rng seed]

At each corner of the reference and along each axis, the error should lie within one reported standard deviation in
68 % and within 1.96 of them in 95 % of the cases.
"""

import numpy as np
from common import Number, flight_and_out, print_head, print_row, read_ties, run

import agalign
from agalign.synthetic.flight import make_flight
from agalign.values import geometry


def main(captures: Number = 12, rng_seed: Number = 1) -> None:
    bands: dict[str, list[np.ndarray]] = {}
    with flight_and_out() as (flight, out):
        truth = read_ties(make_flight(flight, captures, rng_seed=rng_seed))
        sidecars = [r.sidecar for r in agalign.align_folder(flight, out) if r.sidecar]
    for sidecar in sidecars:
        corners = geometry.corners(sidecar.reference.width, sidecar.reference.height)
        for band in (b for b in sidecar.bands if b.status == "aligned"):
            true = geometry.invert(np.array(truth[band.file]["fixed_to_moving"]))
            back = geometry.compose(true, np.array(band.homography.fixed_to_moving))
            error = np.abs(geometry.apply(back, corners) - corners)
            bands.setdefault(band.band, []).append(np.stack([error, np.array(band.joint.corner_std_xy_px)]))
    print_head(
        "band", "corners x axes", "within 1 std (68 %)", "within 1.96 std (95 %)", "rms error, px", "rms std, px"
    )
    for name in (*bands, "all"):
        some = [one for band, values in bands.items() if name in (band, "all") for one in values]
        error, std = np.concatenate(some, axis=1).reshape(2, -1)
        shares = [f"{(error <= times * std).mean():.0%}" for times in (1, 1.96)]
        print_row(name, error.size, *shares, *(f"{np.sqrt((values**2).mean()):.3f}" for values in (error, std)))


if __name__ == "__main__":
    run(main)
