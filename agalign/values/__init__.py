"""Data that stages exchange: captures, images, alignments and geometry; and functions on them.

In and out: records without access to files; nothing here decides about a capture.
"""
