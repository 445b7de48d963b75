"""Verification: measurements of an alignment that are independent of its estimation, and checks of these."""
