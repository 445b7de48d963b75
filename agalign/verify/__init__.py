"""Measurements of an alignment that do not depend on how it was estimated, and the checks that use them."""
