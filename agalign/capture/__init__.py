"""One capture: the seed of each band pair, its alignment, and the verification of the result."""
