"""Runs over many captures: learning flights, workers, resuming and reports.

In: a scan of a folder and settings. Out: an output folder, and a report for each capture.
"""
