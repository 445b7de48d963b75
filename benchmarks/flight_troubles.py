"""Results for a flight with many faults, and for a camera that exposes its bands one after another.

    python benchmarks/flight_troubles.py [captures, by default 60] [rng seed]

The synthetic flights are aligned with the defaults. Errors are medians over a band's true ties, compared with the
standard error in the sidecar; the time per capture is compared with that of a flight of the same length without faults.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.products.sidecar_file import find_sidecars
from agalign.synthetic import make_flight

WRONG_PX = 1.0


def align(flight: Path, out: Path) -> float:
    """Seconds that a run takes."""
    since = time.perf_counter()
    subprocess.run([sys.executable, "-m", "agalign", str(flight), "-o", str(out), "-q"], check=False)
    return time.perf_counter() - since


def rows(out: Path, truth: dict) -> list[tuple[str, str, str, float, float]]:
    """(trouble, capture and band, status, median error, standard error) of every moving band in the output."""
    result = []
    for path in find_sidecars(out):
        sidecar = json.loads(path.read_text())
        known = truth.get(sidecar.get("capture"))
        for band in sidecar["bands"] if known else ():
            if band["file"] not in known["bands"] or band["grid"] is None:
                continue
            ties = np.array(known["bands"][band["file"]]["ties"])
            mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
            error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
            bar = band["joint"]["corner_std_px"] if band["status"] == "aligned" else np.nan
            if band["status"] == "predicted":
                bar = band["prediction"]["std_px"]
            label = f"{sidecar['capture']} {band['band']}"
            result.append((known["trouble"] or "none", label, band["status"], float(np.nanmedian(error)), bar))
    return result


def report(flight: Path, out: Path) -> None:
    """Print a table of one aligned flight."""
    truth = json.loads((flight / "truth.json").read_text())
    result = rows(out, truth)
    print("| trouble | captures | bands | statuses | median error, px | worst error, px | worst error / std |")
    print("|---|---|---|---|---|---|---|")
    for trouble in dict.fromkeys(r[0] for r in result):
        some = [r for r in result if r[0] == trouble]
        errors, bars = np.array([r[3] for r in some]), np.array([r[4] for r in some])
        counts = ", ".join(f"{n} {status}" for status, n in Counter(r[2] for r in some).most_common())
        captures = len({r[1].split()[0] for r in some})
        worst = np.nanmax(errors / bars) if np.isfinite(bars).any() else np.nan
        print(f"| {trouble} | {captures} | {len(some)} | {counts} | {np.median(errors):.3f} | {errors.max():.3f} "
              f"| {worst:.1f} |")  # fmt: skip
    wanted = sum(len(c["bands"]) for c in truth.values())
    wrong = [r for r in result if r[2] == "aligned" and r[3] > WRONG_PX]
    lost = [r for r in result if r[2] not in ("aligned", "predicted")]
    predicted = [r for r in result if r[2] == "predicted"]
    within = [f"{np.mean([r[3] <= k * r[4] for r in predicted]):.0%}" for k in (1, 2)] if predicted else ["-", "-"]
    print(f"{len(result)} of {wanted} bands written, {len(lost)} neither aligned nor predicted, {len(wrong)} wrongly "
          f"aligned; of the predicted within one standard error {within[0]}, two {within[1]}")  # fmt: skip
    for trouble, label, status, error, bar in wrong + lost:
        print(f"  {label} ({trouble}): {status}, {error:.2f} px, standard error {bar:.2f}")


def main() -> None:
    captures = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    rng_seed = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    seconds = {}
    for name, make in (("untroubled", make_flight), ("troubled", make_troubled_flight), ("two headings", None)):
        with tempfile.TemporaryDirectory() as temporary:
            flight, out = Path(temporary) / "flight", Path(temporary) / "out"
            if make is None:
                make_two_headings(flight, rng_seed=rng_seed)
            else:
                make(flight, captures, rng_seed=rng_seed)
            seconds[name] = align(flight, out)
            print(f"\n{name}: {seconds[name]:.0f} s")
            report(flight, out)
    ratio = seconds["troubled"] / seconds["untroubled"]
    print(f"\na troubled capture takes {ratio:.2f} times as long as an untroubled one")


if __name__ == "__main__":
    main()
