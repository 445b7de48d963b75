"""NDVI of the synthetic flight against the reflectance it was painted with, before and after alignment. Prints a table.

python benchmarks/ndvi.py [CAPTURES]
"""

import numpy as np
from common import Number, flight_and_out, print_head, print_row, read_band, run, window_of

import agalign
from agalign.batch.index_run import index_tasks, run_indices
from agalign.cameras.discover import discover
from agalign.config import Settings, WriteSettings
from agalign.pixels.radiometry import calibrated
from agalign.records.sidecar_file import read_sidecar
from agalign.spectral_indices.formulas import INDICES, compute
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import reflectance

SIZE_PX = (1280, 960)
NDVI, BANDS = INDICES["ndvi"], ("NIR", "Red")


def main(captures: Number = 3) -> None:
    errors: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    specs, reference = {b.name: b for b in cameras.BANDS}, cameras.BANDS[cameras.REFERENCE]
    with flight_and_out() as (flight, out):
        synthetic.make_flight(flight, captures, SIZE_PX)
        poses, ground = synthetic.plan_flight(np.random.default_rng(0), captures, SIZE_PX)
        agalign.align_folder(flight, out, settings=Settings(write=WriteSettings(radiometry="auto")))
        reports = [r for done in run_indices(index_tasks(out, [NDVI], out)) for r in done]
        painted = [reflectance(ground, specs[name]) for name in BANDS]
        for pose, capture, report in zip(poses, discover(flight).captures, reports, strict=True):
            truth = compute(NDVI, [synthetic.view(p, ground, reference, pose, SIZE_PX) for p in painted])
            own = {b.name: calibrated(read_band(b.path), b.radiometry, 0, 0) for b in capture.bands}
            before, after = compute(NDVI, [own[name] for name in BANDS]), read_band(report.path)
            window = window_of(read_sidecar(report.path.with_name(f"{capture.name}.json")))
            errors["before"].append(np.abs(before[window] - truth[window]))
            errors["after"].append(np.abs(after - truth[window]))
    print_head("NDVI", "median error", "mean", "95 %", "pixels off by more than 0.1")
    for name, result in errors.items():
        every = np.concatenate([e[np.isfinite(e)] for e in result])
        figures = [f"{value:.3f}" for value in (np.median(every), every.mean(), np.percentile(every, 95))]
        print_row(name, *figures, f"{(every > 0.1).mean():.1%}")


if __name__ == "__main__":
    run(main)
