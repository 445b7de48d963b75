"""A benchmark of band-to-band alignment: sets, variants, methods and a scorer (docs/explanation/comparison.md)."""
