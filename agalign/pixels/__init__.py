"""Pixels: read from files, masked, calibrated, resampled, and the structure that is blind to contrast."""
