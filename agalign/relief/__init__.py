"""Relief of a capture: plane + parallax from windows, dense parallax by multi-baseline stereo, occlusions, range."""
