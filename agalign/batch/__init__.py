"""Runs over many captures: learning flights, workers, resuming and reports."""
