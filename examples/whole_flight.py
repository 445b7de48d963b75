"""Align all captures of a folder from Python and print the status of each band.

python examples/whole_flight.py FLIGHT OUT
"""

import sys

import agalign


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/whole_flight.py FLIGHT OUT")
    settings = agalign.Settings(write=agalign.WriteSettings(format="cog", interpolation="bilinear"))
    # Two captures at a time. RunOptions(executor=...) takes any concurrent.futures executor instead.
    for report in agalign.align_folder(sys.argv[1], sys.argv[2], settings=settings, run=agalign.RunOptions(jobs=2)):
        if report.result is None:
            print(f"{report.label}: {report.error}")
            continue
        for band in report.result.bands:
            residual = f"{band.metrics.after.residual_px:.3f} px" if band.metrics else ""
            print(report.label, band.band, band.status, residual)


# Worker processes import this file, so the work must not start on import.
if __name__ == "__main__":
    main()
