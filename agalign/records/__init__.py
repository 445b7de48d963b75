"""What is on disk about a run, and nothing of pixels: sidecars, run record, captures left out, what to check.

In: alignments, facts about captures. Out: JSON files, and these read again.
"""
