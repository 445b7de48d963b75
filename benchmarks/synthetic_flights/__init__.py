"""Synthetic flights for tests and benchmarks: more cameras than the demo's, captures with faults, calibration panels.

Both find it because `benchmarks` is on their path: as the folder of the scripts, and as pytest's `pythonpath`.
"""
