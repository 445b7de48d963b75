"""Alignment of one capture: seed of each band pair, estimation, verification."""
