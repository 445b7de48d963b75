"""Results for bands without texture, and for captures over water, in an otherwise normal flight.

    python benchmarks/lost_bands.py FLIGHT...

FLIGHT holds a flight whose captures have reference ties in ties.json. In one run each capture loses another band, to
noise; in another one whole capture is water. Errors are medians over the ties of what is written all the same, beside
the standard error that the sidecar gives.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import rasterio
from scipy.interpolate import CloughTocher2DInterpolator

from agalign.products.sidecar_file import find_sidecars

Row = tuple[str, str, str, float, float]


def spoil(path: Path, how: str, rng: np.random.Generator) -> None:
    """Replace a file's pixels, and leave its tags."""
    with rasterio.open(path, "r+") as dataset:
        pixels = dataset.read(1)
        middle, spread = float(np.median(pixels)), float(pixels.std())
        noise = rng.normal(size=pixels.shape)
        if how == "water":
            glitter = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 3.0)
            noise = 0.3 * noise + glitter / glitter.std()
        spoilt = (middle + 0.5 * spread * noise).clip(1, 65000)
        dataset.write(spoilt.astype(pixels.dtype), 1)


def align(flight: Path, out: Path) -> None:
    subprocess.run([sys.executable, "-m", "agalign", str(flight), "-o", str(out), "-q"], check=False)


def rows(out: Path, truth: dict, kind: str, lost: set[str]) -> list[Row]:
    """Return (kind, band, status, error, standard error) of each replaced file."""
    result = []
    for path in find_sidecars(out):
        for band in json.loads(path.read_text())["bands"]:
            if band["file"] not in lost or band["file"] not in truth:
                continue
            ties = np.array(truth[band["file"]])
            mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
            error = float(np.nanmedian(np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)))
            bar = band["prediction"]["std_px"] if band["prediction"] else float("nan")
            source = f" ({band['prediction']['from']})" if band["prediction"] else ""
            result.append((kind, f"{path.stem} {band['band']}", band["status"] + source, error, bar))
    return result


def main() -> None:
    rng = np.random.default_rng(0)
    result: list[Row] = []
    for flight in map(Path, sys.argv[1:]):
        captures = json.loads((flight / "ties.json").read_text())
        truth = {file: e["ties"] for c in captures.values() for file, e in c["bands"].items()}
        names = list(captures)
        count = len(next(iter(captures.values()))["bands"])
        for turn in range(count + len(names)):
            with tempfile.TemporaryDirectory() as temporary:
                copy, out = Path(temporary) / "flight", Path(temporary) / "out"
                shutil.copytree(flight, copy, copy_function=shutil.copy)
                for path in copy.rglob("*"):
                    path.chmod(0o755 if path.is_dir() else 0o644)
                if turn < count:
                    kind = "a band"
                    lost = {list(captures[n]["bands"])[(turn + i) % count] for i, n in enumerate(names)}
                else:
                    kind, capture = "a capture", captures[names[turn - count]]
                    lost = {capture["reference"], *capture["bands"]}
                for name in lost:
                    spoil(next(copy.rglob(name)), "noise" if turn < count else "water", rng)
                align(copy, out)
                result += rows(out, truth, f"{flight.name}, {kind}", lost)
    print("| lost | band | what it is called | error at the ties, px | standard error, px |\n|---|---|---|---|---|")
    for kind, band, status, error, bar in result:
        print(f"| {kind} | {band} | {status} | {error:.3f} | {bar:.3f} |")
    for kind in dict.fromkeys(r[0] for r in result):
        errors, bars = (np.array([r[k] for r in result if r[0] == kind]) for k in (3, 4))
        within = [f"{np.mean(errors <= times * bars):.0%}" for times in (1, 2)]
        print(f"{kind}: median {np.median(errors):.3f}, worst {errors.max():.3f} px; within 1 standard error "
              f"{within[0]}, within 2 {within[1]}")  # fmt: skip


if __name__ == "__main__":
    main()
