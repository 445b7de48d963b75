"""Flights: grouping of captures, the model and the rig of a camera, calibration panels, fingerprints.

In: captures with their tags, and some of their alignments. Out: groups, models, rigs, panels, sky, footprints.
"""
