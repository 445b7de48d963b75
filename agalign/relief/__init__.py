"""The relief of a capture: plane + parallax from windows, and a dense parallax map by multi-baseline matching."""
