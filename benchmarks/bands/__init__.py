"""A benchmark of band-to-band alignment: sets, variants, methods and a scorer (docs/benchmark-bands.md)."""
