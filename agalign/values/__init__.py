"""Data that stages exchange: captures, images, alignments and geometry; and functions on them."""
