"""One machine, the same images: this program beside what people use today. Prints tables and draws a plot.

    pip install -e '.[bench]' && python benchmarks/peers.py DATA... [--plot FILE] [--methods 'a;b;...']

DATA holds folders of bands with `ties.json` (benchmarks/accuracy.py says how); a synthetic flight is added, whose truth
is exact. All methods get lens-corrected images where the camera's lens is known, and homographies are scored between
corrected pixels; correcting the images is not counted as theirs. Each method runs in a process of its own, with as many
threads as it takes; memory is that process's largest, and the row `identity` shows what the images alone take.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from agalign.batch.capture import quiet
from agalign.cameras import rig_seed
from agalign.cameras.discover import discover
from agalign.capture.align import align_pairs
from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.capture.seeding import best_seed
from agalign.config import CheckSettings, Settings
from agalign.evaluation.methods import elastix_affinity
from agalign.method.detect import to_8_bit
from agalign.pixels.raster import probe, read_for_alignment
from agalign.pixels.resample import warped
from agalign.synthetic import flight as synthetic
from agalign.values import geometry, lens
from agalign.values.capture import Band, Capture
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

Matrix = np.ndarray


@dataclass(frozen=True)
class Case:
    """One band pair with its truth."""

    set_name: str
    capture: Capture | None
    reference: Band
    band: Band
    fixed: Raster
    moving: Raster
    """As in the files, with their lenses."""
    ties: Matrix
    """(n, 4) undistorted px."""

    @property
    def rig(self) -> Matrix:
        """The rig's mapping, or identity where no tag tells."""
        found = rig_seed(self.reference, self.band)
        return np.eye(3) if found is None else found

    def straight(self) -> tuple[Raster, Raster]:
        """Both images lens-corrected."""
        return tuple(
            warped(r, PixelMapping(np.eye(3), None, r.lens), r.size_px) if lens.is_distorting(r.lens) else r
            for r in (self.fixed, self.moving)
        )  # type: ignore[return-value]


def cases(folders: list[Path]) -> Iterator[Case]:
    """Every band pair of the folders, each of which holds ties.json or truth.json."""
    for path in [p for folder in folders for p in (folder / "ties.json", folder / "truth.json") if p.is_file()]:
        captures = {}
        for capture in discover(path.parent).captures:
            captures.update({b.path.name: capture for b in capture.bands})
        for entry in json.loads(path.read_text()).values():
            capture = captures.get(entry["reference"])
            reference = _band(path.parent, entry["reference"], capture)
            fixed = read_for_alignment(reference, 4096)
            for name, truth in entry["bands"].items():
                band = _band(path.parent, name, capture)
                both = reference.lens is not None and band.lens is not None
                here, there = (b if both else replace(b, lens=None) for b in (reference, band))
                raw = np.array(truth["ties"])
                ties = np.hstack([lens.undistort(here.lens, raw[:, :2]), lens.undistort(there.lens, raw[:, 2:])])
                images = fixed if both else replace(fixed, lens=None), read_for_alignment(there, 4096)
                yield Case(path.parent.name, capture, here, there, *images, ties)


def _band(folder: Path, name: str, capture: Capture | None) -> Band:
    for band in capture.bands if capture else ():
        if band.path.name == name:
            return band
    path = next(folder.rglob(name))
    info = probe(path)
    return Band(path.stem, path, 1, info.width_px, info.height_px, info.dtypes[0])


# ---- the methods: (fixed, moving, rig) -> fixed_to_moving, or None where they give up


def identity(_f: Raster, _m: Raster, _rig: Matrix) -> Matrix:
    return np.eye(3)


def rig_only(_f: Raster, _m: Raster, rig: Matrix) -> Matrix:
    return rig


def structure_seed(f: Raster, m: Raster, rig: Matrix) -> Matrix:
    candidates: dict[Any, Matrix] = {"rig": rig, "identity": np.eye(3)}
    return best_seed(BandPair.of_images("moving", f, m, candidates, Settings()), candidates).fixed_to_moving


def structure_ties(f: Raster, m: Raster, rig: Matrix) -> Matrix | None:
    """The structure seed, then local shifts in windows as ties, then MAGSAC++."""
    seed = structure_seed(f, m, rig)
    windows = Reference(f, Settings(check=CheckSettings(tile_px=64))).windows
    found = windows.residuals(warped(m, PixelMapping(seed), f.size_px))
    some = np.isfinite(found.shifts_px[:, 0])
    if some.sum() < 8:
        return None
    here, moved = found.centres_px[some], found.centres_px[some] + found.shifts_px[some]
    matrix, _ = cv2.findHomography(here, geometry.apply(seed, moved), cv2.USAC_MAGSAC, 0.5)
    return matrix


def sift(f: Raster, m: Raster, _rig: Matrix) -> Matrix | None:
    """SIFT, ratio test 0.8, RANSAC at 3 px: the textbook recipe."""
    detector = cv2.SIFT_create(5000)
    (k1, d1), (k2, d2) = (detector.detectAndCompute(to_8_bit(r), None) for r in (f, m))
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 4:
        return None
    matches = [p for p in cv2.BFMatcher().knnMatch(d1, d2, k=2) if len(p) == 2]
    good = [a for a, b in matches if a.distance < 0.8 * b.distance]
    if len(good) < 4:
        return None
    here, there = (np.float32([k[getattr(g, i)].pt for g in good]) for k, i in ((k1, "queryIdx"), (k2, "trainIdx")))
    matrix, _ = cv2.findHomography(here, there, cv2.RANSAC, 3.0)
    return matrix


def ecc(f: Raster, m: Raster, rig: Matrix) -> Matrix | None:
    """ECC on gradient magnitude over a pyramid from the rig's mapping, as MicaSense's library and ODM do."""
    edges = []
    for r in (f, m):
        image = cv2.GaussianBlur(to_8_bit(r).astype(np.float32), (0, 0), 1.0)
        edges.append(cv2.magnitude(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)))
    matrix = rig
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    for halvings in (3, 2, 1, 0):
        scale = 0.5**halvings
        small = [cv2.resize(e, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for e in edges]
        start = geometry.rescale(matrix, (scale, scale), (scale, scale)).astype(np.float32)
        try:
            _, found = cv2.findTransformECC(small[0], small[1], start, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
        except cv2.error:
            return None
        matrix = geometry.rescale(found.astype(float), (1 / scale, 1 / scale), (1 / scale, 1 / scale))
    return matrix


def phase_correlation(f: Raster, m: Raster, _rig: Matrix) -> Matrix | None:
    if f.size_px != m.size_px:
        return None
    window = cv2.createHanningWindow(f.size_px, cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(to_8_bit(f).astype(np.float32), to_8_bit(m).astype(np.float32), window)
    return geometry.translation(*shift)


def elastix(f: Raster, m: Raster, _rig: Matrix) -> Matrix | None:
    """Affine, advanced Mattes mutual information, its own default parameters."""
    return elastix_affinity(f, m)


def elastix_seeded(f: Raster, m: Raster, rig: Matrix) -> Matrix | None:
    """The same from this program's seed, over five levels."""
    seed = structure_seed(f, m, rig)
    found = elastix_affinity(f, warped(m, PixelMapping(seed), f.size_px), levels=5)
    return None if found is None else geometry.compose(seed, found)


def kornia_registrator(f: Raster, m: Raster, _rig: Matrix) -> Matrix | None:
    """ImageRegistrator with a homography and its defaults."""
    import torch
    from kornia.geometry import ImageRegistrator

    fixed, moving = (torch.from_numpy(to_8_bit(r)).float()[None, None] / 255 for r in (f, m))
    try:
        found = ImageRegistrator("homography").register(moving, fixed)[0].detach().double().numpy()
    except RuntimeError:
        return None
    to_unit = [np.array([[2 / w, 0, 1 / w - 1], [0, 2 / h, 1 / h - 1], [0, 0, 1.0]]) for w, h in (f.size_px, m.size_px)]
    return geometry.compose(geometry.invert(to_unit[1]), found, to_unit[0])


Method = Callable[[Raster, Raster, Matrix], Matrix | None]
PEERS: dict[str, Method] = {
    "identity": identity, "rig tags only": rig_only, "structure seed": structure_seed,
    "structure ties + MAGSAC": structure_ties, "SIFT + RANSAC": sift, "ECC on gradients": ecc,
    "phase correlation": phase_correlation, "elastix, defaults": elastix, "elastix, our seed": elastix_seeded,
    "kornia ImageRegistrator": kornia_registrator,
}  # fmt: skip
OURS = ("agalign, from scratch", "agalign, flight")


def run_peer(name: str, folders: list[Path]) -> list[dict[str, Any]]:
    rows = []
    for case in cases(folders):
        fixed, moving = case.straight()
        began = time.perf_counter()
        try:
            matrix = PEERS[name](fixed, moving, case.rig)
        except ImportError as error:
            sys.exit(f"{name}: {error}")
        rows.append(_row(case, matrix, time.perf_counter() - began, "given" if matrix is not None else "none"))
    return rows


def run_ours(name: str, folders: list[Path]) -> list[dict[str, Any]]:
    """The pairs of a capture together, seeded, aligned and checked, as a run does it."""
    from agalign.batch.learn import learn_flight
    from agalign.flight.groups import camera_key

    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases(folders):
        groups.setdefault((case.set_name, case.reference.path.name), []).append(case)
    models: dict[str, Any] = {}
    rows = []
    for (set_name, _), group in groups.items():
        model = None
        capture = group[0].capture
        if name == "agalign, flight" and capture is not None:
            key = set_name + camera_key(capture)
            if key not in models:
                flight = list({c.capture.name: c.capture for g in groups.values() for c in g
                               if c.capture is not None and c.set_name == set_name}.values())  # fmt: skip
                models[key] = learn_flight(flight, Settings(), quiet)
            model = models[key]
        pairs = []
        reference = Reference(group[0].fixed, Settings())
        for case in group:
            candidates: dict[Any, Matrix] = {"rig": case.rig, "identity": np.eye(3)}
            if model is not None and case.band.name in model.mappings:
                candidates = {"model": model.mappings[case.band.name], **candidates}
            pairs.append(BandPair(case.band.name, reference, case.moving, candidates))
        found = align_pairs(pairs, Settings(), quiet, model)
        for case in group:
            alignment = found[case.band.name]
            rows.append(_row(case, alignment.fixed_to_moving, alignment.seconds, alignment.status))
    return rows


def _row(case: Case, matrix: Matrix | None, seconds: float, status: str) -> dict[str, Any]:
    row: dict[str, Any] = {"set": case.set_name, "seconds": seconds, "status": status, "median": None, "p95": None}
    if matrix is not None:
        error = np.linalg.norm(geometry.apply(matrix, case.ties[:, :2]) - case.ties[:, 2:], axis=1)
        row["median"], row["p95"] = (float(v) for v in np.nan_to_num(np.percentile(error, (50, 95)), nan=1e9))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--methods")
    parser.add_argument("--captures", type=int, default=2, help="of the synthetic flight")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only == "synthetic flight":
        synthetic.make_flight(options.data[0], options.captures, rng_seed=11)
        return
    if options.only:
        rows = (run_ours if options.only in OURS else run_peer)(options.only, options.data)
        print(json.dumps(rows))
        return
    names = options.methods.split(";") if options.methods else [*PEERS, *OURS]
    results = {}
    with tempfile.TemporaryDirectory() as temporary:
        made = Path(temporary) / "synthetic"
        child("synthetic flight", [made], "--captures", str(options.captures))
        folders = [path.parent for data in options.data for path in sorted(data.rglob("ties.json"))] + [made]
        for name in names:
            output, gigabytes = child(name, folders)
            if output is not None:
                results[name] = {"rows": json.loads(output.splitlines()[-1]), "gigabytes": gigabytes}
    if not results:
        sys.exit("no method could be run")
    sets = list(dict.fromkeys(r["set"] for r in next(iter(results.values()))["rows"]))
    for set_name in sets:
        table(set_name, results)
    if options.plot:
        plot(results, sets, options.plot)


def child(name: str, data: list[Path], *options: str) -> tuple[str | None, float]:
    """(output, largest memory in GB) of this script doing one thing; no output where it could not be done.

    A child's memory is counted from its parent's at its start, so the parent holds no images.
    """
    command = [sys.executable, __file__, *map(str, data), "--only", name, *options]
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(command, stdout=output)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    if process.returncode:
        print(f"{name}: left out", file=sys.stderr)
        return None, 0.0
    return text, usage.ru_maxrss / 1e6


def table(set_name: str, results: dict[str, Any]) -> None:
    print(f"\n### {set_name}\n")
    print("| method | pairs given | median, px | 95 %, px | under 0.3 px | under 1 px | s, median | worst | GB |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, result in results.items():
        rows = [r for r in result["rows"] if r["set"] == set_name]
        given = [r for r in rows if r["median"] is not None and r["status"] in ("given", "aligned")]
        seconds = [r["seconds"] for r in rows]
        if given:
            medians, p95 = np.array([r["median"] for r in given]), np.array([r["p95"] for r in given])
            shares = [f"{(medians < limit).sum() / len(rows):.0%}" for limit in (0.3, 1.0)]
            accuracy = f"{np.median(medians):.3f} | {np.median(p95):.2f} | {shares[0]} | {shares[1]}"
        else:
            accuracy = "- | - | 0% | 0%"
        print(
            f"| {name} | {len(given)} of {len(rows)} | {accuracy} | {np.median(seconds):.2f} | {max(seconds):.2f} "
            f"| {result['gigabytes']:.2f} |"
        )


def plot(results: dict[str, Any], sets: list[str], path: Path) -> None:
    """Median error over median time, a panel a set."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(sets), figsize=(4 * len(sets), 4.2), sharey=True)
    for axis, set_name in zip(np.atleast_1d(axes), sets, strict=True):
        for number, (name, result) in enumerate(results.items()):
            rows = [r for r in result["rows"] if r["set"] == set_name]
            medians = [r["median"] for r in rows if r["median"] is not None]
            if not medians or name in ("identity", "rig tags only"):
                continue
            style = {"marker": "*", "s": 130} if name in OURS else {"marker": "o", "s": 36}
            seconds = np.median([r["seconds"] for r in rows])
            axis.scatter(seconds, np.median(medians), color=f"C{number % 10}", label=name, zorder=3, **style)
        axis.set(xscale="log", yscale="log", title=set_name, xlabel="seconds a pair")
        axis.grid(which="both", alpha=0.25)
    np.atleast_1d(axes)[0].set_ylabel("median error at ties, px")
    handles, labels = np.atleast_1d(axes)[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=5, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0.12, 1, 1))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
