"""The report of a run.

In: sidecars and run record. Out: index.html, summary.csv and flight.geojson.
"""
