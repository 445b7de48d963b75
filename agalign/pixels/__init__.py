"""Pixels: reading, masks, calibration, resampling, structure images, detection of panels and sky."""
