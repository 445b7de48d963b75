"""Results for a flight with many faults, and for a camera that exposes its bands one after another.

    python benchmarks/flight_troubles.py [captures, by default 60] [rng seed]

The synthetic flights are aligned with the defaults. Errors are medians over a band's true ties, compared with the
standard error in the sidecar; the time per capture is compared with that of a flight of the same length without faults.
"""

from collections import Counter
from functools import partial

import numpy as np
from common import (
    WRONG_PX,
    BandError,
    Number,
    Ties,
    align,
    band_errors,
    flight_and_out,
    print_head,
    print_row,
    read_ties,
    run,
)
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.synthetic.flight import make_flight


def report(bands: list[BandError], truth: Ties) -> None:
    """Print a table of one aligned flight."""
    by_trouble: dict[str, list[BandError]] = {}
    for band in bands:
        by_trouble.setdefault(truth[band.file]["trouble"] or "none", []).append(band)
    print_head("trouble", "captures", "bands", "statuses", "median error, px", "worst error, px", "worst error / std")
    for trouble, some in by_trouble.items():
        errors, std = np.array([(b.median_px, b.std_px) for b in some]).T
        counts = ", ".join(f"{n} {status}" for status, n in Counter(b.status for b in some).most_common())
        worst = np.nanmax(errors / std) if np.isfinite(std).any() else np.nan
        figures = f"{np.median(errors):.3f}", f"{errors.max():.3f}", f"{worst:.1f}"
        print_row(trouble, len({b.capture for b in some}), len(some), counts, *figures)
    wrong = [b for b in bands if b.status == "aligned" and b.median_px > WRONG_PX]
    lost = [b for b in bands if b.status not in ("aligned", "predicted")]
    shares = [b.median_px / b.std_px for b in bands if b.status == "predicted"]
    within = [f"{np.mean(np.array(shares) <= k):.0%}" if shares else "-" for k in (1, 2)]
    print(f"{len(bands)} of {len(truth)} bands written, {len(lost)} neither aligned nor predicted,", end=" ")
    print(f"{len(wrong)} wrongly aligned; of the predicted within one standard error {within[0]}, two {within[1]}")
    for b in wrong + lost:
        where = f"{b.capture} {b.band} ({truth[b.file]['trouble'] or 'none'})"
        print(f"  {where}: {b.status}, {b.median_px:.2f} px, standard error {b.std_px:.2f}")


def main(captures: Number = 60, rng_seed: Number = 0) -> None:
    seconds = {}
    for name, make in {
        "untroubled": partial(make_flight, captures=captures),
        "troubled": partial(make_troubled_flight, captures=captures),
        "two headings": make_two_headings,
    }.items():
        with flight_and_out() as (flight, out):
            truth = read_ties(make(flight, rng_seed=rng_seed))
            seconds[name] = align(flight, out)
            print(f"\n{name}: {seconds[name]:.0f} s")
            report(band_errors(out, truth), truth)
    ratio = seconds["troubled"] / seconds["untroubled"]
    print(f"\na troubled capture takes {ratio:.2f} times as long as an untroubled one")


if __name__ == "__main__":
    run(main)
