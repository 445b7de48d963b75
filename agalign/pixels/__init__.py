"""Pixels: reading, masks, calibration, resampling, structure images, detection of panels and sky.

In: files and their bands. Out: tiles of pixels with masks, radiance or reflectance, structure images.
"""
