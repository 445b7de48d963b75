"""Outputs in the formats of other programs and libraries."""
