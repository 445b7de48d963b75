"""NDVI of the synthetic flight against the reflectance it was painted with, before and after alignment. Prints a table.

python benchmarks/ndvi.py [CAPTURES]
"""

from pathlib import Path

import numpy as np
import rasterio
from common import Number, flight_and_out, print_head, print_row, run

import agalign
from agalign.batch.index_run import index_tasks, run_indices
from agalign.cameras.metadata import read_tags
from agalign.cameras.micasense import MicaSense
from agalign.config import Settings, WriteSettings
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import probe
from agalign.products.indices.formulas import INDICES, compute
from agalign.products.sidecar.file import read_sidecar
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import reflectance

SIZE_PX = (1280, 960)
NDVI = INDICES["ndvi"]


def main(captures: Number = 3) -> None:
    errors: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    bands = {b.name: b for b in cameras.BANDS}
    infrared_and_red, reference = (bands["NIR"], bands["Red"]), cameras.BANDS[cameras.REFERENCE]
    with flight_and_out() as (flight, out):
        synthetic.make_flight(flight, captures, SIZE_PX)
        poses, ground = synthetic.plan_flight(np.random.default_rng(0), captures, SIZE_PX)
        agalign.align_folder(flight, out, settings=Settings(write=WriteSettings(radiometry="auto")))
        reports = [r for done in run_indices(index_tasks(out, [NDVI], out)) for r in done]
        painted = [reflectance(ground, band) for band in infrared_and_red]
        for number, (pose, report) in enumerate(zip(poses, reports, strict=True), start=1):
            truth = compute(NDVI, [synthetic.view(p, ground, reference, pose, SIZE_PX) for p in painted])
            before = compute(NDVI, [raw_reflectance(flight, number, band) for band in infrared_and_red])
            with rasterio.open(report.path) as dataset:
                after = dataset.read(1)
            x0, y0, width, height = read_sidecar(report.path.with_name(f"IMG_{number:04d}.json")).output.crop
            window = np.s_[y0 : y0 + height, x0 : x0 + width]
            errors["before"].append(np.abs(before[window] - truth[window]))
            errors["after"].append(np.abs(after - truth[window]))
    print_head("NDVI", "median error", "mean", "95 %", "pixels off by more than 0.1")
    for name, result in errors.items():
        every = np.concatenate([e[np.isfinite(e)] for e in result])
        figures = [f"{value:.3f}" for value in (np.median(every), every.mean(), np.percentile(every, 95))]
        print_row(name, *figures, f"{(every > 0.1).mean():.1%}")


def raw_reflectance(folder: Path, number: int, spec: cameras.BandSpec) -> np.ndarray:
    """Reflectance of a band in its own pixels."""
    path = folder / "0000SET" / "000" / f"IMG_{number:04d}_{spec.rig_index + 1}.tif"
    (band,) = MicaSense().bands(path, read_tags(path), probe(path))
    with rasterio.open(path) as dataset:
        return calibrated(dataset.read(1), band.radiometry, 0, 0)


if __name__ == "__main__":
    run(main)
