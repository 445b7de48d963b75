"""A synthetic flight with ground truth: the ground, the rig, the files, and the score of an alignment.

In: a size and a number of captures. Out: a folder of images with tags and truth.json.
"""
