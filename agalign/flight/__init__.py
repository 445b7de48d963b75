"""Flights: grouping of captures, the model and the rig of a camera, calibration panels, fingerprints."""
