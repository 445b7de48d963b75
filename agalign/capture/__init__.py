"""Alignment of one capture: seed of each band pair, estimation, verification.

In: a capture and the model of its flight. Out: an `Alignment` for each moving band.
"""
