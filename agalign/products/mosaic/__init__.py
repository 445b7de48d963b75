"""Quick mosaics of a flight."""
