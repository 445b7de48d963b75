"""Verification: measurements of an alignment that are independent of its estimation, and checks of these.

In: mappings with windows that took no part in their fit. Out: issues, measures of similarity.
"""
