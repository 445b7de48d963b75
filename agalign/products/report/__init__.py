"""The report of a run, its summary as CSV, and the pictures in it."""
