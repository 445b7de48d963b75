"""A folder of captures, aligned from Python, and what each sidecar says.

python examples/whole_flight.py FLIGHT OUT
"""

import sys

import agalign
from agalign.config import Settings, WriteSettings

settings = Settings(write=WriteSettings(format="cog", interpolation="bilinear"))
for report in agalign.align_folder(sys.argv[1], sys.argv[2], settings=settings):
    if report.sidecar is None:
        print(f"{report.label}: {report.error}")
        continue
    for band in report.sidecar.bands:
        residual = band.metrics.after.residual_px if band.metrics else None
        print(report.label, band.band, band.status, "" if residual is None else f"{residual:.3f} px")
