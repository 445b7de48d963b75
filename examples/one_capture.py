"""Find one capture of a flight, align and write its bands, and print the result of each.

python examples/one_capture.py FLIGHT OUT
"""

import sys

import agalign

if len(sys.argv) != 3:
    sys.exit("usage: python examples/one_capture.py FLIGHT OUT")
flight = agalign.discover(sys.argv[1])
capture = flight.captures[len(flight.captures) // 2]  # the first and the last are often of a calibration panel
print(capture.label, *(band.name for band in capture.bands))

try:
    outcome = agalign.align_capture(capture, sys.argv[2])
except agalign.AgalignError as error:  # an unreadable reference band, or a capture of a calibration panel
    sys.exit(str(error))
for band in outcome.sidecar.bands:
    if band.grid is None:
        print(f"{band.band}: {band.status} {band.reason or ''}".rstrip())
        continue
    # The grid maps pixels of the reference to pixels of the band's own file, lenses included.
    here, there = (points[len(points) // 2] for points in (band.grid.reference_px, band.grid.moving_px))
    residual = f", residual {band.metrics.after.residual_px:.3f} px" if band.metrics else ""
    print(f"{band.band}: {band.status}, {here} maps to {there}{residual}")
