"""Find one capture of a flight, align and write its bands, and print the result of each.

python examples/one_capture.py FLIGHT OUT
"""

import sys

import agalign

if len(sys.argv) != 3:
    sys.exit("usage: python examples/one_capture.py FLIGHT OUT")
flight = agalign.discover(sys.argv[1])
capture = flight.captures[0]
print(capture.label, *(band.name for band in capture.bands))

outcome = agalign.align_capture(capture, sys.argv[2])
for band in outcome.sidecar.bands:
    if band.status == "reference":
        continue
    # The grid maps pixels of the reference to pixels of the band's own file, lenses included.
    here, there = (points[len(points) // 2] for points in (band.grid.reference_px, band.grid.moving_px))
    print(f"{band.band}: {band.status}, {here} maps to {there}, residual {band.metrics.after.residual_px:.3f} px")
